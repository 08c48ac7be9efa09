"""The ellipsoid by maximum likelihood: unbiased where the attitudes cover little.

A sample y = B b + c + noise (unit variance on every coordinate) with |b| = F known has the least squared distance
(|U (y - c)| - F)^2 / (u' U U' u + s_F^2) to the surface, to first order in noise over F; u is the direction of the
field, U = B^-1, s_F the noise of the reference. That distance, with its denominator differentiated too, is
minimised. Leaving the denominator out of the derivative, or out altogether, shrinks U to shrink the noise: the
attenuation of METHODS A4.7.

The step is Fisher's scoring: the gradient is exact, the normal matrix is the expected one, which the noise of the
samples does not enter. Parameters are small changes of the field itself, b -> b + E b + e with E symmetric, so that no
factor of the ellipsoid's matrix is preferred; in order E_xx, E_yy, E_zz, E_yz, E_xz, E_xy, e_x, e_y, e_z.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from magtensor.errors import NotEnoughData

from .factors import upper
from .quadric import Ellipsoid, NotAnEllipsoid, ellipsoid_restricted, fit_ellipsoid
from .types import Array

START_SAMPLES = (4_000, 20_000)  # the algebraic fit is only where the iteration begins; more where few give none
CHUNK = 8192  # samples worked on at a time: their columns stay in the processor's cache
PAIRS = ((1, 2), (0, 2), (0, 1))
WEIGHTS = np.array([1.0, 1, 1, 2, 2, 2, 1, 1, 1])  # an off-diagonal element of E counts twice
_TWICE = np.outer(WEIGHTS, WEIGHTS)
_ELEMENTS = (np.array([0, 1, 2, 1, 0, 0]), np.array([0, 1, 2, 2, 2, 1]))  # of a symmetric matrix, as in E
_SYMMETRIC = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])  # and back
_MOMENTS = np.array([[0, 5, 4, 6], [5, 1, 3, 7], [4, 3, 2, 8], [6, 7, 8, 0]])  # of (field, 1), the last element apart
_COLUMNS = 4096


@dataclass(frozen=True)
class Scores:
    """What samples say of the parameters, as sums over them.

    Attributes:
        samples: how many.
        cost: sum of the squared whitened residuals.
        gradient: (9,) half the derivative of the cost.
        normal: (9, 9) expected information; E dimensionless, e in nT.
        moments: (4, 4) sum of z z' with z = (field, 1), the field in nT at the foot points u F.
    """

    samples: int
    cost: float
    gradient: Array
    normal: Array
    moments: Array

    @property
    def rounding(self) -> float:
        """What rounding makes of a squared whitened residual: the square of some 50 units in the last place of F."""
        return 1e-28 * float(np.trace(self.moments[:3, :3]) * np.trace(self.normal[6:, 6:])) / self.samples**2

    def __add__(self, other: Scores) -> Scores:
        return Scores(
            self.samples + other.samples,
            self.cost + other.cost,
            self.gradient + other.gradient,
            self.normal + other.normal,
            self.moments + other.moments,
        )


NOTHING = Scores(0, 0.0, np.zeros(9), np.zeros((9, 9)), np.zeros((4, 4)))


@dataclass(frozen=True)
class ScalarFit:
    """b = matrix @ (y - offset), b known up to a rotation.

    Attributes:
        matrix: (3, 3) nT per unit of y; offset: (3,) in units of y.
        chi2: mean square of the whitened residual per degree of freedom.
        scores: of the samples that were used, at these parameters.
    """

    matrix: Array
    offset: Array
    chi2: float
    scores: Scores

    def field(self, y: Array) -> Array:
        """(N, 3) nT for y (N, 3)."""
        out: Array = (y - self.offset) @ self.matrix.T
        return out

    def with_noise(self, factor: float) -> ScalarFit:
        """The same fit in coordinates y / factor, whose noise has unit variance where that of y is factor times."""
        here = self.scores
        scaled = replace(
            here,
            cost=here.cost / factor**2,
            gradient=here.gradient / factor**2,
            normal=here.normal / factor**2,
        )
        return ScalarFit(self.matrix * factor, self.offset / factor, self.chi2 / factor**2, scaled)


@dataclass(frozen=True)
class Along:
    """Samples seen along the field; arrays of columns, (3, n) or (n,).

    Attributes:
        stretch: K = U U' (3, 3).
        field: b nT; products: (6, n) nT^2, b_i b_j in order xx, yy, zz, yz, xz, xy; squared: |b|^2; length: |b| nT.
        own: u' K u nT^2 with u the direction of b: what the noise of y adds to the variance of |b|.
        inverse_std: 1/nT, of |b| - F.
        residual: whitened.
    """

    stretch: Array
    field: Array
    products: Array
    squared: Array
    length: Array
    own: Array
    inverse_std: Array
    residual: Array

    @property
    def unit(self) -> Array:
        """(3, n) u."""
        out: Array = self.field / self.length
        return out

    @property
    def turned(self) -> Array:
        """(3, n) K u."""
        out: Array = self.stretch @ self.unit
        return out


def along(matrix: Array, offset: Array, y: Array, total_field: Array, reference_noise: float) -> Along:
    """The whitened residual of samples y (3, n) with total field (n,) nT, and what its derivative needs."""
    stretch = matrix @ matrix.T
    field = matrix @ y
    field -= (matrix @ offset)[:, None]
    products = np.empty((6, field.shape[1]))
    np.multiply(field, field, out=products[:3])
    for k, (i, j) in enumerate(PAIRS):
        np.multiply(field[i], field[j], out=products[3 + k])
    squared, own = np.array([[1.0, 1, 1, 0, 0, 0], stretch[_ELEMENTS] * WEIGHTS[:6]]) @ products
    own /= squared
    length = np.sqrt(squared)
    inverse_std = own + reference_noise**2
    np.sqrt(inverse_std, out=inverse_std)
    np.divide(1.0, inverse_std, out=inverse_std)
    residual = length - total_field
    residual *= inverse_std
    return Along(stretch, field, products, squared, length, own, inverse_std, residual)


def scores(seen: Along, total_field: Array) -> Scores:
    """The sums of samples seen along the field, total_field (n,) nT."""
    return scores_of_blocks(seen, total_field, (0, len(total_field)))[0]


def scores_of_blocks(seen: Along, total_field: Array, edges: Sequence[int]) -> list[Scores]:
    """The sums of samples seen along the field, total_field (n,) nT, from each edge to the next.

    With s = inverse_std the residual changes by s |b| u'E u + s u'e, to first order in the noise s F u'E u + s u'e, and
    std^2 / 2 by (2 K u - own u)'E u + (K u - own u)'e / |b|. Both are linear in s F u_i u_j and s u_i, so that all
    sums are products of these nine rows, with each other and with six columns of weights.
    """
    r, s, length = seen.residual, seen.inverse_std, seen.length
    everything = np.empty((14, len(r)))
    rows, (foot, shape, shape_turned, shift, shift_turned) = everything[:9], everything[9:]
    np.multiply(seen.products, total_field * s / seen.squared, out=rows[:6])
    np.multiply(seen.field, s / length, out=rows[6:])
    np.divide(total_field, s, out=foot)
    spread = r * r
    spread *= s
    np.divide(spread, total_field, out=shape_turned)
    np.divide(spread, length, out=shift_turned)
    np.divide(length, total_field, out=shape)
    shape *= r
    shape += np.multiply(shape_turned, seen.own, out=spread)
    np.multiply(shift_turned, seen.own, out=shift)
    shift += r
    found = []
    for start, stop in pairwise(edges):
        part = slice(start, stop)
        sums = products_of(everything, 9, start, stop)
        by_foot, by_shape, by_shape_turned, by_shift, by_shift_turned = sums[:, 9:].T
        turned = seen.stretch @ by_shape_turned[_SYMMETRIC]
        gradient = by_shape * WEIGHTS
        gradient[:6] -= (turned + turned.T)[_ELEMENTS] * WEIGHTS[:6]
        gradient[6:] = by_shift[6:] - seen.stretch @ by_shift_turned[6:]
        moments = by_foot[_MOMENTS]
        moments[3, 3] = stop - start
        cost = float(r[part] @ r[part])
        found.append(Scores(int(stop - start), cost, gradient, sums[:, :9] * _TWICE, moments))
    return found


def products_of(rows: Array, some: int, start: int, stop: int) -> Array:
    """(some, K) products of the first rows of (K, n) with all of them, summed from start to stop.

    A few thousand columns at a time, and never a matrix with its own transpose alone: BLAS is two to three times slower
    at both.
    """
    total = np.zeros((some, len(rows)))
    for first in range(start, stop, _COLUMNS):
        part = rows[:, first : min(first + _COLUMNS, stop)]
        total += part[:some] @ part.T
    return total


def fit_scalar(y: Array, total_field: Array, reference_noise: float = 0.0, complete: bool = True) -> ScalarFit:
    """Fit matrix and offset by maximum likelihood, started from the algebraic ellipsoid.

    Parameters
    ----------
    y: (N, 3), noise of unit variance on every coordinate.
    total_field: (N,) nT.
    reference_noise: nT, of the total field.
    complete: the model holds all there is. Where it does not, a likelihood that an effect without a model has left
        without a maximum is no refusal: the algebraic ellipsoid will do until the effect is known.

    Raises
    ------
    NotEnoughData: the algebraic fit is no ellipsoid, the normal equations are singular, or it does not converge.
    """
    found = algebraic_start(y, total_field)

    def at(matrix: Array, offset: Array) -> Scores:
        total = NOTHING
        for start in range(0, len(y), CHUNK):
            part = slice(start, start + CHUNK)
            seen = along(matrix, offset, y[part].T, total_field[part], reference_noise)
            total += scores(seen, total_field[part])
        return total

    matrix, offset = upper(found.shape), found.offset
    try:
        return minimised(matrix, offset, at)
    except NotEnoughData:
        if complete:
            raise
        begun = at(matrix, offset)
        return ScalarFit(matrix, offset, begun.cost / max(begun.samples - 9, 1), begun)


def algebraic_start(y: Array, total_field: Array) -> Ellipsoid:
    """The algebraic ellipsoid of some of the samples, of more where few give none.

    Raises
    ------
    NotAnEllipsoid: there is none.
    """
    few, more = (slice(None, None, max(1, len(y) // samples)) for samples in START_SAMPLES)
    try:
        return fit_ellipsoid(y[few], total_field[few], ellipsoid_restricted)
    except NotAnEllipsoid:
        return fit_ellipsoid(y[more], total_field[more], ellipsoid_restricted)


def minimised(
    matrix: Array, offset: Array, at: Callable[[Array, Array], Scores], most_iterations: int = 60
) -> ScalarFit:
    """The parameters of least cost, by damped scoring from a start.

    Parameters
    ----------
    at: the scores at a matrix and an offset.

    Raises
    ------
    NotEnoughData: the normal equations are singular, or it does not converge.
    """
    here, damping = at(matrix, offset), 0.0
    for _ in range(most_iterations):
        try:
            step, expected = scoring_step(here)
        except np.linalg.LinAlgError as error:
            raise NotEnoughData("the samples leave a parameter of the scalar fit open", hint="add attitudes") from error
        chi2 = here.cost / max(here.samples - 9, 1)
        if expected < max(1e-8 * chi2, here.rounding):  # less than 1e-4 of the parameters' standard deviations
            return ScalarFit(matrix, offset, chi2, here)
        if damping:
            step, _ = scoring_step(here, damping)
        moved = stepped(matrix, offset, step)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # a step too far is not taken
            there = at(*moved)
        if np.isfinite(there.cost) and there.cost <= here.cost * (1 + 1e-12):
            (matrix, offset), here, damping = moved, there, damping / 10 if damping > 1e-9 else 0.0
            continue
        damping = max(10 * damping, 1e-6)
        if damping > 1e6:
            break
    raise NotEnoughData("the scalar fit does not converge", hint="look for disturbed samples, or add attitudes")


class Slope(Protocol):
    """What a step of scoring asks of the sums over samples: half the cost's derivative, and the information."""

    @property
    def gradient(self) -> Array: ...

    @property
    def normal(self) -> Array: ...


def scoring_step(here: Slope, damping: float = 0.0) -> tuple[Array, float]:
    """The step of the parameters, and twice the decrease of the cost that it promises: its squared length in
    standard deviations.

    Raises
    ------
    NotEnoughData: a parameter that no sample depends on.
    """
    scale = np.sqrt(np.diag(here.normal))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise NotEnoughData("the scalar fit has a parameter that no sample depends on")
    scaled = here.normal / np.outer(scale, scale)
    step: Array = -np.linalg.solve(scaled + damping * np.eye(len(scale)), here.gradient / scale) / scale
    return step, -float(here.gradient @ step)


def stepped(matrix: Array, offset: Array, step: Array) -> tuple[Array, Array]:
    """Matrix and offset after the field has been changed to b + E b + e."""
    change = np.diag(1.0 + step[:3])
    for value, (i, j) in zip(step[3:6], PAIRS, strict=True):
        change[i, j] = change[j, i] = value
    moved = change @ matrix
    return moved, offset - np.linalg.solve(moved, step[6:])
