"""Readings of a log that cannot be: alone, and far outside of all others that it holds.

A thermometer on a bus answers 85.0 after a reset and -127 when it does not answer; a shunt's converter loses a bit. One
such reading outweighs the course of a whole survey. What a log really does for a single reading moves a single sample,
and little is lost if that is left to speak for itself.
"""

from __future__ import annotations

import numpy as np

from magtensor.in_a_row import in_a_row
from magtensor.survey.recorded_numbers import Bools, Floats, runs

INNER = 0.02  # of the rows at either end of what a log holds, beyond the usual
MOST = 0.02  # of the rows: what comes more often is no mistake of reading
OUTSIDE = 1.0  # times the width of the inner readings, beyond these
NEIGHBOURS = 0.5  # of that, from the readings before and after
LONGEST = 2  # times as many rows as the others usually keep a value for: what lasts longer is no mistake of reading
LEAST_ROWS = 50
STEADY = 0.5  # mean square of the changes over that of white noise: a log has a course that a reading can depart from


def lone_readings(values: Floats, *, slow: bool = False) -> Bools:
    """Where a log holds a reading that cannot be.

    Never of a log that is mostly noise, or constant but for what stands out: nothing tells a mistake from a pulse.

    Args:
        values: (N,) or (N, K), NaN where nothing was read.
        slow: of a temperature, which neither jumps nor comes back at once: a mistake for as long as it lasts.

    Returns:
        of the same shape.
    """
    columns = values.reshape(len(values), -1)
    found = np.column_stack([_of_one(column, slow) for column in columns.T])
    return found.reshape(values.shape)


def _of_one(values: Floats, slow: bool) -> Bools:
    out = np.zeros(len(values), dtype=bool)
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < LEAST_ROWS:
        return out
    read = values[known]
    low, high = np.quantile(read, [INNER, 1.0 - INNER])
    margin = OUTSIDE * (high - low)
    far = (read < low - margin) | (read > high + margin)
    if margin <= 0.0 or not far.any() or far.mean() > MOST:
        return out
    others = read[~far]
    if np.mean(np.diff(others) ** 2) > STEADY * 2.0 * np.var(others):
        return out
    longest = len(read) if slow else LONGEST * _usual_run(others)
    for a, b in in_a_row(far):
        if a > 0 and b < len(read) and b - a <= longest and _alone(read[a - 1 : b + 1], margin):
            out[known[a:b]] = True
    return out


def _alone(values: Floats, margin: float) -> bool:
    """Whether values but for the first and last are far from these two: the top of a pulse has neighbours nearly as
    high."""
    inner, around = values[1:-1], values[[0, -1]]
    return float(np.abs(inner[:, None] - around).min()) > NEIGHBOURS * margin


def _usual_run(values: Floats) -> float:
    """Rows for which a log keeps a value, at half of its rows."""
    _, lengths = runs(np.diff(values) == 0.0)
    return float(np.median(np.repeat(lengths, lengths))) if 2 * lengths.sum() > len(values) else 1.0
