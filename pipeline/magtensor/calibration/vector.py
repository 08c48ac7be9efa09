"""Vector calibration: twelve parameters of one sensor from a field known in the platform frame.

Raw output m = C b + o. Linear regression puts the error on m, where the noise is. Li 2018 (eqs. 7-14) puts it on
the calibrated field, B - T M (m - I), and minimises over scale factors, angles and offsets by Levenberg-Marquardt.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.errors import DataError, NotEnoughData

from .coverage import WORST_ERROR
from .parameters import LI, response, response_derivatives
from .types import Array, SensorCalibration

PLATFORM = "platform"
HUBER = 2.33  # vectors longer than this many standard deviations of a component count less: 14 % of normal noise


@dataclass(frozen=True)
class Linear:
    """A regression y = W^T z with z = (x, 1): coefficients (4, 3), noise per component, and (Z^T W Z)^-1 (4, 4)."""

    coefficients: Array
    noise: float
    inverse: Array


def require_spatial(vectors: Array, noise: float, worst_error: float = WORST_ERROR) -> None:
    """Refuse regressors (N, 3) nT that do not determine twelve parameters.

    Parameters
    ----------
    vectors: the regressor; noise: nT, per component, of what the regression leaves.
    worst_error: accepted predicted standard deviation of the field in the worst direction, as a fraction of F.

    Raises
    ------
    NotEnoughData: the vectors lie in a plane, on a line, or nearly so; the message gives the direction.
    """
    size = float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
    centred = vectors - vectors.mean(axis=0)
    values, axes = np.linalg.eigh(centred.T @ centred)
    spread = float(np.sqrt(max(values[0], 0.0) / len(vectors)))
    error = noise * size / (np.sqrt(len(vectors)) * spread) if spread > 0 else float("inf")
    if len(vectors) > 4 and spread > max(10 * noise, 1e-5 * size) and error <= worst_error * size:
        return
    x, y, z = axes[:, 0]
    raise NotEnoughData(
        f"{len(vectors)} samples of the field vector do not determine twelve parameters: along "
        f"({x:+.2f}, {y:+.2f}, {z:+.2f}) they vary by only {spread:.3g} nT (noise {noise:.3g} nT)",
        hint="more attitudes are needed, with the field turned about more than one axis",
    )


def regress(x: Array, y: Array, robust: bool = False) -> Linear:
    """Linear regression of y (N, 3) nT on x (N, 3) nT with a constant, all components equally noisy.

    With `robust`, Huber's weights on the length of the residual, iterated; the noise is then the standard
    deviation that the median residual implies for normal noise.
    """
    z = np.column_stack([x, np.ones(len(x))])
    scale = np.linalg.norm(z, axis=0)
    weights = np.ones(len(x))
    left_over = max(len(x) - 4, 1)
    for _ in range(50 if robust else 1):
        root = np.sqrt(weights)[:, None]
        coefficients = np.linalg.lstsq(root * z / scale, root * y, rcond=None)[0] / scale[:, None]
        length = np.linalg.norm(y - z @ coefficients, axis=1)
        noise = float(np.sqrt(np.sum(length**2) / (3 * left_over)))
        if not robust:
            break
        noise = float(np.median(length) / 1.5382 * np.sqrt(len(x) / left_over))  # median of chi, 3 dof
        new = np.minimum(1.0, HUBER * noise / np.maximum(length, 1e-300))
        settled = np.max(np.abs(new - weights)) < 1e-9
        weights = new
        if settled:
            break
    gram = (weights[:, None] * z / scale).T @ (z / scale)
    if robust and noise > 0:
        # Huber's asymptotic variance: mean of psi^2 over the squared mean of psi', both per component
        bounded = weights * length
        inside = np.mean(weights >= 1.0) + np.mean(np.where(weights < 1.0, weights, 0.0)) * 2 / 3
        noise = float(np.sqrt(np.sum(bounded**2) / (3 * left_over)) / inside)
        gram = (z / scale).T @ (z / scale)
    return Linear(coefficients, noise, np.linalg.pinv(gram) / np.outer(scale, scale))


def judged_regression(raw: Array, field: Array, robust: bool, worst_error: float) -> Linear:
    """Regression of raw output on the known field, refused where it does not determine a correction.

    Raises
    ------
    NotEnoughData: the field did not leave a plane, or too few samples.
    DataError: an axis that does not respond to the field.
    """
    fit = regress(field, raw, robust)
    require_spatial(field, fit.noise, worst_error)
    values = np.linalg.svd(fit.coefficients[:3], compute_uv=False)
    if values[-1] < 1e-3 * values[0]:
        raise DataError(
            "the raw output does not respond to the field in all three directions",
            hint="look for a dead or a doubled axis",
        )
    return fit


def linear_regression(raw: Array, field: Array, robust: bool, worst_error: float) -> SensorCalibration:
    """Correction to a known field by regression of the raw output on it.

    Parameters
    ----------
    raw: (N, 3) nT; field: (N, 3) nT, known, in the platform frame.
    robust: weigh outliers down (Huber).
    worst_error: see `require_spatial`.

    Raises
    ------
    NotEnoughData: the field did not leave a plane, or too few samples.
    DataError: an axis that does not respond to the field.
    """
    raw, field = checked_vectors(raw, field)
    fit = judged_regression(raw, field, robust, worst_error)
    c, offset = fit.coefficients[:3].T, fit.coefficients[3]
    matrix: Array = np.asarray(np.linalg.inv(c), dtype=np.float64)
    # parameters (C row by row, o): row a has covariance noise^2 (Z'Z)^-1 over (its three elements, its offset)
    cov = np.zeros((12, 12))
    for a in range(3):
        at = [3 * a, 3 * a + 1, 3 * a + 2, 9 + a]
        cov[np.ix_(at, at)] = fit.noise**2 * fit.inverse
    jacobian = np.eye(12)
    jacobian[:9, :9] = -np.kron(matrix, matrix.T)
    return _calibration(raw, field, matrix, offset, jacobian @ cov @ jacobian.T, {"noise_nT": fit.noise})


@dataclass(frozen=True)
class LiFit:
    """Result of Levenberg-Marquardt over Li's twelve parameters.

    Attributes:
        values: (12,) in the order of `parameters.LI`.
        matrix, offset: the correction B = matrix @ (m - offset).
        inverse: (4, 4), (Z^T Z)^-1 of the rows z = (m, 1).
        evaluations: of the residual.
    """

    values: Array
    matrix: Array
    offset: Array
    inverse: Array
    evaluations: int


def levenberg_marquardt(raw: Array, field: Array) -> LiFit:
    """Minimise sum_j |B_j - T M (m_j - I)|^2 over Li's twelve parameters (Li 2018 eqs. 7-14).

    T M (m - I) is linear in the rows z = (m, 1), so their QR factor carries all that the cost depends on: twelve
    compressed residuals take the place of 3 N, for any N. The start is the ideal sensor; where the path from there
    ends in another minimum (a sensor mounted turned), it starts again from the nearest turned sensor.

    Parameters
    ----------
    raw: (N, 3) nT; field: (N, 3) nT, the reference vector.

    Raises
    ------
    DataError: the sensor mirrors the reference (an inverted or swapped axis).
    """
    from scipy.optimize import least_squares

    unit = float(np.sqrt(np.mean(np.sum(field**2, axis=1))))
    rows = np.column_stack([raw / unit, np.ones(len(raw))])
    q, triangle = np.linalg.qr(rows)
    target = q.T @ field / unit
    closed = np.linalg.lstsq(triangle, target, rcond=None)[0]
    if np.linalg.det(closed[:3]) < 0:
        raise DataError("the sensor mirrors the reference vector", hint="an axis is inverted or two axes are swapped")
    floor = float(np.linalg.norm(target - triangle @ closed)) + 1e-7 * float(np.linalg.norm(target))
    evaluations = 0
    for start in _starts(closed[:3].T):
        found = least_squares(
            compressed_residual,
            start,
            compressed_jacobian,
            method="lm",
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
            args=(triangle, target),
        )
        evaluations += int(found.nfev)
        if np.linalg.norm(found.fun) <= floor and np.all(found.x[3:6] > 0):
            values = found.x.copy()
            values[6:9] *= unit
            c, offset = response(values, LI)
            inverse = np.linalg.inv(triangle.T @ triangle)
            scale = np.array([unit, unit, unit, 1.0])
            matrix: Array = np.asarray(np.linalg.inv(c), dtype=np.float64)
            return LiFit(values, matrix, offset, inverse / np.outer(scale, scale), evaluations)
    raise DataError("Levenberg-Marquardt did not reach the least squares solution")


def compressed_residual(values: Array, triangle: Array, target: Array) -> Array:
    """Residuals (12,) of Li's model on compressed rows; offsets in units of the field.

    Parameters
    ----------
    values: (12,) in the order of `parameters.LI`; triangle: (4, 4) and target: (4, 3) of the QR factorisation.
    """
    c, offset = response(values, LI)
    matrix = np.linalg.inv(c)
    weights = np.vstack([matrix.T, -matrix @ offset])
    out: Array = (target - triangle @ weights).ravel()
    return out


def compressed_jacobian(values: Array, triangle: Array, target: Array) -> Array:
    """Derivatives (12, 12) of `compressed_residual`."""
    c, offset = response(values, LI)
    matrix = np.linalg.inv(c)
    out = np.zeros((12, 12))
    for k, dc in enumerate(response_derivatives(values, LI)):
        d_matrix = -matrix @ dc @ matrix
        d_offset = np.eye(12)[k, 6:9]
        weights = np.vstack([d_matrix.T, -d_matrix @ offset - matrix @ d_offset])
        out[:, k] = -(triangle @ weights).ravel()
    return out


def _starts(matrix: Array) -> list[Array]:
    """The ideal sensor; then one turned by the nearest right angles; then the closed solution's own rotation."""
    from .axes import nearest_permutation
    from .parameters import parameters
    from .rotation import nearest_orthogonal, sequence_angles

    ideal = np.array([0.0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 0, 0])
    turned = ideal.copy()
    nearest = nearest_permutation(nearest_orthogonal(matrix, 1))
    if np.linalg.det(nearest) > 0:
        turned[9:] = sequence_angles(LI.sequence, nearest.T)
    closed = parameters(matrix, np.zeros(3), np.zeros((12, 12)), LI).values
    return [ideal, turned, closed]


