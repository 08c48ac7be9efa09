"""Scalar calibration of one sensor: from samples and an algebraic fit to a correction with its covariance."""

from __future__ import annotations

import numpy as np

from magtensor.errors import DataError, MissingAttitudes, NotEnoughData

from .covariance import residual, scalar_influence, scalar_noise
from .coverage import LEAST_SAMPLES, WORST_ERROR, Coverage, coverage, require_coverage
from .factors import factor
from .quadric import Ellipsoid, Fit, NotAnEllipsoid, fit_ellipsoid
from .types import Array, SensorCalibration


def checked_samples(raw: Array, total_field: Array) -> tuple[Array, Array]:
    """The samples as float arrays (N, 3) and (N,), refused where no fit could use them.

    Raises
    ------
    MissingAttitudes: fewer than ten samples.
    DataError: a value that is not finite, or a total field that is not positive.
    """
    raw, total_field = np.asarray(raw, dtype=float), np.asarray(total_field, dtype=float)
    if raw.ndim != 2 or raw.shape[1] != 3 or total_field.shape != raw.shape[:1]:
        raise ValueError(f"raw {raw.shape} and total_field {total_field.shape} are not (N, 3) and (N,)")
    if len(raw) < LEAST_SAMPLES:
        raise MissingAttitudes(
            f"{len(raw)} samples cannot determine nine parameters and their errors",
            hint=f"at least {LEAST_SAMPLES} samples in nine different attitudes are needed",
        )
    if not (np.isfinite(raw).all() and np.isfinite(total_field).all()):
        raise DataError("the samples are not all finite", hint="mask the gaps before calibrating")
    if total_field.min() <= 0:
        raise DataError("the reference total field is not positive", hint="the total field must be in nT")
    return raw, total_field


def fit_or_refuse(raw: Array, total_field: Array, fit: Fit) -> Ellipsoid:
    """The ellipsoid of checked samples; where there is none, a refusal that says which attitudes are missing.

    Raises
    ------
    NotEnoughData: the best quadric is not an ellipsoid.
    """
    try:
        return fit_ellipsoid(raw, total_field, fit)
    except NotAnEllipsoid as error:
        require_coverage(coverage(raw, total_field))
        raise NotEnoughData(
            f"{error.what}, though the attitudes would determine one",
            hint="look for a dead, stuck, saturated or disturbed axis",
        ) from error


def calibrate(
    raw: Array, total_field: Array, fit: Fit, frame: str, worst_error: float = WORST_ERROR
) -> SensorCalibration:
    """Calibrate one sensor by an ellipsoid fit and a factor of its matrix.

    Parameters
    ----------
    raw: (N, 3) nT.
    total_field: (N,) nT, may differ from sample to sample.
    fit: one of the fits of `quadric`.
    frame: "cholesky" or "polar": which factor of the matrix is the correction.
    worst_error: see `coverage.coverage`.

    Raises
    ------
    NotEnoughData: the attitudes do not determine the nine parameters; the message says which are missing.
    DataError: values that no fit can use.
    """
    raw, total_field = checked_samples(raw, total_field)
    ellipsoid = fit_or_refuse(raw, total_field, fit)
    matrix = factor(ellipsoid.shape, frame)
    seen = judged(raw, total_field, matrix, ellipsoid.offset, worst_error)
    return corrected(raw, total_field, matrix, ellipsoid.offset, frame, seen)


def judged(raw: Array, total_field: Array, matrix: Array, offset: Array, worst_error: float) -> Coverage:
    """The coverage of samples with their fit, once it has been found sufficient.

    Raises
    ------
    NotEnoughData: as in `calibrate`.
    """
    seen = coverage(raw, total_field, matrix=matrix, offset=offset, worst_error=worst_error)
    require_coverage(seen)
    return seen


def corrected(
    raw: Array, total_field: Array, matrix: Array, offset: Array, frame: str, seen: Coverage
) -> SensorCalibration:
    """A fitted correction with its covariance and the figures that go with it."""
    noise = scalar_noise(matrix, offset, raw, total_field)
    influence = scalar_influence(matrix, offset, raw, total_field, frame)
    r = residual(matrix, offset, raw, total_field)
    return SensorCalibration(
        matrix,
        offset,
        influence.covariance(noise),
        frame,
        float(np.sqrt(np.mean(r**2))),
        {
            "noise_nT": noise,
            "condition_number": seen.condition_number,
            "second_quadric_nT": seen.second_distance,
            "worst_error_nT": seen.worst_error,
            "missing_attitudes": seen.missing,
        },
    )
