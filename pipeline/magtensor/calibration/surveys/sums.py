"""What samples of several surveys say of one matrix and of a centre for each, as sums.

Parameters are changes of the field b -> b + E b + e_k: E symmetric (six, in the order of `maximum_likelihood`), or all
nine elements row by row where a known direction shows rotations too; then three of e_k for each centre. A total field
that is an unknown constant of its samples is eliminated: its best value at given parameters is a weighted mean of |b|,
and its information is taken off. A scale of everything then stays free; the sums hold it as if the mean over all
samples were known, which moves no estimate (`magtensor.calibration.common_scale` puts the convention in its place).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.maximum_likelihood import CHUNK, PAIRS, WEIGHTS, along, scores, scoring_step
from magtensor.calibration.types import Array
from magtensor.errors import NotEnoughData

from .directions import Sighting, across

SYMMETRIC, ALL = 6, 9  # parameters of E
_TO_SYMMETRIC = np.zeros((SYMMETRIC, ALL))
for _k in range(3):
    _TO_SYMMETRIC[_k, 4 * _k] = 1.0
for _k, (_i, _j) in enumerate(PAIRS):
    _TO_SYMMETRIC[3 + _k, 3 * _i + _j] = _TO_SYMMETRIC[3 + _k, 3 * _j + _i] = 0.5


@dataclass(frozen=True)
class InPlane:
    """Samples in the plane's coordinates.

    Attributes:
        y: (N, 3), unit variance, centre after centre; centre: (N,) number of each, ascending, 0 to K - 1.
        total_field: (N,) nT; level: (N,) as in `Samples`.
        reference_noise: nT, of the total field.
        sighting: known directions; None where there are none.
    """

    y: Array
    centre: NDArray[np.int_]
    total_field: Array
    level: NDArray[np.int_] | None = None
    reference_noise: float = 0.0
    sighting: Sighting | None = None

    @property
    def centres(self) -> int:
        """K."""
        return int(self.centre[-1]) + 1

    @property
    def free(self) -> int:
        """Parameters of E."""
        return SYMMETRIC if self.sighting is None else ALL

    def fields(self, matrix: Array, centres: Array) -> Array:
        """(N, 3) nT."""
        out: Array = (self.y - centres[self.centre]) @ matrix.T
        return out

    def parts(self) -> list[tuple[int, slice]]:
        """Pieces that the processor's cache holds, with the centre that each has."""
        edges = np.searchsorted(self.centre, np.arange(self.centres + 1))
        return [
            (k, slice(start, min(start + CHUNK, int(stop))))
            for k, (first, stop) in enumerate(pairwise(edges))
            for start in range(int(first), int(stop), CHUNK)
        ]


@dataclass(frozen=True)
class Sums:
    """Sums at one matrix and its centres; P parameters.

    Attributes:
        along, across: squared whitened residuals, along the field and across it.
        gradient: (P,) half the derivative of their sum.
        along_normal, across_normal: (P, P) expected information of either.
        moments: (K, 4, 4) sum of z z', z = (field, 1), nT, for each centre.
        total_field: (N,) nT, the unknown constants at their best.
        held: (P,); along_normal has held held' more than the samples tell, which holds the mean of unknown constants.
        weight: 1/nT^2, of that mean.
    """

    along: float
    across: float
    gradient: Array
    along_normal: Array
    across_normal: Array
    moments: Array
    total_field: Array = field(repr=False)
    held: Array
    weight: float

    @property
    def normal(self) -> Array:
        """(P, P)."""
        return self.along_normal + self.across_normal

    @property
    def cost(self) -> float:
        return self.along + self.across

    @property
    def rounding(self) -> float:
        """What rounding makes of a squared whitened residual, as `Scores.rounding`."""
        count = float(self.moments[:, 3, 3].sum())
        field_ = float(np.trace(self.moments[:, :3, :3].sum(axis=0)))
        return 1e-28 * field_ * float(np.trace(self.normal[-3:, -3:])) / count**2


def levels_at(data: InPlane, matrix: Array, centres: Array) -> Array:
    """(N,) nT: the total field, where it is an unknown constant the one that fits best."""
    if data.level is None:
        return data.total_field
    top, weight = np.zeros((2, int(data.level.max()) + 1))
    for k, part in data.parts():
        seen = along(matrix, centres[k], data.y[part].T, data.total_field[part], data.reference_noise)
        one = seen.inverse_std**2
        top += np.bincount(data.level[part], one * seen.length, minlength=len(top))
        weight += np.bincount(data.level[part], one, minlength=len(top))
    found: Array = (top / np.where(weight > 0, weight, 1.0))[data.level]
    return found