def li_vector_calibration(raw: Array, field: Array, worst_error: float) -> SensorCalibration:
    """Correction to a known field by Li's Levenberg-Marquardt.

    Parameters and errors as in `linear_regression`; the noise is taken to be that of the raw output.
    """
    raw, field = checked_vectors(raw, field)
    judged_regression(raw, field, False, worst_error)
    fit = levenberg_marquardt(raw, field)
    miss = field - (raw - fit.offset) @ fit.matrix.T
    calibrated = float(np.sqrt(np.sum(miss**2) / (3 * max(len(raw) - 4, 1))))
    noise = calibrated * np.sqrt(3 / np.sum(fit.matrix**2))
    cov = np.kron(fit.matrix @ fit.matrix.T * noise**2, fit.inverse)
    to_correction = affine_to_correction(fit.matrix, fit.offset)
    return _calibration(
        raw,
        field,
        fit.matrix,
        fit.offset,
        to_correction @ cov @ to_correction.T,
        {"noise_nT": float(noise), "evaluations": float(fit.evaluations)},
    )


def affine_to_correction(matrix: Array, offset: Array) -> Array:
    """Derivative (12, 12) of (matrix, offset) with respect to the rows [matrix | -matrix offset] of a regression.

    The input is ordered row by row, (3, 4); the output is that of SensorCalibration.
    """
    out = np.zeros((12, 12))
    c = np.linalg.inv(matrix)
    for a in range(3):
        for k in range(4):
            column = 4 * a + k
            if k < 3:
                out[3 * a + k, column] = 1.0
                out[9:, column] = -c[:, a] * offset[k]
            else:
                out[9:, column] = -c[:, a]
    return out


