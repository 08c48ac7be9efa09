"""The common rotation from turns of the platform about an axis of its own: the field cones about that axis.

While the platform turns about an axis a that is fixed in it and in the world, v_n . P' a is constant for unit vectors
v_n of the calibrated field: P' a is the direction in which they do not spread. The rotation about a stays free; two
axes determine all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.errors import NotEnoughData

from .calibration_errors import CalibrationErrors, directions
from .sources import TURNS, Slope, edges_of, excess

LEAST_SAMPLES = 10


@dataclass(frozen=True)
class Turning:
    """Moments of the directions during turns about one axis; a `Source` whose nominal noise is 1 rad.

    Attributes:
        axis: (3,) unit vector in the platform.
        square: (K, 3, 3), in each block the sum of v v' about the mean of its turn.
        means: (T, 3), of v in each turn; count: samples.
        along: (R, 3, 3), sum of db (v - mean)', and radial: (T, R, 3), sum of v.db (v - mean) in each turn, with db the
            error of b / |b| per unit of each error of the calibration.
        name: "turns about z".
    """

    axis: Array
    square: Array
    means: Array
    count: int
    along: Array
    radial: Array
    name: str

    def cost(self, rotation: Array, spread: float) -> float:
        u = rotation.T @ self.axis
        return 0.5 * float(u @ self.square.sum(axis=0) @ u) / spread

    def slope(self, rotation: Array, spread: float) -> Slope:
        u, moved = self._moved(rotation)
        square = self.square.sum(axis=0)
        step = moved @ square @ moved.T
        information = step - float(u @ square @ u) * moved @ moved.T
        # v . u is all but the same in a turn, so that the part of db along v adds its mean there
        response = np.einsum("c,rca,ka->kr", u, self.along, moved)
        response -= np.einsum("t,tra,ka->kr", self.means @ u, self.radial, moved)
        gradient = moved @ square @ u
        return Slope(gradient / spread, information / spread, information / spread, step / spread, response / spread)

    def spread(self, rotation: Array) -> float:
        u, moved = self._moved(rotation)
        misfit = float(u @ self.square.sum(axis=0) @ u)
        variance = max(misfit / max(self.count - len(self.means) - 2, 1), 1e-18)
        gradients = np.einsum("ka,nac,c->nk", moved, self.square, u)
        return variance * max(excess(gradients, self.slope(rotation, 1.0).information * variance), 1.0)

    def free_because(self, directions: Array) -> str:
        return f"{self.name} leave the rotation about that axis open; add turns about another one, or another source"

    def _moved(self, rotation: Array) -> tuple[Array, Array]:
        """P' a, and (3, 3) its derivative (second index) with a rotation vector (first)."""
        return rotation.T @ self.axis, -np.einsum("kij,j->ki", TURNS, self.axis) @ rotation


def turning(b: Array, turn: NDArray[np.int_], axis: Array, errors: CalibrationErrors, name: str) -> Turning:
    """Read turns about one axis.

    Parameters
    ----------
    b: (N, S, 3) nT, calibrated to one common frame, finite, in the order of time.
    turn: (N,) number of the turn a sample belongs to; the axis may point elsewhere in the world in another turn.
    axis: (3,) in the platform.
    errors: of the calibration that made b.
    name: to report it by.

    Raises
    ------
    NotEnoughData: too few samples, or the field hardly turned about the axis.
    """
    if len(b) < LEAST_SAMPLES:
        raise NotEnoughData(f"{len(b)} samples of {name} cannot tell the axis")
    direction, rows = directions(b)
    centred, means, radial = direction.copy(), [], []
    for number in np.unique(turn):
        at = turn == number
        means.append(direction[at].mean(axis=0))
        centred[at] -= means[-1]
        outward = np.einsum("nq,nc,na->cqa", rows[at], direction[at], centred[at], optimize=True)
        radial.append(np.einsum("rcq,cqa->ra", errors.of_mean, outward))
    parts = edges_of(np.ones(len(b)))
    return Turning(
        np.asarray(axis, dtype=float) / np.linalg.norm(axis),
        np.stack([centred[p].T @ centred[p] for p in parts]),
        np.stack(means),
        len(b),
        errors.of_mean @ (rows.T @ centred),
        np.stack(radial),
        name,
    )
