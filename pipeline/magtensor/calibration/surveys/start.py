"""Where the fit of several surveys begins: an algebraic ellipsoid, or a regression on a known field."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.factors import upper
from magtensor.calibration.maximum_likelihood import algebraic_start
from magtensor.calibration.quadric import NotAnEllipsoid, design, restricted, shape_matrix
from magtensor.calibration.types import Array
from magtensor.errors import NotEnoughData

from .sums import Found, InPlane, minimised, summed

LEAST_LEAVING = 2e-3  # of F: what leaves the plane less is the field's variation and the attitude's error


def on_known_field(data: InPlane, direction: Array) -> tuple[Array, Array]:
    """Matrix (3, 3) and centres (K, 3) by regression of y on the known field.

    Raises
    ------
    NotEnoughData: the field did not leave a plane.
    """
    field = direction * data.total_field[:, None]
    x, y = np.empty_like(field), np.empty_like(field)
    means = np.empty((2, data.centres, 3))
    for k in range(data.centres):
        own = data.centre == k
        means[0, k], means[1, k] = field[own].mean(axis=0), data.y[own].mean(axis=0)
        x[own], y[own] = field[own] - means[0, k], data.y[own] - means[1, k]
    values = np.linalg.eigvalsh(x.T @ x)
    if np.sqrt(values[0] / len(x)) <= LEAST_LEAVING * np.mean(data.total_field):
        raise NotEnoughData(
            "the field did not leave a plane in the platform's frame", hint="turn the platform about a second axis"
        )
    forward = np.linalg.lstsq(x, y, rcond=None)[0].T
    matrix: Array = np.asarray(np.linalg.inv(forward), dtype=np.float64)
    return matrix, means[1] - means[0] @ forward.T


def on_ellipsoid(data: InPlane, shifts: Array) -> Found:
    """The fit of least cost from an ellipsoid that all surveys share, or from one with a centre for each.

    Parameters
    ----------
    shifts: (K, 3), what was taken off y before.

    Raises
    ------
    NotEnoughData: no start, or none from which the fit converges.
    """
    starts: list[tuple[Array, Array]] = []
    try:
        shared = algebraic_start(data.y + shifts[data.centre], data.total_field)
        starts.append((upper(shared.shape), shared.offset - shifts))
    except NotAnEllipsoid as error:
        refused = error
    if data.centres > 1:
        try:
            starts.append(_with_centres(data))
        except NotAnEllipsoid as error:
            refused = error
    if not starts:
        raise refused
    costs = [summed(data, *start).cost for start in starts]
    for at in np.argsort(costs):
        try:
            return minimised(data, *starts[at])
        except NotEnoughData as error:
            last = error
    raise last


def _with_centres(data: InPlane) -> tuple[Array, Array]:
    """One shape, a centre and a constant for each survey (Chi 2017 eq. 10 with its last four coefficients doubled
    for every survey)."""
    unit = float(np.mean(np.abs(data.y)))
    parts = []
    for k in range(data.centres):
        full = design(data.y[data.centre == k] / unit)
        low, quadratic = full[:, 6:], full[:, :6]
        tail = np.linalg.lstsq(low, quadratic, rcond=None)[0]
        parts.append((tail, quadratic - low @ tail))
    rest = np.concatenate([left for _, left in parts])
    leading = restricted(np.asarray(np.linalg.qr(rest, mode="r")))
    shape = shape_matrix(leading)
    sign = np.sign(np.trace(shape))
    centres, factors, weights = np.empty((data.centres, 3)), [], []
    for k, (tail, _) in enumerate(parts):
        own = data.centre == k
        last = -tail @ leading
        centres[k] = -np.linalg.solve(shape, last[:3])
        size = float(centres[k] @ shape @ centres[k] - last[3])
        factors.append(size / float(np.mean(data.total_field[own] ** 2)) * unit**2)
        weights.append(float(own.sum()))
    factor = float(np.average(factors, weights=weights))
    if not np.isfinite(factor) or sign * factor <= 0:
        raise NotAnEllipsoid("the quadric that fits the raw output best has no real point")
    return upper(shape / factor), centres * unit
