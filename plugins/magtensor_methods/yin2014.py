"""Yin 2014: linear two-step calibration without simplification, as its abstract and Li 2018 describe it.

Scalar step: the linear least squares that two nonlinear conversions lead to, the one that Li 2018 writes out in
eqs. 15-21 for his platform vector. Alignment: linear least squares for the elements of the rotation matrix.
"""

from __future__ import annotations

from collections.abc import Sequence

from magtensor import method
from magtensor.calibration.coverage import WORST_ERROR
from magtensor.calibration.types import Array, ArrayCalibration, SensorCalibration
from magtensor_methods.scalar_options import WorstError


@method("calibrate_scalar", source="Yin et al. 2014 (abstract); Li et al. 2018, section 4 and Table 1")
def yin2014(raw: Array, total_field: Array, *, worst_error: WorstError = WORST_ERROR) -> SensorCalibration:
    """Linear least squares of the quadric with its constant term on the right, triangular factor.

    Parameters
    ----------
    raw: (N, 3) nT, with its zero well inside the ellipsoid; total_field: (N,) nT.

    Raises
    ------
    NotEnoughData: the attitudes do not determine the ellipsoid; the message says which are missing.
    """
    from magtensor.calibration.factors import CHOLESKY
    from magtensor.calibration.quadric import constant_term_normalised
    from magtensor.calibration.scalar import calibrate

    return calibrate(raw, total_field, constant_term_normalised, CHOLESKY, worst_error)


@method("align", name="yin2014_linear", source="Yin et al. 2014 (abstract); Li et al. 2018, eq. 6")
def yin2014_linear(b: Array, calibrations: Sequence[SensorCalibration], reference: int) -> ArrayCalibration:
    """Nine matrix elements by linear least squares, three misalignment angles read from them.

    Reads three of the nine elements only, so it is noisier than Procrustes.

    Parameters
    ----------
    b: (N, S, 3) nT, scalar-calibrated; calibrations: (S,); reference: index of the sensor.

    Raises
    ------
    DataError: a mirrored sensor, with the axis; or a misalignment of 90 degrees or more.
    """
    from magtensor.calibration import alignment

    return alignment.align(b, calibrations, reference, alignment.linear_elements)
