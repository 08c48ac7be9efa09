"""Yin 2015: the eigenvector square root of the ellipsoid's matrix, as Chi 2017 describes it (eq. 15)."""

from __future__ import annotations

from magtensor import method
from magtensor.calibration.coverage import WORST_ERROR
from magtensor.calibration.types import Array, SensorCalibration
from magtensor_methods.scalar_options import WorstError


@method("calibrate_scalar", source="Yin et al. 2015 after Chi et al. 2017, eq. 15")
def eigen_square_root(raw: Array, total_field: Array, *, worst_error: WorstError = WORST_ERROR) -> SensorCalibration:
    """Ellipsoid fit and the symmetric factor V sqrt(D) V^T, whose frame lies nearest to the raw axes.

    |b| is that of chi2017; the frame differs from it by a rotation.

    Parameters
    ----------
    raw: (N, 3) nT; total_field: (N,) nT.

    Raises
    ------
    NotEnoughData: the attitudes do not determine the ellipsoid; the message says which are missing.
    """
    from magtensor.calibration.factors import POLAR
    from magtensor.calibration.quadric import ellipsoid_restricted
    from magtensor.calibration.scalar import calibrate

    return calibrate(raw, total_field, ellipsoid_restricted, POLAR, worst_error)
