"""What every source of the common rotation gives: a cost, its slope, its information, and its own reliability."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from magtensor.calibration.rotation import cross_matrix
from magtensor.calibration.types import Array

BLOCKS = 20  # contiguous parts of a record that are taken as independent of each other
ALPHA = 0.01  # chance that independent noise passes for dependent between samples
TURNS = np.stack([cross_matrix(axis) for axis in np.eye(3)])  # (3, 3, 3): TURNS[k] @ v = e_k x v
TWICE = 0.5 * np.stack([[one @ two + two @ one for two in TURNS] for one in TURNS])  # (3, 3, 3, 3), second order


@dataclass(frozen=True)
class Slope:
    """A source's cost about one rotation P, to second order in a rotation vector w (rad, platform frame): exp(w) P.

    Attributes:
        gradient: (3,) of the cost with w.
        information: (3, 3), expected second derivative of the cost; may have negative eigenvalues by chance.
        scatter: (3, 3), covariance of the gradient that the noise of the survey causes.
        step: (3, 3), second derivative of the cost as a step needs it, far from the minimum too.
        response: (3, R), gradient per unit of each independent error of the calibration.
    """

    gradient: Array
    information: Array
    scatter: Array
    step: Array
    response: Array


class Source(Protocol):
    """A source of the common rotation. `spread` divides its cost: the variance of its noise over the nominal one."""

    @property
    def name(self) -> str:
        """What it is reported by."""
        ...

    def cost(self, rotation: Array, spread: float) -> float:
        """Half the weighted sum of squares at P (3, 3)."""
        ...

    def slope(self, rotation: Array, spread: float) -> Slope:
        """See `Slope`."""
        ...

    def spread(self, rotation: Array) -> float:
        """How much larger the variance of its noise is than nominal, from what it leaves at P."""
        ...

    def free_because(self, directions: Array) -> str:
        """Why the rotation about the directions (n, 3) stays free, and what would determine it."""
        ...


def excess(gradients: Array, scatter: Array) -> float:
    """How much more the gradients of blocks vary than independent noise lets them; 1 where that may be chance.

    Args:
        gradients: (K, 3) of the cost, one for each block, about the minimum of their sum.
        scatter: (3, 3), covariance of their sum.
    """
    from scipy.special import chdtrc

    blocks = len(gradients)
    values, vectors = np.linalg.eigh(scatter)
    seen = values > 1e-9 * max(values[-1], 0.0)
    rank = int(seen.sum())
    if rank == 0 or blocks < 2:
        return 1.0
    white = gradients @ (vectors[:, seen] / np.sqrt(values[seen]))
    ratio = float(np.sum(white**2)) / (rank * (1 - 1 / blocks))
    freedom = rank * (blocks - 1)
    return ratio if chdtrc(freedom, ratio * freedom) < ALPHA else 1.0


def edges_of(energy: Array) -> list[slice]:
    """At most `BLOCKS` contiguous parts of a record, each with about the same share of a quantity (N,) >= 0."""
    count = len(energy)
    total = np.cumsum(energy)
    if count < 2 * BLOCKS or not total[-1] > 0:
        return [slice(0, count)]
    cuts = np.searchsorted(total, np.arange(1, BLOCKS) / BLOCKS * total[-1])
    edges = np.unique(np.concatenate([[0], cuts, [count]]))
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]
