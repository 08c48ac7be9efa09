"""The waveform of a source nobody logged, from what it leaves in the outputs of one survey.

With its vector at every sensor known, each sample shows the source in the directions of the outputs that nothing else
can move: off the uniform field and, where the survey may have one, off the gradient. That estimate is filtered as far
as its own spectrum stands above that of the noise (Wiener), so that it never brings in more noise than it takes off: a
slow source is smoothed, a strong one left as it is, and one that is not there gives nothing. Where two levels explain
it down to the noise it is a switch, which is known better still (`switching`).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.error_models.switching import two_levels

NAME = "latent_source"
LEAST_SHARE = 0.02  # of the vector's square that must lie in free directions: less brings in noise, as much again,
# unless two levels tell each sample's state
LEAST_IN_BAND = 12  # cosine coefficients from which a level of the spectrum is taken
BANDS = 40
MOST_SLOW = 2.0  # power of the noise over that of its fastest part: of more it is not white
BENDING = 10.0


@dataclass(frozen=True)
class Course:
    """A waveform.

    Attributes:
        values: (N,) in units of the vector, the most likely ones: what cannot be told from noise is left out.
        rms: of the source itself.
        std: of a value's error.
        band: cycles per sample up to which nine tenths of it lie; 0 where there is nothing.
        switches: whether it has two levels.
    """

    values: Array
    rms: float
    std: float
    band: float
    switches: bool = False


def course_of(whitened: Array, held: Array, direction: Array, good: NDArray[np.bool_] | None = None) -> Course:
    """The waveform of a source of known direction.

    Parameters
    ----------
    whitened: (N, n) outputs divided by their noise, offsets taken off.
    held: (n, k) directions in which the field moves the outputs.
    direction: (n,) what a unit of the waveform adds to the whitened outputs.
    good: (N,) samples to believe; others get a value from their neighbours.
    """
    n = len(whitened)
    basis = free_directions(held)
    d = basis.T @ direction
    information = float(d @ d)
    if information == 0:
        return Course(np.zeros(n), 0.0, 0.0, 0.0)
    used = np.arange(n) if good is None else np.flatnonzero(good)
    if not len(used):
        return Course(np.zeros(n), 0.0, 0.0, 0.0)
    z = whitened[used] @ basis
    rest = z @ np.linalg.svd(d[None, :])[2][1:].T
    course = _filtered(z @ d / information, rest, information)
    if too_little_shows(held, direction) and not course.switches:
        return Course(np.zeros(n), 0.0, 0.0, 0.0)
    return replace(course, values=np.interp(np.arange(n), used, course.values))


def too_little_shows(held: Array, direction: Array) -> bool:
    """Whether so little of a source lies in the directions in which the field moves nothing that what is seen there
    would bring in more than it takes off, `held` and `direction` as for `course_of`."""
    shown = free_directions(held).T @ direction
    return bool(shown @ shown < LEAST_SHARE * float(direction @ direction))


def bends(whitened: Array, held: Array, direction: Array) -> bool:
    """Whether a field that bends within the array shows more where a source is looked for than the source may.

    What is neither uniform nor a gradient, a source nearer than a few baselines, moves the outputs in the free
    directions too. Those in which the hidden source does not act tell how much: beyond their noise, and how it would
    compare with what is seen along the source's own direction if that had `BENDING` times their mean.

    Parameters
    ----------
    whitened, held, direction: as for `course_of`.
    """
    basis = free_directions(held)
    d = basis.T @ direction
    if len(d) < 2 or not d.any() or not len(whitened):
        return False
    z = whitened @ basis
    own = float(np.mean((z @ d) ** 2)) / float(d @ d)
    excess = float(np.mean(z**2)) * len(d) - own
    excess = excess / (len(d) - 1) - 1.0
    return excess > 1.0 and own - 1.0 < BENDING * excess


def free_directions(held: Array) -> Array:
    """(n, n - rank) orthonormal directions in which the field moves nothing."""
    u, s, _ = np.linalg.svd(held, full_matrices=True)
    rank = int(np.sum(s > 1e-6 * s[0])) if len(s) else 0
    out: Array = u[:, rank:]
    return out


def _filtered(series: Array, rest: Array, information: float) -> Course:
    """A series (N,) as far as it stands above its noise.

    The noise has 1 / `information` of the power of the rest (N, k).
    """
    from scipy.fft import dct, idct

    n = len(series)
    coefficients = dct(series, norm="ortho")
    power = coefficients**2
    noise = np.mean(dct(rest, axis=0, norm="ortho") ** 2, axis=1) if rest.shape[1] else np.ones(n)
    gain, left, level, floor = np.zeros(n), np.zeros(n), 0.0, 0.0
    for a, b in itertools.pairwise(_edges(n)):
        floor = noise[a:b].mean() / information
        gain[a:b] = max(1.0 - floor / max(power[a:b].mean(), 1e-300), 0.0)
        left[a:b] = gain[a:b] * floor
        level += floor * (b - a) / n
    own = np.cumsum(gain * power)
    band = float(np.searchsorted(own, 0.9 * own[-1])) / (2.0 * n) if own[-1] > 0 else 0.0
    values, std = np.asarray(idct(gain * coefficients, norm="ortho")), float(np.sqrt(left.mean()))
    # a sample tells its state by itself only in white noise: in slow noise whatever wanders is near one of two levels
    switched = two_levels(series, float(np.sqrt(level)), values) if level < MOST_SLOW * floor else None
    if switched is not None and switched[1] < std:
        return Course(switched[0], float(switched[0].std()), switched[1], band, switches=True)
    return Course(values, float(np.sqrt(own[-1] / n)), std, band)


def _edges(n: int) -> list[int]:
    """Edges of bands of cosine coefficients, wider towards higher frequencies."""
    edges = [0]
    for edge in np.geomspace(1, n, BANDS).round().astype(int):
        if edge - edges[-1] >= LEAST_IN_BAND and n - edge >= LEAST_IN_BAND:
            edges.append(int(edge))
    return [*edges, n]
