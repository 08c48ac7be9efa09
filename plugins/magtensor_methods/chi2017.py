"""Chi 2017: ellipsoid fit, Cholesky factor, and Procrustes alignment to one sensor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field

from magtensor import method
from magtensor.calibration.coverage import WORST_ERROR
from magtensor.calibration.types import Array, ArrayCalibration, SensorCalibration
from magtensor_methods.scalar_options import WorstError


@method("calibrate_scalar", source="Chi et al. 2017, section 3.1, eqs. 7-14")
def chi2017(
    raw: Array,
    total_field: Array,
    *,
    fit: Annotated[
        Literal["ellipsoid", "gradient"],
        Field(
            description="constraint of the algebraic least squares: the ellipsoid restriction of the paper, or a "
            "unit mean squared gradient, which has less bias where the attitudes cover little"
        ),
    ] = "ellipsoid",
    worst_error: WorstError = WORST_ERROR,
) -> SensorCalibration:
    """Ellipsoid fit under an ellipsoid restriction, rescaled to the field, Cholesky factor.

    The frame has its z along the sensed z axis and y in the plane of the sensed y and z. The total field may vary
    from sample to sample; with a constant one this is the paper's fit.

    Parameters
    ----------
    raw: (N, 3) nT; total_field: (N,) nT.

    Raises
    ------
    NotEnoughData: the attitudes do not determine the ellipsoid; the message says which are missing.
    """
    from magtensor.calibration.factors import CHOLESKY
    from magtensor.calibration.quadric import ellipsoid_restricted, gradient_normalised
    from magtensor.calibration.scalar import calibrate

    fits = {"ellipsoid": ellipsoid_restricted, "gradient": gradient_normalised}
    return calibrate(raw, total_field, fits[fit], CHOLESKY, worst_error)


@method("align", source="Chi et al. 2017, section 3.2, eq. 16")
def procrustes(b: Array, calibrations: Sequence[SensorCalibration], reference: int) -> ArrayCalibration:
    """Closed-form rotation of every sensor into the frame of the reference sensor.

    Proper rotations only. Where only a mirror fits, an axis is inverted or two are swapped, and that is an error;
    where the field stayed in a plane either would fit, and the result says so.

    Parameters
    ----------
    b: (N, S, 3) nT, scalar-calibrated; calibrations: (S,); reference: index of the sensor.

    Raises
    ------
    DataError: a mirrored sensor, with the axis.
    """
    from magtensor.calibration import alignment

    return alignment.align(b, calibrations, reference, alignment.procrustes)
