"""What can be wrong with a survey's data: one small function for each fault.

The functions find; the stage `load` decides what to refuse and what to flag.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# The Earth's total field at its surface lies between 22 and 67 uT; offsets and nearby iron widen what a raw
# sensor shows, at 31 km height it is 1.5 % less. Half and twice are far from every factor between two units.
EARTH_FIELD_NT = (22_000.0, 67_000.0)
MARGIN = 2.0
LARGEST_ARRAY_M = 100.0
IMPOSSIBLE = 1e3  # times a sensor's median magnitude: no range reaches so far beyond what it measures
# of the largest number: rounding of interpolated values that are stored in four bytes or in eight
SINGLE_PRECISION, DOUBLE_PRECISION = 2e-7, 1e-12
LEAST_FILLED_IN, MOST_FILLED_IN = 0.05, 0.96  # of the rows
NEARLY_ALL = 0.8  # of the rows that are alike on all axes
LEAST_CHANGES, LEAST_HELD_ROWS = 5, 2.5  # of a series that repeats its readings; rows from one to the next
UNLIKELY_GRID = 1e-8  # that the changes of other series lie on a regular grid
LEAST_SEVERAL = 0.2  # of the changes, by more than one of the smallest steps
LOOKED_AT = 200_000  # samples; a step shows in these as in ten million
# What a number that was labelled nT may have been, with the factor that makes nT of it.
RIVALS = (
    ("uT labelled nT", 1e3), ("mG labelled nT", 1e2), ("G labelled nT", 1e5), ("mT labelled nT", 1e6),
    ("T labelled nT", 1e9), ("nT labelled uT, or pT labelled nT", 1e-3), ("nT labelled T", 1e-9),
)  # fmt: skip


def moves_on(time: Floats) -> Bools:
    """(N,) True for the samples to keep so that the time increases.

    Either a sample must be later than all before it (a clock that steps back), or earlier than all after it (one
    stamp that is far too late); whichever keeps more samples. A missing time is False.
    """
    known = np.isfinite(time)
    latest = np.maximum.accumulate(np.where(known, time, -np.inf))
    earliest = np.minimum.accumulate(np.where(known, time, np.inf)[::-1])[::-1]
    forward, backward = known.copy(), known.copy()
    forward[1:] &= time[1:] > latest[:-1]
    backward[:-1] &= time[:-1] < earliest[1:]
    return backward if backward.sum() > forward.sum() else forward


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


def resolution(values: Floats) -> float:
    """The quantisation step of a channel, 0 where none shows.

    The largest number of which (nearly) all differences between recorded values are whole multiples, found as
    Euclid finds a common divisor; 2 % of a step is granted for rounding and 5 % of the differences for corrupt
    values. Noise that was never quantised hardly ever repeats, and its common divisor falls to the rounding error.

    Args:
        values: (N,) numbers, NaN allowed.
    """
    thinned = values[:: max(1, len(values) // LOOKED_AT)]
    finite = thinned[np.isfinite(thinned)]
    distinct = np.unique(finite)
    if len(distinct) < 3 or len(distinct) > 0.9 * len(finite):
        return 0.0
    largest = max(abs(distinct[0]), abs(distinct[-1]))
    steps = np.diff(distinct)
    # Numbers that differ by rounding only (0.1 + 0.2 and 0.3) are the same recorded value.
    steps = steps[steps > 1e-9 * largest]
    if len(steps) < 2:
        return 0.0
    step = float(steps.min())
    while step > 1e-8 * largest:
        # The shortest difference may be off by the rounding of two printed numbers; the mean of its like is less.
        alike = steps[np.abs(steps - step) < 0.02 * step]
        step = float(alike.mean()) if len(alike) else step
        rest = np.abs(steps - np.round(steps / step) * step)
        off = rest > 0.02 * step
        if off.mean() <= 0.05:
            return step
        if len(distinct) < 5:
            return 0.0  # two or three differences have a common divisor by chance
        step = float(rest[off].min())
    return 0.0


def runs(equal: Bools) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Where runs of equal neighbours start, and how many samples each holds.

    Args:
        equal: (N-1,) True where a sample equals the one before.

    Returns:
        starts (R,) and lengths (R,), only runs of at least two samples.
    """
    edges = np.flatnonzero(np.diff(np.concatenate(([False], equal, [False])).astype(np.int8)))
    return edges[0::2], edges[1::2] - edges[0::2] + 1


def believable_run(count: int, repeats: float) -> float:
    """The longest run of one number that chance explains.

    If a share q of the samples repeats the one before (slow instruments, coarse steps), the longest run to be
    expected among N samples is about ln N / -ln q; a chance of 1e-6 is granted, and ten samples in any case.

    Args:
        count: N.
        repeats: q.
    """
    share = min(max(repeats, 1.0 / count), 1.0 - 1.0 / count)
    return float(max(10.0, np.log(count * 1e6) / -np.log(share)))


