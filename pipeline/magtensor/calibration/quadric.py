"""Quadric surfaces through raw output: the algebraic fits of the scalar methods.

In a field of constant intensity F the raw output m lies on (m - o)^T A (m - o) = F^2 (Chi 2017 eqs. 7-14). The
fits work on x = m / F, so that every column of the design is of order one; the ten coefficients are ordered as in
Chi 2017 eq. 10: a, b, c, f, g, h, p, q, r, d.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from magtensor.errors import NotEnoughData

from .types import Array

Fit = Callable[[Array], Array]

SETTLED = 1e-10  # of the field: a step of the fixed point of `fit_ellipsoid` that is none
ROUNDED = 1e-6  # of the field: below this, steps that shrink no more are the rounding of the fit


class NotAnEllipsoid(NotEnoughData):
    """The quadric that fits the samples best is open (a hyperboloid, a paraboloid, a cylinder or planes)."""


@dataclass(frozen=True)
class Ellipsoid:
    """(m - offset)^T shape (m - offset) = F^2, with shape (3, 3) dimensionless and offset (3,) nT."""

    shape: Array
    offset: Array


def design(x: Array) -> Array:
    """Rows (N, 10) of Chi 2017 eq. 11 for points x (N, 3)."""
    x1, x2, x3 = x.T
    return np.column_stack(
        [x1**2, x2**2, x3**2, 2 * x2 * x3, 2 * x1 * x3, 2 * x1 * x2, 2 * x1, 2 * x2, 2 * x3, np.ones(len(x))]
    )


def shape_matrix(p: Array) -> Array:
    """The symmetric matrix (3, 3) of the six leading coefficients, Chi 2017 eq. 12."""
    a, b, c, f, g, h = p[:6]
    return np.array([[a, h, g], [h, b, f], [g, f, c]])


def ellipsoid_of(p: Array) -> Ellipsoid:
    """The ellipsoid (in units of the field) of ten coefficients known up to a common factor.

    Chi 2017 eqs. 12-14; the factor that eq. 14 needs follows from |B| = 1: A = A0 / (o^T A0 o - d).

    Raises
    ------
    NotAnEllipsoid: the surface is open or has no real point.
    """
    a = shape_matrix(p)
    values = np.linalg.eigvalsh(a)
    if not np.all(np.isfinite(values)) or values[0] * values[2] <= 0 or values[1] * values[2] <= 0:
        raise NotAnEllipsoid("the quadric that fits the raw output best is not an ellipsoid")
    offset: Array = np.asarray(-np.linalg.solve(a, p[6:9]), dtype=np.float64)
    factor = float(offset @ a @ offset - p[9])
    shape = a / factor if factor != 0 else np.full((3, 3), np.nan)
    if not np.all(np.isfinite(shape)) or shape[0, 0] <= 0:
        raise NotAnEllipsoid("the quadric that fits the raw output best has no real point")
    return Ellipsoid(shape, offset)


def design_derivative(x: Array, axis: int) -> Array:
    """Derivative (N, 10) of `design` along one coordinate of the points x (N, 3)."""
    out = np.zeros((len(x), 10))
    out[:, axis] = 2 * x[:, axis]
    for column, (i, j) in ((3, (1, 2)), (4, (0, 2)), (5, (0, 1))):
        if axis == i:
            out[:, column] = 2 * x[:, j]
        elif axis == j:
            out[:, column] = 2 * x[:, i]
    out[:, 6 + axis] = 2.0
    return out


@dataclass(frozen=True)
class NearestQuadrics:
    """The quadrics that points lie nearest to, by Taubin's distance: algebraic over gradient, both squared means.

    Attributes:
        distance: (9,) root-mean-square distance of the points to each, ascending, in the points' unit. Noise of
            standard deviation s about a quadric puts its distance at s.
        coefficients: (10,) of the nearest.
    """

    distance: Array
    coefficients: Array


def nearest_quadrics(x: Array) -> NearestQuadrics:
    """Quadrics through points x (N, 3), in order of Taubin's distance. The points are read in chunks."""
    from scipy.linalg import eigh

    centre = x.mean(axis=0)
    spread = float(np.sqrt(np.mean((x - centre) ** 2)))
    if spread == 0.0:
        return NearestQuadrics(np.zeros(9), np.full(10, np.nan))
    gradients, gram, total = np.zeros((9, 9)), np.zeros((9, 9)), np.zeros(9)
    for start in range(0, len(x), 65536):
        part = (x[start : start + 65536] - centre) / spread
        rows = design(part)[:, :9]
        total += rows.sum(axis=0)
        gram += rows.T @ rows
        for axis in range(3):
            g = design_derivative(part, axis)[:, :9]
            gradients += g.T @ g
    mean = total / len(x)
    # the constant term is free: its best value takes the mean away
    centred = gram / len(x) - np.outer(mean, mean)
    # a quadric whose gradient vanishes on all samples (a double plane) would be zero over zero
    floor = 1e-13 * np.trace(gradients) / len(x) * np.eye(9)
    values, vectors = eigh(centred, gradients / len(x) + floor)
    v = vectors[:, 0]
    a, linear = shape_matrix(v) / spread**2, v[6:9] / spread
    shifted = linear - a @ centre
    constant = -mean @ v - 2 * linear @ centre + centre @ a @ centre
    coefficients = np.array([*np.diag(a), a[1, 2], a[0, 2], a[0, 1], *shifted, constant])
    return NearestQuadrics(np.sqrt(np.maximum(values, 0.0)) * spread, coefficients)


