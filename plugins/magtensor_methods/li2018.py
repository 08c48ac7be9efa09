"""Li 2018: linear solution by two conversions, and Levenberg-Marquardt to an artificial platform vector."""

from __future__ import annotations

import numpy as np

from magtensor import method
from magtensor.calibration.coverage import WORST_ERROR
from magtensor.calibration.types import Array, ArrayCalibration, SensorCalibration
from magtensor_methods.scalar_options import WorstError


def nine_parameters(v: Array) -> Array:
    """Li's nine parameters from the linear system's solution (Li 2018 eqs. 20-21).

    Two corrections to the print: V is taken relative to H - R7, because with a constant H eq. 19 has the exact and
    useless solution (0, ..., 0, H); and c_x, c_y are divided by the cosines, as k_x = 1/(c_x cos phi cos theta) under
    eq. 3 demands, where eq. 21 multiplies.

    Parameters
    ----------
    v: (9,) V1 to V9 of eq. 18 for a field of unit strength, V10 = R7 having been taken to the right.

    Returns
    -------
    (9,) theta, phi, psi in rad, c_x, c_y, c_z, i_x, i_y, i_z (the offsets in units of the field).
    """
    v1, v2, v3, v4, v5, v6, v7, v8, v9 = v
    k_m, k_g = v7 / (2 * v4), v8 / (2 * v4)
    k_n = (v9 - 2 * v4 * k_m * k_g) / (2 * (v5 - v4 * k_m**2))
    r1, r2 = v4, v1
    r3, r4 = v5 - v4 * k_m**2, v2 - v1 * k_m
    r5 = v6 - v5 * k_n**2 - v4 * (k_g**2 - k_m**2 * k_n**2)
    r6 = v3 - v2 * k_n - v1 * (k_g - k_m * k_n)
    theta = -np.arctan(k_m * np.sqrt(r1 / r3))
    psi = -np.arctan(k_n * np.sqrt(r3 / r5))
    phi = np.arctan(np.cos(theta) * (np.tan(theta) * np.tan(psi) - k_g * np.sqrt(r1 / r5)))
    c_x = np.sqrt(1 / r1) / (np.cos(phi) * np.cos(theta))
    c_y = np.sqrt(1 / r3) / np.cos(psi)
    c_z = np.sqrt(1 / r5)
    i_z = -r6 / (2 * r5)
    i_y = -r4 / (2 * r3) + k_n * r6 / (2 * r5)
    i_x = -r2 / (2 * r1) + k_m * r4 / (2 * r3) + (k_g - k_m * k_n) * r6 / (2 * r5)
    return np.array([theta, phi, psi, c_x, c_y, c_z, i_x, i_y, i_z])


@method("calibrate_scalar", source="Li et al. 2018, section 3.3, eqs. 15-21")
def li2018_linear(raw: Array, total_field: Array, *, worst_error: WorstError = WORST_ERROR) -> SensorCalibration:
    """Nine parameters of one sensor from a linear system by two nonlinear conversions.

    Parameters
    ----------
    raw: (N, 3) nT, with its zero well inside the ellipsoid; total_field: (N,) nT.

    Raises
    ------
    NotEnoughData: the attitudes do not determine the parameters; the message says which are missing.
    """
    from magtensor.calibration.factors import CHOLESKY
    from magtensor.calibration.parameters import LI, response
    from magtensor.calibration.quadric import constant_term_normalised
    from magtensor.calibration.scalar import checked_samples, corrected, fit_or_refuse, judged

    raw, total_field = checked_samples(raw, total_field)
    ellipsoid = fit_or_refuse(raw, total_field, constant_term_normalised)
    unit = float(np.mean(total_field))
    a = ellipsoid.shape
    linear = -2 * a @ ellipsoid.offset / unit
    v = np.array([*linear, *np.diag(a), 2 * a[0, 1], 2 * a[0, 2], 2 * a[1, 2]])
    nine = nine_parameters(v)
    nine[6:] *= unit
    c, offset = response(np.concatenate([nine, np.zeros(3)]), LI)
    matrix: Array = np.asarray(np.linalg.inv(c), dtype=np.float64)
    seen = judged(raw, total_field, matrix, offset, worst_error)
    return corrected(raw, total_field, matrix, offset, CHOLESKY, seen)


@method("calibrate_array", source="Li et al. 2018, sections 3.2 and 3.3, eqs. 2, 7-21")
def li2018(raw: Array, total_field: Array, *, worst_error: WorstError = WORST_ERROR) -> ArrayCalibration:
    """Every sensor fitted to the calibrated mean of all, twelve parameters each, by Levenberg-Marquardt.

    The frame is the mean sensor's own: common to all sensors, but turned against the platform by an angle that
    no uniform field shows.

    Parameters
    ----------
    raw: (N, S, 3) nT in a field uniform over the array; total_field: (N,) nT.

    Raises
    ------
    NotEnoughData: the attitudes do not determine the parameters; the message says which are missing.
    DataError: inverted, swapped or differently ordered axes, named.
    """
    from magtensor.calibration.artificial import calibrate_to_mean

    return calibrate_to_mean(raw, total_field, lambda m, f: li2018_linear(m, f, worst_error=worst_error))


@method("calibrate_vector", source="Li et al. 2018, section 3.2, eqs. 7-14")
def li2018_lm(raw: Array, field: Array, *, worst_error: WorstError = WORST_ERROR) -> SensorCalibration:
    """Twelve parameters against a known platform vector, by Levenberg-Marquardt.

    Parameters
    ----------
    raw: (N, 3) nT; field: (N, 3) nT, known, in the platform frame.

    Raises
    ------
    NotEnoughData: the field did not leave a plane, or too few samples.
    DataError: the sensor mirrors the field.
    """
    from magtensor.calibration.vector import li_vector_calibration

    return li_vector_calibration(raw, field, worst_error)
