"""How much of what is left white noise does not make, in nT."""

from __future__ import annotations

from math import comb

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.fitting.model import State
from magtensor.loop.remainder.limited_band import limited_band

FAR_MORE = 4.0  # times the square that noise would leave
TIMES = 4  # that differences are taken, from one sample to the next
MEDIAN = 0.4549  # of the square of a normal variable
SHOWN = 2.0  # standard deviations of what white noise makes of it by chance


def excess_rms(state: State) -> float:
    """nT rms over all outputs of what is left above the white noise.

    A sensor that is off by a mean square w on each axis adds, to the mean squares of the whitened residual, what its
    own noise and the plane that it is projected off make of w; an error e of the total field shows along alone, as one
    of all outputs along the field would, a third of its square on each axis. The w and e^2 are the least ones that add
    up to what the residual has above one for each value, those that chance makes left out.
    """
    shown, above = _shown(state.residual)
    return float(np.sqrt(_of_outputs(shown, above, state.residual)))


def white_noise(residual: Residual) -> float:
    """nT, the noise of an output, rms over these: what the residual was divided by, unless far more is left between the
    sensors than that. Then it is what is fastest there."""
    across = residual.across
    if across is None:
        return residual.scale
    one = float(np.mean(np.diagonal(residual.projector)))
    if float(np.mean(across**2)) < FAR_MORE * one:
        return residual.scale
    fast = np.diff(across, n=TIMES, axis=0)
    level = float(np.mean(np.median(fast**2, axis=0))) / (MEDIAN * comb(2 * TIMES, TIMES))
    return residual.scale * float(np.sqrt(min(level / one, 1.0)))


def noise_floor(residual: Residual, *, all_noise: bool) -> float:
    """nT, as `white_noise`; where all that is left between the sensors is noise, that of the band that a filter left.

    Of a single sensor it is not asked: |b| - F lacks high frequencies where it is the base station's, read seldom.
    """
    band = limited_band(residual) if all_noise and residual.across is not None else None
    return white_noise(residual) if band is None else band.rms_nT


def _of_outputs(shown: Array, above: Array, residual: Residual) -> float:
    """nT2, mean over outputs."""
    from scipy.optimize import nnls

    found = nnls(shown, above)[0]
    found[found * np.linalg.norm(shown, axis=0) < SHOWN] = 0.0
    sensors = len(residual.noise) // 3
    return float(found[:sensors].mean() + found[sensors:].sum() / 3.0)


def _shown(residual: Residual) -> tuple[Array, Array]:
    """What a mean square of one nT2 on each axis of every sensor, and of the total field where there are several
    sensors, adds to the mean squares of the residual of every sensor across and along (K, S + 1), and what these have
    above white noise (K,); in standard deviations of that.
    """
    count, square = len(residual.affine), residual.noise**2
    sensors = len(square) // 3
    rows, above = [], []
    if residual.across is not None:
        seen = residual.projector**2
        made = (seen / square).reshape(sensors, 3, sensors, 3).sum(axis=(1, 3))
        more = (np.mean(residual.across**2, axis=0) - np.diagonal(residual.projector)).reshape(sensors, 3).sum(axis=1)
        own = np.einsum("sisj->s", seen.reshape(sensors, 3, sensors, 3))
        deviation = np.sqrt(2.0 * own / count)
        rows.append(np.column_stack([made, np.zeros(sensors)]) / deviation[:, None])
        above.append(more / deviation)
    if residual.along is not None:
        made = (np.mean(residual.gain**2, axis=0) / square).reshape(sensors, 3).sum(axis=1)
        total_field = np.mean(residual.reference_gain**2) * (residual.across is not None)
        deviation = np.sqrt(2.0 / count)
        rows.append(np.append(made, total_field)[None] / deviation)
        above.append(np.array([np.mean(residual.along**2) - 1.0]) / deviation)
    return np.concatenate(rows), np.concatenate(above)