def gradient_normalised(x: Array) -> Array:
    """Coefficients (10,) with the least Taubin distance to points x (N, 3).

    The constraint, a unit mean squared gradient, has the form of the noise that the points bring into the normal
    equations, so the two cancel and the fit has no bias in the first order of the noise variance.
    """
    return nearest_quadrics(x).coefficients


def constant_term_normalised(x: Array) -> Array:
    """Coefficients (10,) with d = -1: the linear system of Li 2018 eqs. 18-19 in the form that has a solution.

    As printed, with the constant term V10 = R7 unknown on the left and the constant H on the right, the exact
    solution is V = (0, ..., 0, H). Taking the constant to the right and dividing by H - R7 leaves nine unknowns
    and no trivial solution. The origin of the raw output must lie well inside the ellipsoid.
    """
    nine = np.linalg.lstsq(design(x)[:, :9], np.ones(len(x)), rcond=None)[0]
    return np.append(nine, -1.0)


def ellipsoid_restricted(x: Array) -> Array:
    """Coefficients (10,) of the least squares fit under an ellipsoid restriction (Chi 2017, abstract and eq. 11).

    Chi names the restriction and does not print it. Used here is k J - I^2 = 1 with I = a + b + c and
    J = ab + bc + ca - f^2 - g^2 - h^2, which at k = 4 admits ellipsoids alone and at larger k more slender ones
    (Li and Griffiths 2004): from a large k downwards, the first whose solution is an ellipsoid.

    A quadric that the attitudes hardly determine, of algebraic distance t, is mixed in with a share of about
    (noise / t)^2, because it changes J: with small tilts the bias exceeds the scatter. See `gradient_normalised`.

    Raises
    ------
    NotAnEllipsoid: not even k = 4 gives one (the samples are degenerate).
    """
    full = design(x)
    triangle = np.asarray(np.linalg.qr(np.column_stack([full[:, 6:], full[:, :6]]), mode="r"))
    low, mixed, quad = triangle[:4, :4], triangle[:4, 4:], triangle[4:, 4:]
    leading = restricted(quad)
    tail = -np.linalg.lstsq(low, mixed @ leading, rcond=None)[0]
    return np.concatenate([leading, tail])


def restricted(quadratic: Array) -> Array:
    """The six leading coefficients of the ellipsoid of least algebraic distance, under the restriction of
    `ellipsoid_restricted`, from the rows (n, 6) that are left of the quadratic columns of the design once the others
    have been projected off.

    Raises
    ------
    NotAnEllipsoid: as there.
    """
    _, s, vt = np.linalg.svd(quadratic, full_matrices=False)
    # without noise the smallest singular value is rounding; a floor keeps the division finite
    back = vt.T / np.maximum(s, s[0] * 1e-15)
    for k in (256.0, 64.0, 16.0, 8.0, 4.0):
        restriction = np.diag([-1.0, -1, -1, -k, -k, -k])
        restriction[:3, :3] += (k / 2 - 1) * (1 - np.eye(3))
        values, vectors = np.linalg.eigh(back.T @ restriction @ back)
        leading: Array = back @ vectors[:, -1]
        if values[-1] <= 0 or not np.all(np.isfinite(leading)):
            continue
        leading /= np.linalg.norm(leading)
        signs = np.linalg.eigvalsh(shape_matrix(leading))
        if signs[0] * signs[2] > 0:
            return leading
    raise NotAnEllipsoid("no ellipsoid fits the raw output")


def fit_ellipsoid(raw: Array, total_field: Array, fit: Fit) -> Ellipsoid:
    """Fit an ellipsoid where the total field may differ from sample to sample.

    Each sample is moved along its radius from the centre to where it would lie in the mean field, and the fit
    repeated until the centre rests: the fixed point minimises the algebraic distance of the F-normalised model.
    It rests where a step is below `SETTLED`, or, once all steps are below `ROUNDED`, where they shrink no more: what
    is left then is the rounding of the fit itself. With a constant field the first fit is final.

    Parameters
    ----------
    raw: (N, 3) nT.
    total_field: (N,) nT, positive.
    fit: one of the fits of this module, from points to ten coefficients.

    Raises
    ------
    NotAnEllipsoid: the best quadric is not an ellipsoid.
    """
    field = float(np.mean(total_field))
    stretch = (field / total_field)[:, None]
    constant = bool(np.all(total_field == total_field[0]))
    centre = np.zeros(3)
    before = np.inf
    for _ in range(100):
        found = ellipsoid_of(fit((centre + (raw - centre) * stretch) / field))
        step = float(np.linalg.norm(found.offset - centre / field))
        centre = found.offset * field
        if constant or step < SETTLED or before <= step < ROUNDED:
            return Ellipsoid(found.shape, centre)
        before = step
    raise NotAnEllipsoid(
        "the ellipsoid's centre does not settle under this variation of the total field",
        hint="check that the reference total field belongs to these samples",
    )