def stuck(field: Floats, others: Floats | None = None) -> Bools:
    """(N,) True where a sensor repeats itself for longer than its own record makes believable.

    Rest makes long runs too, so a run also needs a witness: other sensors, all of which moved meanwhile by more
    than ten of their noise and of this sensor's steps; or, without others, a jump at the run's end larger than
    99 % of all steps, or that it never ends.

    Args:
        field: (N, 3) nT, or more columns.
        others: (N, K, 3) nT; None where there is no other sensor.
    """
    found = np.zeros(len(field), dtype=bool)
    if len(field) < 20:
        return found
    equal = (field[1:] == field[:-1]).all(axis=1)
    starts, lengths = runs(equal)
    if len(starts) == 0:
        return found
    # Without its longest run, which is the suspect: one long fault must not make itself look usual.
    longest = int(lengths.max())
    believable = believable_run(len(field), (equal.sum() - (longest - 1)) / max(len(field) - longest, 1))
    steps = np.nan_to_num(np.linalg.norm(np.diff(field, axis=0), axis=1))
    moving = steps[steps > 0]
    usual = float(np.percentile(moving, 99)) if moving.size else 0.0
    step = max(resolution(column) for column in field.T)
    enough = 10 * max(step, 0.0 if others is None else _noise(others))
    for start, length in zip(starts, lengths, strict=True):
        if length <= believable:
            continue
        stop = start + length
        if others is not None:
            found[start:stop] |= _span(others[start:stop]) > enough
        else:
            found[start:stop] |= stop == len(field) or steps[stop - 1] > usual
    return found


def stuck_axis(field: Floats, axis: int, others: Floats | None = None) -> Bools:
    """(N,) True where one axis repeats itself while its sensor goes on.

    The witnesses are the other axes of the sensor; and, because a turn about an axis leaves its output alone, the
    other sensors, all of which must have seen the field move out of any plane.

    Args:
        field: (N, 3) nT.
        axis: which.
        others: (N, K, 3) nT; None where there is no other sensor.
    """
    found = np.zeros(len(field), dtype=bool)
    values, own = field[:, axis], np.delete(field, axis, axis=1)
    starts, lengths = runs(values[1:] == values[:-1])
    if len(field) < 20 or len(starts) == 0:
        return found
    longest = int(lengths.max())
    repeats = (values[1:] == values[:-1]).sum() - (longest - 1)
    believable = believable_run(len(field), repeats / max(len(field) - longest, 1))
    suspect = lengths > believable
    if not suspect.any():
        return found
    step = max(resolution(values), 0.0 if others is None else _noise(others))
    for start, length in zip(starts[suspect], lengths[suspect], strict=True):
        part = slice(start, start + length)
        if _span(own[part]) <= 20 * step or not (np.diff(own[part], axis=0) != 0).any():
            continue
        found[part] |= others is None or _thickness(others[part]) > 20 * step
    return found


def _thickness(field: Floats) -> float:
    """Standard deviation of the field (N, K, 3) along its weakest direction, nT; the sensor where it is least."""
    whole = field[np.isfinite(field).all(axis=(1, 2))]
    if len(whole) < 4:
        return 0.0
    centred = (whole - whole.mean(axis=0)).transpose(1, 0, 2)
    return float(np.linalg.svd(centred, compute_uv=False)[:, -1].min() / np.sqrt(len(whole)))


def frozen(field: Floats) -> Bools:
    """(N,) True where all sensors repeat all their numbers for longer than chance explains: the recorder hangs.

    Nothing is left as a witness that the platform moved, so a run counts if it ends in a larger jump than 99 % of
    all steps, or with the record.

    Args:
        field: (N, S, 3) nT.
    """
    return stuck(field.reshape(len(field), -1)) if field.shape[1] > 1 else np.zeros(len(field), dtype=bool)


def impossible(field: Floats) -> Bools:
    """(N, S, 3) True where a value is `IMPOSSIBLE` times as large as the sensor's median magnitude.

    Args:
        field: (N, S, 3) nT.
    """
    size = np.abs(np.where(np.isfinite(field), field, np.nan))
    found = np.zeros(field.shape, dtype=bool)
    for s in range(field.shape[1]):
        whole = size[np.isfinite(size[:, s]).all(axis=1), s]
        if len(whole):
            found[:, s] = size[:, s] > IMPOSSIBLE * float(np.median(whole.max(axis=1)))
    return found


def _span(field: Floats) -> float:
    """How far the field vector moved from where it was, nT; of several sensors the one that moved least."""
    away = np.linalg.norm(field - field[0], axis=-1)
    if not np.isfinite(away).any():
        return 0.0
    return float(np.min(np.nanmax(np.where(np.isfinite(away), away, 0.0), axis=0)))


