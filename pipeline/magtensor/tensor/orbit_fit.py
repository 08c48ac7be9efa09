"""Maximum likelihood of an instrument's thirty coefficients from readings on one orbit, the rotations eliminated."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import NotEnoughData
from magtensor.tensor.elements import METRIC
from magtensor.tensor.invariant_polynomials import quadratic_monomials, symmetric_matrix
from magtensor.tensor.orbit import (
    COEFFICIENTS,
    Feet,
    Surface,
    curvature_pull,
    derivatives,
    feet,
    noise_information,
    normals,
    smallest_radius,
)

Array = NDArray[np.float64]

LEAST_ROTATIONS = 30  # two equations each: twice the 27 coefficients that can be known, and some for the noise
LEAST_INFORMATION = 2.0  # times what noise makes in a direction: at least half of it then comes from the source

_SEARCHED = 2000  # readings that the search from a far start looks at; all of them are fitted afterwards
_STEPS = 60
_LEAST_DAMPING = 1e-9
_ROUNDING = 1e-20  # the least noise variance assumed, of readings of order one
_SAME_SHAPE = 1e-6  # rad: angles of shapes are arc cosines, and rounding makes 1e-8 of them
_FALSE_ALARM = 1e-4
_SHAPES = (0.35, 0.7)  # rad, tried for a source of unknown shape: neither is axisymmetric


@dataclass(frozen=True)
class Likelihood:
    """The likelihood of readings at one surface.

    Attributes:
        surface: the instrument and the shape of the source.
        feet: the nearest points; normal: (N, 5, 2) off the surface there.
        columns: which of the 31 coefficients are estimated: the last, the shape, may be known.
    """

    surface: Surface
    feet: Feet
    normal: Array
    columns: NDArray[np.intp]

    @classmethod
    def at(cls, readings: Array, surface: Surface, shape_known: bool, start: Array | None = None) -> Likelihood:
        found = feet(readings, surface, start)
        columns = np.arange(COEFFICIENTS - 1 if shape_known else COEFFICIENTS)
        return cls(surface, found, normals(surface, found), columns)

    @cached_property
    def rows(self) -> Array:
        """(2 N, 31), see `derivatives`."""
        return derivatives(self.surface, self.feet, self.normal)

    @cached_property
    def off(self) -> Array:
        """(2 N,) residuals along the normals."""
        out: Array = np.einsum("nck,nc->nk", self.normal, self.feet.residual).ravel()
        return out

    @property
    def variance(self) -> float:
        """Of one whitened reading in units of C_T squared; three of the coefficients are no data's."""
        return max(self.feet.cost / (len(self.off) - len(self.columns) + 3), _ROUNDING)

    @cached_property
    def information(self) -> Array:
        """(p, p) sum of squared derivatives by the estimated coefficients; Fisher's times the variance."""
        rows = self.rows[:, self.columns]
        return rows.T @ rows

    @cached_property
    def identifiable(self) -> Array:
        """(p, p - 3): orthonormal directions of the estimated coefficients across the gauge."""
        gauge = self.surface.gauge()[:, self.columns]
        out: Array = np.linalg.qr(gauge.T, mode="complete")[0][:, 3:]
        return out

    def across_gauge(self, matrix: Array) -> Array:
        """(p - 3, p - 3) of a (p, p) form."""
        return self.identifiable.T @ matrix @ self.identifiable


