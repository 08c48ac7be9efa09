"""Samples of a kind that follow each other."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def in_a_row(some: NDArray[Any]) -> NDArray[np.intp]:
    """(K, 2) the first sample of each run of some samples (N,), and the one after its last.

    Args:
        some: (N,) True, or 1, for those.
    """
    return np.flatnonzero(np.diff(np.asarray(some).astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
