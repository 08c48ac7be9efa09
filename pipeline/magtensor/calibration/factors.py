"""Factors of the ellipsoid's matrix A = U^T U: each fixes the rotation that scalar data leave free.

The triangular factor puts the frame's z along the sensed z axis (Chi 2017), the symmetric one keeps the frame
nearest to the raw axes (Yin 2015, Chi 2017 eq. 15). Both give the same |b|.
"""

from __future__ import annotations

import numpy as np

from .types import Array

CHOLESKY, POLAR = "cholesky", "polar"  # the frames of SensorCalibration that a factor leads to

_TRIANGLE = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def upper(a: Array) -> Array:
    """Upper triangular U (3, 3) with positive diagonal and U^T U = a (Chi 2017, section 3.1)."""
    lower: Array = np.asarray(np.linalg.cholesky(a), dtype=np.float64)
    return lower.T


def symmetric_root(a: Array) -> Array:
    """Symmetric positive U (3, 3) with U^T U = a: V sqrt(D) V^T of Chi 2017 eq. 15."""
    values, vectors = np.linalg.eigh(a)
    out: Array = (vectors * np.sqrt(values)) @ vectors.T
    return out


def factor(a: Array, frame: str) -> Array:
    """The factor (3, 3) of the positive definite `a` that belongs to a frame, "cholesky" or "polar"."""
    return {CHOLESKY: upper, POLAR: symmetric_root}[frame](a)


def embedding(frame: str) -> Array:
    """How the nine free parameters move the twelve of a SensorCalibration, (12, 9), elements 0 or 1.

    The six first are the elements xx, xy, xz, yy, yz, zz of the factor (those below the diagonal follow where it
    is symmetric and stay zero where it is triangular), the last three the offset.
    """
    out = np.zeros((12, 9))
    for k, (i, j) in enumerate(_TRIANGLE):
        out[3 * i + j, k] = 1.0
        if frame == POLAR:
            out[3 * j + i, k] = 1.0
    out[9:, 6:] = np.eye(3)
    return out


def rotation_and_upper(matrix: Array) -> tuple[Array, Array]:
    """``matrix = rotation @ upper`` with a positive diagonal of the upper triangular factor.

    The rotation has the sign of det(matrix): -1 says that the matrix mirrors.
    """
    q, r = np.linalg.qr(matrix)
    sign = np.where(np.diag(r) < 0, -1.0, 1.0)
    return q * sign, r * sign[:, None]