def search(readings: Array, prior: Array, angle: float | None) -> Surface:
    """The maximum of the likelihood, of some of the readings, from starts that may be far from it.

    Starts at the prior and at the quadric through the readings; it ends when two of them lead to the same maximum, and
    takes the highest.

    Parameters
    ----------
    readings : (N, 5) whitened, in units of C_T.
    prior : (5, 5) mixing, whitened.
    angle : rad, the shape of the source; None where it is not known.
    """
    some = readings[:: max(1, len(readings) // _SEARCHED)]
    found: list[tuple[float, Surface]] = []
    for start in _starts(some, prior, angle):
        surface = climbed(some, start, angle is not None)
        cost = feet(some, surface).cost
        again = any(abs(cost - other) <= 1e-3 * min(cost, other) for other, _ in found)
        found.append((cost, surface))
        if again and cost <= 1.001 * min(found, key=lambda f: f[0])[0]:
            break
    return min(found, key=lambda f: f[0])[1]


def _starts(readings: Array, prior: Array, angle: float | None) -> Iterable[Surface]:
    mean, middle = readings.mean(axis=0), (readings.max(axis=0) + readings.min(axis=0)) / 2
    spread = np.linalg.solve(prior, (readings - mean).T).T
    size = 1.0 if angle is not None else float(np.sqrt(np.mean(np.einsum("na,ab,nb->n", spread, METRIC, spread))))
    quadric = _quadric_start(readings, prior)
    for shape in _SHAPES if angle is None else (angle,):
        yield Surface(size * prior, mean, shape)
        if quadric is not None:
            yield replace(quadric, angle=shape)
        yield Surface(size * prior, middle, shape)
        yield Surface(0.8 * size * prior, mean, shape)


def _quadric_start(readings: Array, prior: Array) -> Surface | None:
    """From |G| = 1 alone: centre and, up to an orthogonal matrix that the prior settles, the mixing."""
    mean = readings.mean(axis=0)
    u = readings - mean
    x = np.linalg.lstsq(np.hstack([quadratic_monomials(u), 2 * u]), np.ones(len(u)), rcond=None)[0]
    form = symmetric_matrix(x[:15])
    values, vectors = np.linalg.eigh(form)
    if values[0] <= 1e-6 * values[-1]:
        return None
    centre = -np.linalg.solve(form, x[15:])
    half = vectors * np.sqrt(values / (1 + centre @ form @ centre)) @ vectors.T
    left = np.linalg.cholesky(METRIC).T
    one, _, two = np.linalg.svd(left @ np.linalg.inv(prior) @ np.linalg.inv(half))
    return Surface(np.linalg.inv(np.linalg.solve(left, one @ two @ half)), mean + centre, 0.0)


def climbed(readings: Array, start: Surface, shape_known: bool) -> Surface:
    """Levenberg-Marquardt; the three directions of the gauge are held at no change, not damped."""
    here = Likelihood.at(readings, start, shape_known)
    damping = 1e-3
    for _ in range(_STEPS):
        slope = here.rows[:, here.columns].T @ here.off
        while True:
            step = _step(here, slope, damping)
            if slope @ step[here.columns] <= 1e-3 * here.variance or damping > 1e9:
                return here.surface
            moved = here.surface.moved(step)
            if np.linalg.cond(moved.mixing) < 1e4:
                there = Likelihood.at(readings, moved, shape_known)
                if there.feet.cost < here.feet.cost:
                    break
            damping *= 4
        here, damping = there, max(damping / 8, _LEAST_DAMPING)
    return here.surface


def _step(here: Likelihood, slope: Array, damping: float) -> Array:
    """(31,) across the gauge."""
    matrix = here.across_gauge(here.information)
    matrix += damping * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
    out = np.zeros(COEFFICIENTS)
    out[here.columns] = here.identifiable @ np.linalg.solve(matrix, here.identifiable.T @ slope)
    return out


def near(readings: Array) -> NDArray[np.bool_]:
    """(N,) False for a few readings so far from the others that no instrument turned in one place gives them.

    All readings lie on an ellipsoid about the offset: distances differ by no more than the condition of H.
    """
    distance = np.linalg.norm(readings - np.median(readings, axis=0), axis=1)
    far = distance > 5 * np.median(distance)
    return ~far if np.mean(far) < 0.1 else np.ones(len(readings), dtype=bool)


def explicable(readings: Array, surface: Surface) -> NDArray[np.bool_]:
    """(N,) False for readings farther from the surface than noise takes one of a thousand series.

    The noise is read off the median distance; squared distances have two degrees of freedom.
    """
    residual = feet(readings, surface).residual
    squared = np.einsum("nc,nc->n", residual, residual)
    variance = max(float(np.median(squared)) / (2 * np.log(2)), _ROUNDING)
    return np.asarray(squared <= 2 * variance * np.log(len(readings) / 1e-3))


@dataclass(frozen=True)
class Determination:
    """Which directions of the coefficients the source fills, judged against noise.

    Attributes:
        weakest: information in the weakest direction relative to what noise makes; near 1 it is empty.
        needed: what `weakest` must exceed.
        empty: number of empty directions besides the gauge; 0 where the orbit is too narrow to count them.
        narrowest: radius of the orbit's narrowest circle in standard deviations of the noise.
    """

    weakest: float
    needed: float
    empty: int
    narrowest: float


def determination(here: Likelihood) -> Determination:
    """Rank of the information, each direction in units of the information that noise alone makes."""
    from scipy.linalg import eigh
    from scipy.special import fdtri

    count, freedom = len(here.off) // 2, len(here.off) - len(here.columns) + 3
    needed = max(LEAST_INFORMATION, float(fdtri(count, freedom, 1 - _FALSE_ALARM)))
    size = abs(float(np.linalg.det(here.surface.mixing))) ** 0.2
    blur = max(float(np.sqrt(here.variance)), _SAME_SHAPE * size)
    narrowest = size * smallest_radius(here.surface.angle) / blur
    if narrowest < 1:
        return Determination(0.0, needed, 0, narrowest)
    noise = here.across_gauge(_noise_information(here)) * here.variance
    noise += 1e-12 * np.trace(noise) * np.eye(len(noise))
    values = eigh(here.across_gauge(here.information), noise, eigvals_only=True)
    return Determination(float(values[0]), needed, int(np.sum(values < needed)), narrowest)


def _noise_information(here: Likelihood) -> Array:
    whole = noise_information(here.surface, here.feet, here.normal)
    return whole[np.ix_(here.columns, here.columns)]


def corrected(readings: Array, start: Surface, shape_known: bool) -> Likelihood:
    """The maximum of the likelihood of all readings, less the pull of the surface's curvature.

    Plain maximum likelihood leaves a bias of the order of the squared noise that no number of readings reduces; with
    the mean of the residuals taken off it is of the fourth power.

    Raises
    ------
    NotEnoughData : the steps do not end.
    """
    here = Likelihood.at(readings, start, shape_known)
    for _ in range(100):
        pull = curvature_pull(here.surface, here.feet, here.normal).ravel()
        slope = here.rows[:, here.columns].T @ (here.off - here.variance * pull)
        step = _step(here, slope, 0.0)
        if slope @ step[here.columns] <= 1e-8 * here.variance:
            return here
        here = Likelihood.at(readings, here.surface.moved(step), shape_known, here.feet.rotation)
    raise NotEnoughData(
        "the likelihood of the rotated tensors has no maximum near the prior",
        where="tensor",
        hint="rotate to more orientations about all three axes, or nearer to the source",
    )


def covariance(here: Likelihood) -> Array:
    """(31, 31) of the coefficients, zero along the gauge and for a known shape.

    The information found is that of the source and that of noise; the estimate's response to the data is the source's
    part alone, so the covariance is ``variance (A - N)^-1 A (A - N)^-1`` across the gauge.
    """
    found = here.across_gauge(here.information)
    response = np.linalg.inv(found - here.variance * here.across_gauge(_noise_information(here)))
    out = np.zeros((COEFFICIENTS, COEFFICIENTS))
    across = here.identifiable @ response
    out[np.ix_(here.columns, here.columns)] = here.variance * across @ found @ across.T
    return out


def shape_offset(here: Likelihood) -> tuple[float, float]:
    """By how much the data want a shape other than the given one, and the standard deviation, rad: one free step."""
    across = np.linalg.qr(here.surface.gauge().T, mode="complete")[0][:, 3:]
    rows = here.rows @ across
    inverse = np.linalg.inv(rows.T @ rows)
    pull = curvature_pull(here.surface, here.feet, here.normal).ravel()
    on_shape = across[-1] @ inverse
    step = on_shape @ (rows.T @ (here.off - here.variance * pull))
    return float(step), float(np.sqrt(here.variance * on_shape @ across[-1]))
