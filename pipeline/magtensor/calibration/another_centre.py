"""Outputs whose ellipsoid has another centre for a while: a magnet lay on the platform.

A source as strong as the field itself leaves no ellipsoid to all samples together, and nothing to begin a calibration
with. The quadric of before and after and that of between have the same shape, so that all coefficients of both are
linear in one least-squares problem, and sums over blocks serve every pair of times.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from .types import Array

BLOCKS = 60  # between whose edges it is sought first
FINER = 64  # parts of a block, for the times in the end
LEAST_BLOCKS = 2  # that lie between the times, and outside
_SHAPE = 5  # coefficients of the shape, whose mean is that of a sphere
_CENTRE = 4  # linear and constant
_RANK = 1e-10


@dataclass(frozen=True)
class AnotherCentre:
    """Between two samples the centres are others.

    Attributes:
        first, end: the samples, never the first of all; end is the number of all where it happened once.
        moved: (S, 3) nT, by how much in raw outputs.
        left: (S,) part of the squares of what one quadric leaves that two leave.
    """

    first: int
    end: int
    moved: Array
    left: Array


def another_centre(raw: Array, total_field: Array) -> AnotherCentre | None:
    """Where two centres explain the lengths of outputs best, all sensors at the same times; None of too few samples.

    |x|^2 = e . s(x) + 2 l . x + c with x = m / F: the shape's departure from a sphere (Chi 2017 eqs. 7-12, its trace
    fixed) is one for all samples; l and c are others between the times.

    Parameters
    ----------
    raw: (N, S, 3) nT, finite; total_field: (N,) nT, positive.
    """
    count, sensors = raw.shape[:2]
    parts = min(BLOCKS * FINER, count)
    if count < 10 * BLOCKS:
        return None
    edges = np.linspace(0, count, parts + 1).round().astype(int)
    sums = [_sums(raw[:, s] / total_field[:, None], edges) for s in range(sensors)]

    def cost(first: int, end: int) -> float:
        return sum(0.5 * count * float(np.log(_quadrics(each, first, end)[0])) for each in sums)

    step, grid = parts // BLOCKS, np.linspace(0, parts, BLOCKS + 1).round().astype(int)
    pairs = [(int(a), int(b)) for i, a in enumerate(grid[:-1]) if i >= LEAST_BLOCKS for b in grid[i + LEAST_BLOCKS :]]
    best = min(pairs, key=lambda pair: cost(*pair))
    while step > 1:
        step = max(step // 2, 1)
        near = [
            (a, b)
            for a in (best[0] - step, best[0], best[0] + step)
            for b in ((best[1] - step, best[1], best[1] + step) if best[1] < parts else (parts,))
            if 0 < a < b <= parts
        ]
        best = min(near, key=lambda pair: cost(*pair))
    unit = float(np.mean(total_field))
    found = [_quadrics(each, *best) for each in sums]
    left = np.array([two / one for (two, _), one in zip(found, map(_one, sums), strict=True)])
    return AnotherCentre(int(edges[best[0]]), int(edges[best[1]]), np.stack([m for _, m in found]) * unit, left)


def _sums(x: Array, edges: Array) -> Array:
    """(parts + 1, 10, 10) products of the columns of the problem and its right side, from the first sample to each
    edge."""
    a, b, c = x.T
    shape = [a**2 - b**2, a**2 + b**2 - 2 * c**2, 2 * a * b, 2 * a * c, 2 * b * c]
    rows = np.column_stack([*shape, 2 * x, np.ones(len(x)), np.sum(x**2, axis=1)])
    each = np.stack([rows[i:j].T @ rows[i:j] for i, j in itertools.pairwise(edges)])
    return np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])


def _one(sums: Array) -> float:
    """Sum of squares that one quadric leaves."""
    total, size = sums[-1], _SHAPE + _CENTRE
    theta = _solved(total[:size, :size], total[:size, size])
    return max(float(total[size, size] - total[:size, size] @ theta), 1e-300)


def _quadrics(sums: Array, first: int, end: int) -> tuple[float, Array]:
    """Sum of squares that two quadrics of one shape leave, and by how much (3,) the centre of the second is moved."""
    total, inside, size = sums[-1], sums[end] - sums[first], _SHAPE + _CENTRE
    own = slice(_SHAPE, size)
    normal = np.zeros((size + _CENTRE, size + _CENTRE))
    normal[:size, :size] = total[:size, :size]
    normal[size:, :size], normal[:size, size:] = inside[own, :size], inside[:size, own]
    normal[size:, size:] = inside[own, own]
    right = np.concatenate([total[:size, size], inside[own, size]])
    theta = _solved(normal, right)
    e = theta[:_SHAPE]
    shape = np.eye(3) - np.array([[e[0] + e[1], e[2], e[3]], [e[2], e[1] - e[0], e[4]], [e[3], e[4], -2.0 * e[1]]])
    moved = np.linalg.lstsq(shape, theta[size : size + 3], rcond=None)[0]
    return max(float(total[size, size] - right @ theta), 1e-300), np.asarray(moved)


def _solved(normal: Array, right: Array) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    out: Array = scale * np.linalg.lstsq(normal * np.outer(scale, scale), right * scale, rcond=_RANK)[0]
    return out
