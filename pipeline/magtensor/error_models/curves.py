"""Any curve of a logged channel: straight lines that bend at values of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magtensor.calibration.types import Array

ABOUT_A_BEND = 1 / 16  # of the channel's range to either side: where its values tell of a bend
LEAST_AT_A_BEND = 20  # samples there, beside those of one time
LEAST_SHARE = 0.2  # the same, of all samples there
PARTS = 10  # of a survey, as many as there are held-out folds
ONE_TIME = 3  # neighbouring ones: what falls evenly all the time is near a value in no more of them


def along_a_curve(course: Array, bends: Sequence[float]) -> list[tuple[str, Array]]:
    """A channel (N, ...), and how far it is beyond each of the bends, 0 below it; each with what the names of its
    coefficients begin with. Beyond the last bend, and below the first, the curve goes on straight."""
    return [("", course), *((f"beyond {bend:.6g} ", np.maximum(course - bend, 0.0)) for bend in bends)]


def bends_of(values: Array, pieces: int) -> tuple[float, ...]:
    """Where a curve of a channel with the values (N,), in the order of time, or of any of K with (N, K), may bend:
    evenly, so that it has so many pieces, but only at values that it had at two times at least: nothing tells the law
    of a channel from something that happened once where it was so only then. () where it has no such values."""
    low, high = float(values.min()), float(values.max())
    edges = np.unique(np.linspace(0, len(values), PARTS + 1).astype(int))[:-1]

    def known(bend: float, column: Array) -> bool:
        near = np.add.reduceat(np.abs(column - bend) <= ABOUT_A_BEND * (high - low), edges, dtype=int)
        most = int(np.convolve(near, np.ones(ONE_TIME, dtype=int)).max())
        return bool(near.sum() - most >= max(LEAST_AT_A_BEND, LEAST_SHARE * near.sum()))

    columns = values.reshape(len(values), -1).T
    knots = np.linspace(low, high, pieces + 1)[1:-1]
    return tuple(float(bend) for bend in knots if high > low and any(known(bend, column) for column in columns))
