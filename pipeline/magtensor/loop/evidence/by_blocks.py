"""Whether the mean of something is above zero, by how much its means over contiguous blocks differ.

Blocks are longer than what follows itself from sample to sample, so that their means are taken as independent.
"""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array

BLOCKS = 20


def t_of(means: Array) -> Array:
    """(...) the mean of what blocks say (..., B) over its standard error."""
    error = means.std(axis=-1, ddof=1) / np.sqrt(means.shape[-1])
    out: Array = means.mean(axis=-1) / np.maximum(error, 1e-300)
    return out


def means_of(series: Array, blocks: int = BLOCKS) -> Array:
    """(B,) means of a series (N,) over contiguous blocks."""
    return np.array([block.mean() for block in np.array_split(series, blocks)])


def least_t(alpha: float, blocks: int = BLOCKS) -> float:
    """The t over so many blocks that chance exceeds with probability alpha."""
    from scipy.special import stdtrit

    return float(stdtrit(blocks - 1, 1.0 - alpha))
