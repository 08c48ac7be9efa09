"""What can be had from a sensor that hardly turns."""

from __future__ import annotations

from magtensor import method
from magtensor.calibration.types import Array, SensorCalibration


@method("calibrate_scalar", source="truncated singular value decomposition, truncated by blocks that were not fitted")
def determined_only(raw: Array, total_field: Array) -> SensorCalibration:
    """Only the combinations of the nine parameters that held-out blocks want; the others stay nominal, and it says so.

    For a variometer that stands still, or a vehicle that only changes its heading. A sensor that has been turned in
    all directions is better calibrated by the other methods, which refuse a survey that this one is for.

    Parameters
    ----------
    raw: (N, 3) nT, near the field (base values added); total_field: (N,) nT.

    Raises
    ------
    NotEnoughData: not even the error along the field predicts blocks that were not fitted.
    """
    from magtensor.calibration.determined import calibrate_determined

    return calibrate_determined(raw, total_field)
