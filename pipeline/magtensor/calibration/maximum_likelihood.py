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
        unit: u, direction of b; length: |b| nT.
        turned: U U' u nT; own: u' U U' u nT^2, what the noise of y adds to the variance of |b|.
        inverse_std: 1/nT, of |b| - F.
        residual: whitened.
    """

    unit: Array
    length: Array
    turned: Array
    own: Array
    inverse_std: Array
    residual: Array


def along(matrix: Array, offset: Array, y: Array, total_field: Array, reference_noise: float) -> Along:
    """The whitened residual of samples y (3, n) with total field (n,) nT, and what its derivative needs."""
    unit = matrix @ y
    unit -= (matrix @ offset)[:, None]
    length = _dot(unit, unit)
    np.sqrt(length, out=length)
    unit /= length
    square = matrix @ matrix.T
    turned = np.empty_like(unit)
    for row, out in zip(square, turned, strict=True):
        np.multiply(row[0], unit[0], out=out)
        out += row[1] * unit[1]
        out += row[2] * unit[2]
    own = _dot(unit, turned)
    inverse_std = own + reference_noise**2
    np.sqrt(inverse_std, out=inverse_std)
    np.divide(1.0, inverse_std, out=inverse_std)
    residual = length - total_field
    residual *= inverse_std
    return Along(unit, length, turned, own, inverse_std, residual)


def scores(seen: Along, total_field: Array) -> Scores:
    """The sums of samples seen along the field, total_field (n,) nT."""
    return scores_of_blocks(seen, total_field, (0, len(total_field)))[0]


def scores_of_blocks(seen: Along, total_field: Array, edges: Sequence[int]) -> list[Scores]:
    """The sums of samples seen along the field, total_field (n,) nT, from each edge to the next."""
    u, h, r = seen.unit, seen.turned, seen.residual
    m = r * seen.inverse_std
    m2 = m * m
    # d r^2/2 with d|b| = |b| u'E u + u'e and d(std^2)/2 = (2 h - own u)'E u + (h - own u)'e / |b|, h = U U'u
    shrink = m2 * seen.own
    toward = (m * seen.length + shrink) * u
    m2 += m2
    toward -= m2 * h
    shrink /= seen.length
    shrink += m
    m2 /= 2.0 * seen.length
    rows = np.empty((9, len(r)))
    scaled = np.multiply(u, seen.inverse_std, out=rows[6:])
    foot = u * total_field
    np.multiply(scaled, foot, out=rows[:3])
    for k, (i, j) in enumerate(PAIRS):
        np.multiply(scaled[i], foot[j], out=rows[3 + k])
    found = []
    for start, stop in pairwise(edges):
        part = slice(start, stop)
        t, v, foot_, own = toward[:, part], u[:, part], foot[:, part], rows[:, part]
        change = [float(t[i] @ v[i]) for i in range(3)]
        change += [float(t[i] @ v[j] + t[j] @ v[i]) for i, j in PAIRS]
        shift = v @ shrink[part] - h[:, part] @ m2[part]
        moments = np.empty((4, 4))
        for i in range(3):
            for j in range(i + 1):
                moments[i, j] = moments[j, i] = foot_[i] @ foot_[j]
            moments[i, 3] = moments[3, i] = foot_[i].sum()
        moments[3, 3] = stop - start
        cost = float(r[part] @ r[part])
        found.append(Scores(int(stop - start), cost, np.array([*change, *shift]), own @ own.T * _TWICE, moments))
    return found


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


def _dot(a: Array, b: Array) -> Array:
    out: Array = a[0] * b[0]
    out += a[1] * b[1]
    out += a[2] * b[2]
    return out
