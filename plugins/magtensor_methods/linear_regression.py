"""Vector calibration by linear regression."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from magtensor import method
from magtensor.calibration.coverage import WORST_ERROR
from magtensor.calibration.types import Array, SensorCalibration
from magtensor_methods.scalar_options import WorstError


@method("calibrate_vector", source="linear regression of the raw output on the known field")
def linear_regression(
    raw: Array,
    field: Array,
    *,
    robust: Annotated[bool, Field(description="weigh outliers down (Huber)")] = False,
    worst_error: WorstError = WORST_ERROR,
) -> SensorCalibration:
    """Twelve parameters of one sensor from a known field, with the noise on the raw output.

    Parameters
    ----------
    raw: (N, 3) nT; field: (N, 3) nT, known, in the platform frame.

    Raises
    ------
    NotEnoughData: the field did not leave a plane, or too few samples.
    DataError: an axis that does not respond to the field.
    """
    from magtensor.calibration import vector

    return vector.linear_regression(raw, field, robust, worst_error)
