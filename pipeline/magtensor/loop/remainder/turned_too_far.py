"""What is left where the field turns too far between samples for its rate of change to be known.

A sensor that is late, or filtered, is off by the rate at which the field turns. Where no rate is known no such effect
can be tested, and what one leaves, however it alternates, grows with the angle between neighbouring samples.
"""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.folds import FOLDS
from magtensor.loop.fitting.model import State
from magtensor.loop.remainder.predictable import LEAST_T

QUARTERS = (0.25, 0.75)  # of the samples, where the field turns least and most
FAR_MORE = 4.0  # times the square that is left where it turns least


def turned_too_far_words(state: State) -> list[str]:
    """What grows with the angle by which the field turns between samples, in each fold, if its rate is not known."""
    from scipy.stats import rankdata

    x, residual = state.excitation, state.residual
    if residual.across is None or not x.turns_unseen:
        return []
    angle = _angles(x.field[:, 0], x.runs())[residual.samples]
    square = np.sum(residual.across**2, axis=1)
    least, most = np.quantile(angle, QUARTERS)
    if not least < most or square[angle >= most].mean() < FAR_MORE * square[angle <= least].mean():
        return []
    ranks = np.column_stack([rankdata(angle), rankdata(square)])
    each = np.array([_correlation(part) for part in np.array_split(ranks, FOLDS)])
    if each.mean() * np.sqrt(len(each)) <= LEAST_T * each.std(ddof=1):
        return []
    return [
        f"it grows with how far the field turns from one sample to the next, up to {np.degrees(angle.max()):.0f} deg: "
        "a sensor that is late or filtered would look like this, which samples so far apart cannot tell, or noise of "
        "the motion"
    ]


def _angles(field: Array, runs: list[tuple[int, int]]) -> Array:
    """(N,) rad, the larger of the two by which vectors (N, 3) turn from and to a neighbour in the same run."""
    unit = field / np.linalg.norm(field, axis=1, keepdims=True)
    out = np.zeros(len(unit))
    for first, end in runs:
        turn = 2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(np.diff(unit[first:end], axis=0), axis=1), 1.0))
        out[first + 1 : end] = turn
        out[first : end - 1] = np.maximum(out[first : end - 1], turn)
    return out


def _correlation(pairs: Array) -> float:
    """Of two columns (n, 2); 0 where one is constant."""
    centred = pairs - pairs.mean(axis=0)
    size = float(np.sqrt(np.prod(np.sum(centred**2, axis=0))))
    return float(np.prod(centred, axis=1).sum()) / size if size > 0 else 0.0