def _noise(field: Floats) -> float:
    """Noise from second differences, which a smooth motion hardly enters, nT; the noisiest axis."""
    second = np.abs(field[2:] - 2 * field[1:-1] + field[:-2])
    return float(np.max(np.nan_to_num(np.nanmedian(second, axis=0)))) * 1.4826 / np.sqrt(6.0)


def dead_axes(field: Floats) -> list[int]:
    """The axes that never change while another of the same sensor does.

    Args:
        field: (N, 3) nT, NaN allowed.
    """
    spread = np.array([np.ptp(c[np.isfinite(c)]) if np.isfinite(c).any() else np.nan for c in field.T])
    return [a for a in range(3) if spread[a] == 0 and np.nanmax(spread) > 0]


def deaf_axes(field: Floats) -> list[tuple[int, int]]:
    """(sensor, axis) that hears the field a hundred times less than any axis of the other sensors: noise only.

    Turning the platform about one axis leaves one direction without change in every sensor alike; so a sensor's
    weakest direction is compared with the weakest of the others, whatever their axes are called.

    Args:
        field: (N, S, 3) nT; samples with NaN are left out.
    """
    whole = field[np.isfinite(field).all(axis=(1, 2))]
    if field.shape[1] < 2 or len(whole) < 10:
        return []
    weakest = np.array([np.linalg.svd(f - f.mean(axis=0), compute_uv=False)[-1] for f in whole.transpose(1, 0, 2)])
    found = []
    for s in range(field.shape[1]):
        if weakest[s] < 0.01 * np.delete(weakest, s).min():
            found.append((s, int(whole[:, s].std(axis=0).argmin())))
    return found


def saturated(field: Floats) -> Bools:
    """(N, 3) True where an axis sits at the end of its range.

    An amplifier or converter at its rail repeats one extreme number exactly. Runs of three or more at the extreme
    count if the other axes moved meanwhile by twenty steps (at rest a number repeats without fault), or if the run
    is longer than chance explains for this axis. They are saturation if together they hold at least five samples,
    ten times as many as the mean of the values within five steps below the extreme: turning points of a motion
    pile up too, but not on one number alone.

    Args:
        field: (N, 3) nT.
    """
    found = np.zeros(field.shape, dtype=bool)
    for axis in range(3):
        values = field[:, axis]
        finite = np.isfinite(values)
        if finite.sum() < 20 or np.ptp(values[finite]) == 0:
            continue
        step = resolution(values)
        others = np.delete(field, axis, axis=1)
        for rail, side in ((values[finite].max(), 1.0), (values[finite].min(), -1.0)):
            at = values == rail
            off = values[~at]
            believable = believable_run(len(values), float((off[1:] == off[:-1]).mean()) if len(off) > 1 else 0.0)
            starts, lengths = runs(at[1:] & at[:-1])
            count = sum(
                int(n)
                for a, n in zip(starts, lengths, strict=True)
                if n >= 3 and (_span(others[a : a + n]) > 20 * step or n > believable)
            )
            distance = side * (rail - values)
            near = int(((distance > 0) & (distance <= 5 * step)).sum())
            if count >= 5 and count >= 10 * near / 5:
                found[:, axis] |= at
    return found


def unit_suspicion(median_nT: float) -> str | None:
    """Why a median total field (nT, as labelled) cannot be the Earth's, and what unit would make it so; else None."""
    low, high = EARTH_FIELD_NT
    if low / MARGIN <= median_nT <= high * MARGIN:
        return None
    fitting = [what for what, factor in RIVALS if low <= median_nT * factor <= high]
    shown = f"the median magnitude is {median_nT:.6g} nT, the Earth's field is {low:g} to {high:g} nT"
    return f"{shown}; looks like {fitting[0]}" if fitting else shown