def summed(data: InPlane, matrix: Array, centres: Array) -> Sums:
    """The sums of all samples."""
    free, size = data.free, data.free + 3 * data.centres
    total_field = levels_at(data, matrix, centres)
    to_free = np.eye(SYMMETRIC) if free == SYMMETRIC else _TO_SYMMETRIC
    gradient, along_normal, across_normal = np.zeros(size), np.zeros((size, size)), np.zeros((size, size))
    moments = np.zeros((data.centres, 4, 4))
    levels = 0 if data.level is None else int(data.level.max()) + 1
    by_level, weight = np.zeros((size, levels)), np.zeros(levels)
    costs = [0.0, 0.0]
    for k, part in data.parts():
        at = np.concatenate([np.arange(free), free + 3 * k + np.arange(3)])
        to_here = np.zeros((9, free + 3))
        to_here[:SYMMETRIC, :free], to_here[SYMMETRIC:, free:] = to_free, np.eye(3)
        f = total_field[part]
        seen = along(matrix, centres[k], data.y[part].T, f, data.reference_noise)
        own = scores(seen, f)
        costs[0] += own.cost
        gradient[at] += to_here.T @ own.gradient
        along_normal[np.ix_(at, at)] += to_here.T @ own.normal @ to_here
        moments[k] += own.moments
        if data.level is not None:
            ones = seen.inverse_std**2
            u, foot = seen.unit, seen.unit * f
            columns = [u[i] * foot[i] for i in range(3)] + [u[i] * foot[j] for i, j in PAIRS] + list(u)
            each = np.stack([np.bincount(data.level[part], ones * c, minlength=levels) for c in columns])
            by_level[at] += to_here.T @ (WEIGHTS[:, None] * each)
            weight += np.bincount(data.level[part], ones, minlength=levels)
        if data.sighting is not None:
            b = (seen.unit * seen.length).T
            side = across(data.sighting, part, b, seen.length - f)
            turned = (side.slope[..., None] * b[:, None, None]).reshape(len(b), 2, ALL)
            rows = np.concatenate([turned, side.slope], axis=2).reshape(-1, free + 3)
            residual = side.residual.ravel()
            costs[1] += float(residual @ residual)
            gradient[at] += rows.T @ residual
            across_normal[np.ix_(at, at)] += rows.T @ rows
    if levels:
        along_normal -= (by_level / np.maximum(weight, 1e-300)) @ by_level.T
    held = by_level.sum(axis=1) / np.sqrt(weight.sum()) if levels else np.zeros(size)
    along_normal += np.outer(held, held)
    total = float(weight.sum())
    return Sums(costs[0], costs[1], gradient, along_normal, across_normal, moments, total_field, held, total)


@dataclass(frozen=True)
class Found:
    """matrix (3, 3) nT per unit of y, centres (K, 3) in units of y, and the sums there."""

    matrix: Array
    centres: Array
    sums: Sums


def minimised(data: InPlane, matrix: Array, centres: Array, most_iterations: int = 60) -> Found:
    """The parameters of least cost, by damped scoring from a start.

    Raises
    ------
    NotEnoughData: the normal equations are singular, or it does not converge.
    """
    here, damping = summed(data, matrix, centres), 0.0
    freedom = max(len(data.y) * (1 if data.sighting is None else 3) - len(here.gradient), 1)
    for _ in range(most_iterations):
        try:
            step, expected = scoring_step(here)
        except np.linalg.LinAlgError as error:
            raise NotEnoughData("the samples leave a parameter of the fit open", hint="add attitudes") from error
        if expected < max(1e-8 * here.cost / freedom, here.rounding):  # of 1e-4 standard deviations
            return Found(matrix, centres, here)
        if damping:
            step, _ = scoring_step(here, damping)
        moved = _stepped(data.free, matrix, centres, step)
        there = summed(data, *moved)
        if np.isfinite(there.cost) and there.cost <= here.cost * (1 + 1e-12):
            (matrix, centres), here, damping = moved, there, damping / 10 if damping > 1e-9 else 0.0
            continue
        damping = max(10 * damping, 1e-6)
        if damping > 1e6:
            break
    raise NotEnoughData("the fit does not converge", hint="look for disturbed samples, or add attitudes")


def with_scale(data: InPlane, found: Found, factor: float) -> Found:
    """The same fit of fields `factor` times as large."""
    matrix = found.matrix * factor
    return Found(matrix, found.centres, summed(data, matrix, found.centres))


def _stepped(free: int, matrix: Array, centres: Array, step: Array) -> tuple[Array, Array]:
    change = np.eye(3)
    if free == ALL:
        change = change + step[:ALL].reshape(3, 3)
    else:
        change = change + np.diag(step[:3])
        for value, (i, j) in zip(step[3:SYMMETRIC], PAIRS, strict=True):
            change[i, j] = change[j, i] = value
    moved = change @ matrix
    shift = np.linalg.solve(moved, step[free:].reshape(-1, 3).T).T
    return moved, centres - shift
