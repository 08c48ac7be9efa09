"""How C and o of every survey follow from the parameters that are fitted, and what is fixed by convention."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array
from magtensor.errors import NotEnoughData


@dataclass(frozen=True)
class Design:
    """C_k = sum_i matrices[k, i] C^(i), o_k = sum_j offsets[k, j] o^(j).

    Parameters are the elements of every C^(i) (9 S each, sensor after sensor, row by row), then every o^(j) (3 S each).

    Attributes:
        matrices: (K, I), of [1] or [1, years from their mean]; offsets: (K, J), as well, or one column for each survey.
        noise: (3 S,) nT, of the outputs; sighted: whether directions are known, which tie the frame.
    """

    matrices: Array
    offsets: Array
    noise: Array
    sighted: bool

    @property
    def size(self) -> int:
        """P."""
        return len(self.noise) * (3 * self.matrices.shape[1] + self.offsets.shape[1])

    @property
    def own_offsets(self) -> bool:
        """Whether every survey has its own."""
        return bool(self.offsets.shape == (len(self.offsets),) * 2 and (self.offsets.sum(axis=1) == 1.0).all())

    def forward(self, parameters: Array, survey: int) -> tuple[Array, Array]:
        """C (S, 3, 3) and o (S, 3) nT of one survey."""
        count, terms = len(self.noise), self.matrices.shape[1]
        c = parameters[: 3 * count * terms].reshape(terms, -1, 3, 3)
        o = parameters[3 * count * terms :].reshape(-1, count // 3, 3)
        return np.tensordot(self.matrices[survey], c, axes=1), np.tensordot(self.offsets[survey], o, axes=1)

    def of(self, survey: int) -> Array:
        """(12 S, P): derivative of C (row by row) and o of each sensor."""
        return self.at(self.matrices[survey], self.offsets[survey])

    def at(self, matrices: Array, offsets: Array) -> Array:
        """(12 S, P), the same for any weights (I,), (J,)."""
        sensors = len(self.noise) // 3
        places = np.eye(12 * sensors).reshape(sensors, 12, -1)
        c, o = places[:, :9].reshape(9 * sensors, -1).T, places[:, 9:].reshape(3 * sensors, -1).T
        return np.concatenate([np.kron(matrices, c), np.kron(offsets, o)], axis=1)

    def whitened(self, survey: int) -> Array:
        """(12 S, P): derivative of [C | o] / noise, output after output (`Said`)."""
        sensors = len(self.noise) // 3
        own = self.of(survey).reshape(sensors, 12, -1)
        rows = np.concatenate([own[:, :9].reshape(sensors, 3, 3, -1), own[:, 9:].reshape(sensors, 3, 1, -1)], axis=2)
        out: Array = (rows.reshape(3 * sensors, 4, -1) / self.noise[:, None, None]).reshape(12 * sensors, -1)
        return out

    def free(self) -> Array:
        """(P, F) orthonormal: changes of the parameters that keep the frame. Without known directions a rotation that
        all sensors share cannot be seen in any survey: the sum of all C stays symmetric, at every date."""
        if self.sighted:
            return np.eye(self.size)
        sensors, terms = len(self.noise) // 3, self.matrices.shape[1]
        skew = np.zeros((3, 3, 3))
        for axis, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
            skew[axis, i, j], skew[axis, j, i] = 1.0, -1.0
        fixed = np.zeros((3 * terms, self.size))
        for term in range(terms):
            at = slice(9 * sensors * term, 9 * sensors * (term + 1))
            fixed[3 * term : 3 * term + 3, at] = np.tile(skew.reshape(3, 9), (1, sensors))
        out: Array = np.linalg.qr(fixed.T, mode="complete")[0][:, len(fixed) :]
        return out


def summed_up(jacobians: Sequence[Array], parts: Sequence[Array]) -> Array:
    """(P, P): what surveys say (12 S, 12 S) of the parameters, added up."""
    return np.sum([j.T @ part @ j for j, part in zip(jacobians, parts, strict=True)], axis=0)


def inverse_in(free: Array, information: Array) -> Array:
    """(P, P): the inverse of an information within the free directions (P, F).

    Raises
    ------
    NotEnoughData: one of them has no information.
    """
    inner = free.T @ information @ free
    scale = np.sqrt(np.diag(inner))
    try:
        if not (np.isfinite(scale).all() and (scale > 0).all()):
            raise np.linalg.LinAlgError
        root = np.linalg.inv(np.linalg.cholesky(inner / np.outer(scale, scale)))
    except np.linalg.LinAlgError as error:
        raise NotEnoughData("the surveys leave a parameter of the fit open", hint="add attitudes") from error
    spread = free @ (root / scale).T
    out: Array = spread @ spread.T
    return out