def copies(field: Floats) -> list[tuple[int, int, int, int]]:
    """Pairs of axes that hold the same numbers: (sensor, axis, sensor, axis).

    Two instruments never agree to the last digit over a survey that varies; one column given twice does.

    Args:
        field: (N, S, 3) nT.
    """
    count = len(field)
    flat = field.reshape(count, -1)
    probe = np.unique(np.linspace(0, count - 1, min(count, 1000)).astype(int))
    found = []
    for i in range(flat.shape[1]):
        for j in range(i + 1, flat.shape[1]):
            if not np.array_equal(flat[probe, i], flat[probe, j], equal_nan=True):
                continue
            whole = np.isfinite(flat[:, i])
            if np.array_equal(flat[:, i], flat[:, j], equal_nan=True) and whole.any() and np.ptp(flat[whole, i]) > 0:
                found.append((i // 3, i % 3, j // 3, j % 3))
    return found


def filled_in(field: Floats) -> Bools:
    """(N,) True where a row holds no reading of its own: a recording faster than its sensor repeats a reading, or holds
    values on the straight line between two.

    All axes do so at once; coarse steps and slow turns make each axis repeat by itself. Only rows where the field moves
    by three steps of the sensor tell the two apart.

    Args:
        field: (N, 3) nT.
    """
    none = np.zeros(len(field), dtype=bool)
    if np.isfinite(field).all(axis=1).sum() < 20:
        return none
    before, now, after = field[:-2], field[1:-1], field[2:]
    single = np.array_equal(field, field.astype(np.float32), equal_nan=True)
    rounding = (SINGLE_PRECISION if single else DOUBLE_PRECISION) * np.nanmax(np.abs(field))
    bend = np.abs(after - 2.0 * now + before)
    printed = _last_digit(field)
    if 100.0 * printed < np.nanpercentile(bend, 95):  # finer than the noise: the line was rounded to it
        rounding = max(rounding, 2.0 * printed)
    alike = (now == before) | (bend <= rounding)
    step = max(resolution(column) for column in field.T)
    moving = np.linalg.norm(after - before, axis=1) > 3.0 * step
    if moving.sum() < 20:
        return none
    together = float(alike[moving].all(axis=1).mean())
    shared = _at_once(together, alike[moving].mean(axis=0))
    if not LEAST_FILLED_IN < together < MOST_FILLED_IN or shared < NEARLY_ALL * together:
        return none
    bent = bend[moving & ~alike.all(axis=1)].max(axis=1)
    if np.median(bent) < 5.0 * rounding:  # so smooth that three rows are nearly straight
        return none
    none[1:-1] = alike.all(axis=1)
    none[-1] = (field[-1] == field[-2]).all()
    return none


def _last_digit(field: Floats) -> float:
    """A unit of the last decimal that all numbers were printed to, nT; 0 where they have more than four."""
    largest = np.nanmax(np.abs(field))
    for digits in range(5):
        if np.nanmax(np.abs(field - np.round(field, digits))) <= DOUBLE_PRECISION * largest:
            return float(10.0**-digits)
    return 0.0


def _at_once(together: float, each: Floats) -> float:
    """The share h of rows that are alike on all axes at once, where in the others each axis is alike by itself.

    Of all axes h + (1 - h) p1 p2 p3 are alike, of one h + (1 - h) p; given are those shares.
    """
    low, high = 0.0, together
    for _ in range(40):
        h = 0.5 * (low + high)
        beyond = (together - h) * (1.0 - h) ** (len(each) - 1) > np.prod(each - h)
        low, high = (h, high) if beyond else (low, h)
    return low


def held_readings(time: Floats, values: Floats) -> tuple[Bools, float] | None:
    """Which rows of a series hold a reading of its instrument, where a table of more rows repeats each until the next,
    and the time from one to the next, s; None where the rows are readings.

    The value changes on a regular grid then, three rows apart or more, and often by several of its smallest steps.
    Where coarse steps make a slow series repeat, it changes by one of them, at any time: each change lies on a grid by
    chance with the probability of one in as many rows as that has from one reading to the next.

    Args:
        time: (N,) s, increasing; values: (N,) without missing ones.
    """
    changed = np.flatnonzero(np.diff(values) != 0) + 1
    if len(changed) < LEAST_CHANGES:
        return None
    row, at = float(np.median(np.diff(time))), time[changed]
    steps, between = np.abs(np.diff(values)[changed - 1]), np.diff(at)
    several = np.mean(steps > 1.5 * steps.min())
    if between.min() < LEAST_HELD_ROWS * row or several < LEAST_SEVERAL:
        return None
    usual = float(between[between < 1.6 * between.min()].mean())
    number = np.concatenate([[0.0], np.cumsum(np.round(between / usual))])
    period, first = (float(v) for v in np.polyfit(number, at, 1))
    apart = at - first - period * number
    by_chance = (row / period) ** (len(changed) - 2)  # two of them make the grid
    if np.ptp(apart) > row or by_chance > UNLIKELY_GRID:
        return None
    begin = first + float(apart.min())  # of what a row shows at once
    grid = np.arange(np.floor((time[0] - begin) / period), np.ceil((time[-1] - begin) / period) + 1)
    own = np.searchsorted(time, begin + period * grid - 1e-6 * row)
    readings = np.zeros(len(time), dtype=bool)
    readings[own[own < len(time)]] = True
    readings[changed] = True
    readings[[0, -1]] = True  # held from before, and until after: nothing else is known there
    return readings, period


def new_share(field: Floats) -> float:
    """The share of samples that differ from the one before: below 1 where a sensor is slower than the recording.

    Args:
        field: (N, 3) nT.
    """
    return float(1.0 - (field[1:] == field[:-1]).all(axis=1).mean()) if len(field) > 1 else 1.0
