"""Whether what a file gives as attitude is a rotation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError

NORM_TOLERANCE = 0.01  # four decimals leave 1e-4; what is off by a hundred times that is a bad row


def unit_quaternions(values: NDArray[np.float64], where: str, notes: list[str]) -> NDArray[np.float64]:
    """Quaternions (N, 4), those not of norm 1 NaN, which is noted. All zero is unknown.

    Raises:
        DataError: most of them are no rotations.
    """
    norm = np.linalg.norm(values, axis=1)
    given = np.isfinite(norm) & (norm > 0.0)
    off = np.abs(norm - 1.0) > NORM_TOLERANCE
    if np.count_nonzero(off & given) > 0.5 * np.count_nonzero(given):
        raise DataError(f"the quaternions' median norm is {np.median(norm[given]):.3g}, not 1", where=where)
    if off.any():
        notes.append(f"attitude: {int(off.sum())} quaternions whose norm is not 1 are taken as missing")
    found: NDArray[np.float64] = np.where(off[:, None], np.nan, values)
    return found
