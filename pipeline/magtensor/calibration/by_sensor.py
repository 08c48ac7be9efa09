"""Matrices of the sensors applied to vectors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .types import Array


def by_sensor(matrices: NDArray[np.floating[Any]], vectors: Array) -> Array:
    """(N, S, 3) the product of each sensor's matrix (S, 3, 3) with its own vectors (N, S, 3), or one for all (N, 3).

    Every value is a sum of three products in one order, so the bits do not depend on how many samples are worked on.
    """
    each = vectors[:, None] if vectors.ndim == 2 else vectors
    out = np.asarray(matrices[:, :, 0] * each[..., 0, None], dtype=float)
    for j in (1, 2):
        out += matrices[:, :, j] * each[..., j, None]
    return out