def checked_vectors(raw: Array, field: Array) -> tuple[Array, Array]:
    """The samples as float arrays (N, 3), refused where a value is not finite."""
    raw, field = np.asarray(raw, dtype=float), np.asarray(field, dtype=float)
    if raw.ndim != 2 or raw.shape[1] != 3 or raw.shape != field.shape:
        raise ValueError(f"raw {raw.shape} and field {field.shape} are not both (N, 3)")
    if not (np.isfinite(raw).all() and np.isfinite(field).all()):
        raise DataError("the samples are not all finite", hint="mask the gaps before calibrating")
    if len(raw) < 5:
        raise NotEnoughData(f"{len(raw)} samples cannot determine twelve parameters and their errors")
    return raw, field


def _calibration(
    raw: Array, field: Array, matrix: Array, offset: Array, cov: Array, diagnostics: dict[str, float | str]
) -> SensorCalibration:
    b = (raw - offset) @ matrix.T
    r = np.linalg.norm(b, axis=1) - np.linalg.norm(field, axis=1)
    vector_rms = float(np.sqrt(np.mean((b - field) ** 2)))
    return SensorCalibration(
        matrix, offset, cov, PLATFORM, float(np.sqrt(np.mean(r**2))), {**diagnostics, "vector_rms_nT": vector_rms}
    )
