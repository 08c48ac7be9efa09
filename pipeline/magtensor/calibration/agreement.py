"""Do calibrated sensors see one field? What no calibration explains is refused instead of being averaged.

A sensor may lie on an ellipsoid of its own and still have nothing to do with its neighbours: samples of another
time, a random signal, half of its record dead. Its scalar residual is small or its correction enormous; beside the
others it shows at once.
"""

from __future__ import annotations

import numpy as np

from magtensor.errors import DataError

from .types import Array

LARGEST_DISAGREEMENT = 0.1  # of F: twice the largest error that raw sensors of the catalogue have
LARGEST_BEFORE_EFFECTS = 0.3  # of F, by what a thermometer may explain yet; what sees another field differs by F


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
