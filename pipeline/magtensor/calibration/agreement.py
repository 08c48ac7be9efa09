"""Do calibrated sensors see one field? What no calibration explains is refused instead of being averaged.

A sensor may lie on an ellipsoid of its own and still have nothing to do with its neighbours: samples of another
time, a random signal, half of its record dead. Its scalar residual is small or its correction enormous; beside the
others it shows at once.
"""

from __future__ import annotations

import numpy as np

from magtensor.errors import DataError

from .types import Array, Mask

LARGEST_DISAGREEMENT = 0.1  # of F: twice the largest error that raw sensors of the catalogue have
LEAST_FOR_A_TURN = 30  # samples
BY_A_TURN = 0.9  # of what differs between the sensors, a turn explains so much
LEFT_BY_A_TURN = 0.1  # of what constant differences leave: what turns with the platform is no field of the site
BEYOND_REST = 5.0  # times what is left beside the turns, one of them moves a sensor's vectors
LEAST_PART = 0.01  # of the samples
LARGEST_BEFORE_EFFECTS = 0.3  # of F, by what a thermometer may explain yet; what sees another field differs by F


def turns(b: Array, good: Mask) -> dict[int, float]:
    """Sensors that seem to have been turned since the calibration, and by how many degrees.

    The length of a vector does not tell, and so a total field says nothing: what the sensors make of one field does.
    Each sensor less the mean of all is fitted by a small turn of that mean. It counts where that explains nearly all
    that differs, and far more than differences that are constant: a field that is not uniform differs otherwise as the
    platform turns. Of two sensors nobody knows which; both are named. Of more, what most of them have in common is the
    mean's own, which the turned ones moved.

    Parameters
    ----------
    b: (N, S, 3) nT, calibrated to one frame; good: (N, S).
    """
    use = good.all(axis=1) & np.isfinite(b).all(axis=(1, 2))
    if b.shape[1] < 2 or np.count_nonzero(use) < LEAST_FOR_A_TURN:
        return {}
    seen = b[use]
    mean = seen.mean(axis=1)
    apart = seen - mean[:, None]
    x, y, z = mean.T
    zero = np.zeros_like(x)
    cross = np.stack([np.stack(r, -1) for r in ((zero, z, -y), (-z, zero, x), (y, -x, zero))], 1)  # turn x mean
    columns = cross.reshape(-1, 3)
    turn = np.array([np.linalg.lstsq(columns, d.ravel(), rcond=None)[0] for d in apart.swapaxes(0, 1)])
    left = apart - np.einsum("nij,sj->nsi", cross, turn)
    whole, after, beside = (float(np.sum(v**2)) for v in (apart, left, apart - apart.mean(axis=0)))
    if after > (1.0 - BY_A_TURN) * whole or after > LEFT_BY_A_TURN * beside:
        return {}
    if len(turn) > 2:
        turn = turn - np.median(turn, axis=0)
    angle = np.linalg.norm(turn, axis=1)
    moved = angle * float(np.median(np.linalg.norm(mean, axis=1)))
    return {
        int(s): float(np.rad2deg(angle[s]))
        for s in np.flatnonzero(moved > BEYOND_REST * float(np.sqrt(np.mean(left**2))))
    }


def strangers(b: Array, good: Mask, total_field: Array) -> dict[int, float]:
    """Sensors that differ from what most of three or more see by more than any calibration or gradient makes them, and
    in which part of the samples.

    Parameters
    ----------
    b: (N, S, 3) nT, calibrated to one frame; good: (N, S); total_field: (N,) nT.
    """
    if b.shape[1] < 3:
        return {}
    away = np.linalg.norm(b - np.median(b, axis=1, keepdims=True), axis=2)
    far = (good & (away > LARGEST_DISAGREEMENT * total_field[:, None])).mean(axis=0)
    return {int(s): float(far[s]) for s in np.flatnonzero(far > LEAST_PART)}


def require_agreement(b: Array, total_field: Array, largest: float = LARGEST_DISAGREEMENT) -> None:
    """Refuse a sensor that does not see the field that the others see.

    The median over the samples is judged, so that spikes do not decide.

    Parameters
    ----------
    b: (N, S, 3) nT, calibrated to one frame.
    total_field: (N,) nT.
    largest: accepted disagreement, a part of the total field.

    Raises
    ------
    DataError: the sensor that disagrees most, with the disagreement in nT.
    """
    if b.shape[1] < 2:
        return
    typical = np.median(b, axis=1, keepdims=True) if b.shape[1] > 2 else b[:, ::-1]
    away = np.median(np.linalg.norm(b - typical, axis=2), axis=0)
    worst = int(np.argmax(away))
    if away[worst] <= largest * float(np.mean(total_field)):
        return
    who = f"sensor {worst + 1} does" if b.shape[1] > 2 else "sensors 1, 2 do"
    others = "the others see" if b.shape[1] > 2 else "each other sees"
    raise DataError(
        f"{who} not see the field that {others}: after calibration they differ by {away[worst]:.3g} nT",
        hint="look for a sensor with another clock, exchanged columns, or a record that is partly dead",
    )
