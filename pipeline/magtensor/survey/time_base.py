"""The time base of a recording: which stamps go forward, how regular the steps are, and where samples are missing."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def moves_on(time: Floats) -> Bools:
    """(N,) True for the samples to keep so that the time increases.

    Either a sample must be later than all before it (a clock that steps back), or earlier than all after it (one
    stamp that is far too late); whichever keeps more samples. Where both lose more than twice as many as need be, as
    where one stamp is far too late and another far too early, the most samples are kept that can be. A missing time is
    False.
    """
    known = np.isfinite(time)
    latest = np.maximum.accumulate(np.where(known, time, -np.inf))
    earliest = np.minimum.accumulate(np.where(known, time, np.inf)[::-1])[::-1]
    forward, backward = known.copy(), known.copy()
    forward[1:] &= time[1:] > latest[:-1]
    backward[:-1] &= time[:-1] < earliest[1:]
    kept = backward if backward.sum() > forward.sum() else forward
    if kept.sum() == known.sum():
        return kept
    most = _longest_increasing(time, known)
    return most if (known & ~kept).sum() > 2 * (known & ~most).sum() else kept


def _longest_increasing(time: Floats, known: Bools) -> Bools:
    """(N,) True for the samples of the longest series of increasing stamps, of several one (Schensted 1961)."""
    ends, last, before = list[float](), list[int](), np.full(len(time), -1)
    for i in map(int, np.flatnonzero(known)):
        place = bisect_left(ends, time[i])
        before[i] = last[place - 1] if place else -1
        ends[place : place + 1] = [time[i]]
        last[place : place + 1] = [i]
    chosen = np.zeros(len(time), dtype=bool)
    i = last[-1] if last else -1
    while i >= 0:
        chosen[i] = True
        i = int(before[i])
    return chosen


@dataclass(frozen=True)
class Sampling:
    """How regular the time base is.

    Attributes:
        step_s: median step, s.
        jitter_s: half of the range that holds 90 % of the steps that are no gaps, s.
        gaps: steps longer than 1.5 median steps.
        longest_gap_s: the longest step, s.
        missing: samples that would fill the gaps.
    """

    step_s: float
    jitter_s: float
    gaps: int
    longest_gap_s: float
    missing: int

    @property
    def rate_Hz(self) -> float:
        return 1.0 / self.step_s


def sampling(time: Floats) -> Sampling:
    """The time base's step, jitter and gaps.

    Half a step more than the step is what tells a lost sample from jitter.

    Args:
        time: (N,) s, strictly increasing, N >= 2.
    """
    steps = np.diff(time)
    step = float(np.median(steps))
    gap = steps > 1.5 * step
    low, high = np.percentile(steps[~gap], [5, 95])
    missing = int(np.round(steps[gap] / step - 1).sum())
    return Sampling(step, float(high - low) / 2, int(gap.sum()), float(steps.max()), missing)
