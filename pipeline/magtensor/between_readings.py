"""A record of readings as a course of time: what lies between two of them.

Straight lines follow a random walk best, a spline what is smooth beside the time between readings, a monotone cubic is
between the two, and the only one that never overshoots. Which is nearest the truth is a question of the record itself:
each is asked to predict readings that it was not given.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from magtensor.in_a_row import in_a_row

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Course = Literal["pchip", "spline", "linear"]
COURSES: tuple[Course, ...] = get_args(Course)

LEAST_READINGS = 60  # fewer do not tell two courses apart
BLOCKS = 10  # of the record: a course that predicts better does so in most of them
MOST = 0.8  # of the blocks
BETTER = 0.8  # of the squared error: what a spline gains by less it loses where noise passes through it
GAP = 2.5  # median steps: what goes on before it says nothing of what goes on behind it
UNEVEN = 1.5  # median steps: a longer one is bridged by the monotone cubic
ABRUPT = 8.0  # times the usual difference between a change and those beside it: a step or a spike
BESIDE = 3  # readings to each side of a break, which say nothing of a course
LEAST_CHANGES = 5  # beside each other, to tell one that is abrupt
LEAST_PIECE = 6  # readings between two breaks that a spline goes through


def course(time: Floats, values: Floats, how: Course) -> Callable[[Floats], Floats]:
    """The course through readings; to be asked for times from the first to the last only.

    The spline is broken at steps, spikes and gaps, in which it would ring: these are crossed by the monotone cubic.

    Args:
        time: (N,) s, strictly increasing, N >= 2.
        values: (N,) finite.
        how: monotone cubic (Fritsch and Carlson 1980, as PCHIP), cubic spline, or straight lines.
    """
    if how == "linear" or len(time) < 3:
        return partial(_straight, time, values)  # which another process can be sent
    from scipy.interpolate import CubicSpline, PchipInterpolator, PPoly

    monotone = PchipInterpolator(time, values)
    if how == "pchip":
        return monotone
    pieces = np.array(monotone.c)
    for first, last in in_a_row(~breaks(time, values)):  # as many readings as intervals, and one
        if last - first + 1 >= LEAST_PIECE:
            own = slice(first, last + 1)
            pieces[:, first:last] = CubicSpline(time[own], values[own]).c
    return PPoly(pieces, time)


def _straight(time: Floats, values: Floats, at: Floats) -> Floats:
    return np.interp(at, time, values)


def followed_best(time: Floats, values: Floats) -> Course:
    """The spline where it clearly predicts a record better than the monotone cubic; else that.

    Every second reading is left out and predicted from the others, twice as far apart as they are. Readings of white
    noise, or of a random walk, are predicted worse by the spline.

    Args:
        time: (N,) s, strictly increasing; values: (N,) finite.
    """
    if len(time) < LEAST_READINGS:
        return "pchip"
    squares = np.zeros((2, len(time)))
    for first in (0, 1):
        given = np.arange(first, len(time), 2)
        asked = np.arange(first + 1, given[-1], 2)
        for square, how in zip(squares, COURSES[:2], strict=True):
            square[asked] = (course(time[given], values[given], how)(time[asked]) - values[asked]) ** 2
    broken = np.convolve(breaks(time, values), np.ones(2 * BESIDE))[BESIDE - 1 :][: len(time)] > 0
    squares[:, broken] = 0.0
    monotone, spline = (np.add.reduceat(s, np.linspace(0, len(s), BLOCKS, endpoint=False).astype(int)) for s in squares)
    surely = spline.sum() < BETTER * monotone.sum() and np.mean(spline < monotone) >= MOST
    return "spline" if surely else "pchip"


def breaks(time: Floats, values: Floats) -> Bools:
    """(N - 1,) True between two readings where the record steps, beside a spike, and in a gap.

    Args:
        time: (N,) s, increasing; values: (N,).
    """
    steps, changes = np.diff(time), np.diff(values)
    off, bent, told = np.zeros(len(changes)), np.zeros(len(changes)), np.zeros(len(changes), dtype=bool)
    for piece in without_a_gap(time):
        own = slice(piece.start, piece.stop - 1)
        if own.stop - own.start < LEAST_CHANGES:
            continue
        padded = np.pad(changes[own], 2, mode="reflect")
        beside = np.stack([padded[k : k + own.stop - own.start] for k in (0, 1, 3, 4)])
        off[own], told[own] = np.abs(changes[own] - np.median(beside, axis=0)), True
        bend = np.abs(np.diff(changes[own], n=2))  # at the ends beyond the line through the two before
        bent[own] = np.concatenate([bend[:1], bend / 2.0, bend[-1:]])
    if not told.any():
        return ~told
    usual = np.sqrt(np.mean(np.sort(off[told] ** 2)[: -(-told.sum() * 9 // 10)]))
    out: Bools = (np.minimum(off, bent) > ABRUPT * usual) | (steps > UNEVEN * np.median(steps)) | ~told
    return out


def without_a_gap(time: Floats) -> list[slice]:
    """The readings between two gaps, from the first to one past the last.

    Args:
        time: (N,) s, increasing.
    """
    steps = np.diff(time)
    ends = np.flatnonzero(steps > GAP * np.median(steps)) + 1 if len(steps) else np.zeros(0, dtype=int)
    return [slice(int(a), int(b)) for a, b in pairwise([0, *ends, len(time)])]


def noise_gain(how: Course, place: Floats) -> Floats:
    """(M,) by how much independent noise of evenly spaced readings is scaled at places (M,) between two of them, 0 to
    1; of the monotone cubic, which is not linear, that of straight lines."""
    if how != "spline":
        return np.hypot(1.0 - place, place)
    from scipy.interpolate import CubicSpline

    around = np.arange(-8.0, 10.0)  # a reading further away has less than 1/10000
    fine = np.linspace(0.0, 1.0, 65)
    weights = CubicSpline(around, np.eye(len(around)), bc_type="natural")(fine)
    return np.interp(place, fine, np.sqrt(np.sum(weights**2, axis=1)))
