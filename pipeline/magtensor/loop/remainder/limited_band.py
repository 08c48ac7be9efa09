"""Noise that a filter has left no high frequencies of, as of a sensor that is read far more often than it answers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.colour import mean_power
from magtensor.loop.evidence.residual import Residual

OCTAVES = 4  # below the highest frequency, in which a filter may begin: what is slower than that moves
FALLS = 10.0  # times the power of the highest octave: 1/f^2 noise over white has less from one octave to the next
UNLIKE = 10.0  # times the power of another output: noise of sensors of one kind has less, an effect on some has more
TOLD_APART = 3  # sensors
LEAST = 512  # samples


@dataclass(frozen=True)
class Band:
    """What a filter has let pass.

    Attributes:
        rms_nT: of an output, of noise as strong at all frequencies of the band.
        part: of all frequencies, that the band holds.
        slow: times that, rms, what is stronger at the low frequencies.
    """

    rms_nT: float
    part: float
    slow: float


def limited_band(residual: Residual) -> Band | None:
    """The band of what is left between the sensors, or along the field of a single one, where all else is taken for
    noise; None where the highest frequencies have as much as others, or a tenth of it, and where some outputs have far
    more than others."""
    left, one = residual.across, np.diagonal(residual.projector)
    if left is None:
        assert residual.along is not None
        left, one = residual.along[:, None], np.ones(1)
    count = len(left)
    if count < LEAST or _unlike(residual, np.mean(left**2, axis=0) / one):
        return None
    power = mean_power(left)
    edges = [0, *(count >> k for k in range(OCTAVES, -1, -1))]
    levels = np.array([power[a:b].mean() for a, b in pairwise(edges)])
    level = float(levels[1:-1].max())
    if level < FALLS * levels[-1]:
        return None
    parts = np.diff(edges) / count
    part = float(parts[0] + np.minimum(levels[1:] / level, 1.0) @ parts[1:])
    slow = max(levels[0] / level - 1.0, 0.0) * parts[0] / part
    return Band(residual.scale * float(np.sqrt(level * part / one.mean())), part, float(np.sqrt(slow)))


def _unlike(residual: Residual, each: Array) -> bool:
    """Whether some outputs have far more than others, of mean squares (n,) over those of their white noise: what one
    has is in the differences to all others, by which two sensors do not tell whose it is."""
    sensors = residual.projector.shape[0] // 3
    if residual.across is not None and sensors >= TOLD_APART:
        from scipy.optimize import nnls

        each = nnls(residual.projector**2, each * np.diagonal(residual.projector))[0]
    return bool(each.max() > UNLIKE * each.min())
