"""First-order covariance of scalar fits, in the frame convention that the factor fixes.

Every scalar method here minimises, to first order, sum_j ((|U (m_j - o)| - F_j) / F_j)^2: the algebraic distance
is 2 F times the distance of |b| from F. So one influence function serves them all. The noise is taken white, equal
and independent on the three axes of the raw output; with strong soft iron its radial part differs between
attitudes, which is why the covariance is a sandwich and not an inverse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .factors import embedding
from .types import Array


@dataclass(frozen=True)
class Influence:
    """How noise e_j (3,) nT in sample j moves the twelve parameters: ``sum_j gain[:, j] * (direction[j] @ e_j)``.

    Attributes:
        gain: (12, N), per nT of residual.
        direction: (N, 3), U^T u_j: what of the raw noise reaches |b|.
    """

    gain: Array
    direction: Array

    def covariance(self, noise: float) -> Array:
        """Covariance (12, 12) for raw noise of standard deviation `noise` nT on each axis."""
        weighted = self.gain * np.linalg.norm(self.direction, axis=1) * noise
        out: Array = weighted @ weighted.T
        return out


def residual(matrix: Array, offset: Array, raw: Array, total_field: Array) -> Array:
    """|b| - F (N,) nT for raw (N, 3) nT and total field (N,) nT."""
    out: Array = np.linalg.norm((raw - offset) @ matrix.T, axis=1) - total_field
    return out


def scalar_jacobian(matrix: Array, offset: Array, raw: Array, frame: str) -> Array:
    """Derivatives (N, 9) of |matrix (raw - offset)| with respect to the nine free parameters of `frame`.

    The six first are those of the factor (nT per unit), the last three those of the offset (nT per nT); see
    `factors.embedding` for their order.
    """
    centred = raw - offset
    b = centred @ matrix.T
    unit = b / np.linalg.norm(b, axis=1, keepdims=True)
    elements = (unit[:, :, None] * centred[:, None, :]).reshape(len(raw), 9)
    out: Array = np.column_stack([elements, -unit @ matrix]) @ embedding(frame)
    return out


def scalar_influence(matrix: Array, offset: Array, raw: Array, total_field: Array, frame: str) -> Influence:
    """Influence of the raw noise on a scalar fit to samples raw (N, 3) nT in total field (N,) nT.

    Raises
    ------
    numpy.linalg.LinAlgError: the samples do not determine the nine parameters (ask `coverage` first).
    """
    relative = scalar_jacobian(matrix, offset, raw, frame) / total_field[:, None]
    scale = np.linalg.norm(relative, axis=0)
    normal = (relative / scale).T @ (relative / scale)
    gain = -embedding(frame) @ (np.linalg.solve(normal, (relative / scale).T) / scale[:, None])
    b = (raw - offset) @ matrix.T
    unit = b / np.linalg.norm(b, axis=1, keepdims=True)
    return Influence(gain / total_field, unit @ matrix)


def scalar_noise(matrix: Array, offset: Array, raw: Array, total_field: Array) -> float:
    """Standard deviation of the raw noise per axis, nT, from the residual of a fit of nine parameters.

    NaN where no sample is left over. Whatever the model lacks counts as noise here.
    """
    left_over = len(raw) - 9
    if left_over <= 0:
        return float("nan")
    b = (raw - offset) @ matrix.T
    direction = (b / np.linalg.norm(b, axis=1, keepdims=True)) @ matrix
    r = np.linalg.norm(b, axis=1) - total_field
    return float(np.sqrt(np.sum(r**2) / left_over / np.mean(np.sum(direction**2, axis=1))))
