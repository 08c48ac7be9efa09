"""Zhang 2015: linear error model with the second order neglected, reconstructed from what Li 2018 says of it.

The paper itself was not at hand. Li 2018 (sections 3.3 and 4) says that it neglects the second and higher orders
of the small quantities in the single-sensor model, and prints what that costs on his simulation (Table 1). The
reading here: with response C = I + E, E upper triangular and of first order like the offset o,

    |m|^2 - F^2 = 2 m^T (E m + o),        b = (I - E) (m - o).

Scale errors, angles and offsets all count as small. Of the seventeen readings tried this one alone returns Li's
printed 1003.92, 927.04, 827.88, 690.39 nT, to 0.01 nT; it has no constant to adjust, so it is right in effect if not
in notation.
"""

from __future__ import annotations

import numpy as np

from magtensor import DataError, method
from magtensor.calibration.coverage import WORST_ERROR
from magtensor.calibration.types import Array, SensorCalibration
from magtensor_methods.scalar_options import WorstError


@method("calibrate_scalar", source="Zhang et al. 2015 after Li et al. 2018, section 4 and Table 1")
def zhang2015(raw: Array, total_field: Array, *, worst_error: WorstError = WORST_ERROR) -> SensorCalibration:
    """Small-error linear calibration: nine unknowns by one linear least squares, second order neglected.

    For a sensor with errors of some per cent only: what is neglected is of the order F times the error squared.
    The covariance is that of the noise, not of the neglected terms.

    Parameters
    ----------
    raw: (N, 3) nT; total_field: (N,) nT.

    Raises
    ------
    NotEnoughData: the attitudes do not determine the nine unknowns; the message says which are missing.
    DataError: errors so large that the model breaks down.
    """
    from magtensor.calibration.factors import CHOLESKY, upper
    from magtensor.calibration.quadric import design, gradient_normalised
    from magtensor.calibration.scalar import checked_samples, corrected, fit_or_refuse, judged

    raw, total_field = checked_samples(raw, total_field)
    # the attitudes are judged by an exact fit: what this model neglects is no fault of theirs
    exact = fit_or_refuse(raw, total_field, gradient_normalised)
    seen = judged(raw, total_field, upper(exact.shape), exact.offset, worst_error)
    unit = float(np.mean(total_field))
    x = raw / unit
    left = np.sum(x**2, axis=1) - (total_field / unit) ** 2
    columns = design(x)[:, :9] * np.array([2, 2, 2, 2, 2, 2, 1, 1, 1])
    e = np.linalg.lstsq(columns, left, rcond=None)[0]
    # columns 4 to 6 hold 2 yz, 2 xz, 2 xy, so an element above the diagonal is twice its coefficient
    matrix = np.eye(3) - np.array([[e[0], 2 * e[5], 2 * e[4]], [0.0, e[1], 2 * e[3]], [0.0, 0.0, e[2]]])
    if np.diag(matrix).min() <= 0:
        raise DataError(
            "the small-error model gives a negative scale factor",
            hint="its errors must be small against one: use chi2017",
        )
    return corrected(raw, total_field, matrix, e[6:] * unit, CHOLESKY, seen)
