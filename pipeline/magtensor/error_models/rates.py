"""How series that turn with the platform change within and between samples: rates, second derivatives, turning points.

A run is a contiguous stretch of samples; nothing is known of what happens between two of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magtensor.calibration.types import Array

Runs = Sequence[tuple[int, int]]  # (first, one past last) sample of each

SPLINED = 6  # samples, the fewest whose rate of change is that of a spline
LARGEST_TURN = 0.5  # rad between neighbouring samples above which rates of change mean nothing
LEAST_IN_A_RUN = 2 * SPLINED - 1  # samples that show a rate of change, and every second of them whether it is right
LITTLE_TURN = 0.25  # rad: over which a second difference is off by half a per cent
WORST_RATE = 0.5  # of the rate of change, moved by leaving out every second sample; with all of them the error of a
# difference formula is then some tenths of that, where the attitudes are unrelated all of it and more


def derivative(time: Array, runs: Runs, series: Array) -> Array:
    """d/dt of a series (N, ...), 1/s, within each run; zero where a run is a single sample."""
    out = np.zeros_like(np.asarray(series, dtype=float))
    for a, b in runs:
        if b - a >= SPLINED:
            out[a:b] = _of_a_spline(time[a:b], series[a:b])
        elif b - a >= 2:
            out[a:b] = np.gradient(series[a:b], time[a:b], axis=0)
    return out


def rate_known(time: Array, runs: Runs, vectors: Array) -> bool:
    """Whether vectors (N, 3) turn, and slowly enough between the samples of a run for their rate to be known."""
    change = np.concatenate([np.diff(vectors[i:j], axis=0) for i, j in runs])
    long_runs = [(i, j) for i, j in runs if j - i >= LEAST_IN_A_RUN]
    if not long_runs or not len(change):
        return False
    typical = np.sqrt(np.mean(np.sum(change**2, axis=1)) / np.mean(np.sum(vectors**2, axis=1)))
    rates = [
        (_of_a_spline(time[i:j], vectors[i:j])[::2], _of_a_spline(time[i:j:2], vectors[i:j:2])) for i, j in long_runs
    ]
    every, half = (np.concatenate(each) for each in zip(*rates, strict=True))
    moved = np.sqrt(np.sum((every - half) ** 2) / max(float(np.sum(every**2)), 1e-300))
    return bool(moved < WORST_RATE and typical < LARGEST_TURN)


def turning(time: Array, runs: Runs, vectors: Array) -> Array:
    """d/dt of vectors (N, ..., 3) that turn, 1/s.

    Differences between samples cut the corners of a vector that turns and shorten it; the part along it is that of its
    length, which changes slowly. Otherwise a total field would seem to show a delay of all sensors.
    """
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    along = vectors / length
    change = derivative(time, runs, vectors)
    own = np.sum(along * change, axis=-1, keepdims=True)
    out: Array = change + along * (derivative(time, runs, length) - own)
    return out


def error(time: Array, runs: Runs, vectors: Array) -> float:
    """How wrong rates of vectors (N, 3) that turn are, rms, as a share of them: their differences along the vectors, of
    which the length tells how much is right, are as wrong as those in the two directions across."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    change = derivative(time, runs, vectors)
    wrong = np.sum(vectors / length * change, axis=-1, keepdims=True) - derivative(time, runs, length)
    return float(np.sqrt(2.0 * np.sum(wrong**2) / max(float(np.sum(change**2)), 1e-300)))


def curvature(time: Array, runs: Runs, vectors: Array, rate: Array) -> Array:
    """d2/dt2 of vectors (N, ..., 3) that turn, 1/s2, their rate being known.

    Across them from differences over two samples to either side, or as many as the field turns a little over, and fewer
    near the ends of a run: their noise falls with the square of that time, and what is found so can be taken off a
    survey whose rows are means of many samples, where the closest differences would make more of their noise each time
    it is done. Along them what turning makes of a length that changes slowly, minus the squared rate over the
    length. Zero in runs of fewer than five samples; those at either end that have no difference have the next one.
    """
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    along = vectors / length
    change = np.zeros_like(vectors)
    typical = _where_it_turns(np.linalg.norm(rate / length, axis=-1).ravel())
    for first, end in runs:
        if end - first < 5:
            continue
        t, v = time[first:end], vectors[first:end]
        slow = int(LITTLE_TURN / max(typical * float(np.median(np.diff(t))), 1e-9))
        most = min(max(slow, 2), (len(t) - 1) // 2)
        least = max(2, (2 * most + 2) // 3)
        middle = np.arange(least, len(t) - least)
        reach = np.minimum(np.minimum(middle, len(t) - 1 - middle), most)
        shape = (-1, *[1] * (vectors.ndim - 1))
        before, after = (t[middle] - t[middle - reach]).reshape(shape), (t[middle + reach] - t[middle]).reshape(shape)
        rise, fall = (v[middle + reach] - v[middle]) / after, (v[middle] - v[middle - reach]) / before
        inner = 2.0 * (rise - fall) / (before + after)
        change[first:end] = inner[np.clip(np.arange(len(t)) - least, 0, len(inner) - 1)]
    own = np.sum(along * change, axis=-1, keepdims=True)
    out: Array = change - along * (own + np.sum(rate**2, axis=-1, keepdims=True) / length)
    return out


def _where_it_turns(turns: Array) -> float:
    """rad/s: the rate of turn (N,) at which half of the squares of all that are known are larger, and half smaller; 0
    where none is."""
    ordered = np.sort(turns[np.isfinite(turns)])
    if not len(ordered):
        return 0.0
    below = np.cumsum(ordered**2)
    return float(ordered[np.searchsorted(below, below[-1] / 2.0)])


def with_turning_points(time: Array, runs: Runs, series: Array, rate: Array) -> Array:
    """(2 N - 1, ...): a series (N, ...), and after each value the one at which it turns back before the next.

    Between samples it has the cubic whose values and rates (N, ...) are given. Where it does not turn back, or a run
    ends, the value itself is there once more.
    """
    out = np.repeat(series, 2, axis=0)[:-1]
    for first, end in runs:
        step = np.diff(time[first:end]).reshape(-1, *[1] * (series.ndim - 1))
        a, b = rate[first : end - 1] * step, rate[first + 1 : end] * step
        rise = np.diff(series[first:end], axis=0)
        # the value and a s + square s^2 + cube s^3: its slope changes sign once where a and b differ in theirs
        square, cube = 3.0 * rise - 2.0 * a - b, a + b - 2.0 * rise
        larger = -square - np.copysign(np.sqrt(np.maximum(square**2 - 3.0 * cube * a, 0.0)), square)
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = a / larger, larger / (3.0 * cube)
        s = np.where((one > 0) & (one < 1), one, other)
        s = np.where((a * b < 0) & (s > 0) & (s < 1), s, 0.0)
        out[2 * first + 1 : 2 * end - 2 : 2] += s * (a + s * (square + s * cube))
    return out


def _of_a_spline(time: Array, series: Array) -> Array:
    """d/dt of a series (N, ...) of `SPLINED` samples or more, by a spline of the fifth degree through them.

    Off by half a per cent for a turn of a right angle from one sample to the next, where central differences of fourth
    order lose 15.
    """
    from scipy.interpolate import make_interp_spline

    found: Array = make_interp_spline(time, series, k=SPLINED - 1)(time, 1)
    return found
