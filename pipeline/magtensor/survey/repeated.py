"""Rows that hold no reading of their own: a sensor or recorder that hangs, a table that repeats or fills in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtensor.in_a_row import in_a_row
from magtensor.survey.recorded_numbers import Bools, Floats, believable_run, noise, resolution, runs, span

# of the largest number: rounding of interpolated values that are stored in four bytes or in eight
SINGLE_PRECISION, DOUBLE_PRECISION = 2e-7, 1e-12
LEAST_FILLED_IN, MOST_FILLED_IN = 0.05, 0.96  # of the rows
NEARLY_ALL = 0.8  # of the rows that are alike on all axes
NOW_AND_THEN = 0.4  # of the rows at most: a sensor of half the rate repeats in every other one
LEAST_CHANGES, LEAST_HELD_ROWS = 5, 2.5  # of a series that repeats its readings; rows from one to the next
LEAST_STUCK = 2.0  # rows alike on all axes that are no fault, whatever other sensors do meanwhile
UNLIKELY_GRID = 1e-8  # that the changes of other series lie on a regular grid
LEAST_SEQUENCE = 50  # different rows one after the other
LAGS = 5  # between two rows that are alike, that are looked at: the most frequent
LEAST_SEVERAL = 0.2  # of the changes, by more than one of the smallest steps


def stuck(field: Floats, others: Floats | None = None) -> Bools:
    """(N,) True where a sensor repeats itself for longer than its own record makes believable.

    Rest makes long runs too, so a run also needs a witness: other sensors, all of which moved meanwhile by more
    than ten of their noise and of this sensor's steps, and then three rows suffice, for a sensor that moves with them
    does not repeat itself on all axes; or, without others, a jump at the run's end larger than 99 % of all steps, or
    that it never ends.

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
    believable = _believable(len(field), lengths, 10.0 if others is None else LEAST_STUCK)
    steps = np.nan_to_num(np.linalg.norm(np.diff(field, axis=0), axis=1))
    moving = steps[steps > 0]
    usual = float(np.percentile(moving, 99)) if moving.size else 0.0
    step = max(resolution(column) for column in field.T)
    enough = 10 * max(step, 0.0 if others is None else _noise_of_all(others))
    for start, length in zip(starts, lengths, strict=True):
        if length <= believable:
            continue
        stop = start + length
        if others is not None:
            found[start:stop] |= span(others[start:stop]) > enough
        else:
            found[start:stop] |= stop == len(field) or steps[stop - 1] > usual
    return found


def _believable(count: int, lengths: NDArray[np.intp], least: float) -> float:
    """The longest run that chance explains, of those there are: without the longest, which is the first suspect, and
    then without every other suspect, for faults must not make themselves look usual."""
    suspects = np.arange(len(lengths)) == np.argmax(lengths)
    for _ in range(2):
        share = float(np.sum(lengths[~suspects] - 1)) / max(count - int(lengths[suspects].sum()), 1)
        believable = believable_run(count, share, least)
        suspects = lengths > believable
    return believable


def _noise_of_all(field: Floats) -> float:
    """Noise of sensors (N, K, 3), nT: what they do not share, where that is less than what a smooth motion leaves."""
    count = field.shape[1]
    if count < 2:
        return noise(field)
    own = field - field.mean(axis=1, keepdims=True)
    return min(noise(field), noise(own) * float(np.sqrt(count / (count - 1.0))))


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
    believable = _believable(len(field), lengths, 10.0)
    suspect = lengths > believable
    if not suspect.any():
        return found
    step = max(resolution(values), 0.0 if others is None else noise(others))
    for start, length in zip(starts[suspect], lengths[suspect], strict=True):
        part = slice(start, start + length)
        if span(own[part]) <= 20 * step or not (np.diff(own[part], axis=0) != 0).any():
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


def left_behind(field: Floats, reading: Bools) -> Bools:
    """(N, S) True where a sensor repeats its reading, which it does now and then only, while another one goes on: what
    it says is a row old. A sensor that is slower than the recording does so all the time, and is no fault.

    Args:
        field: (N, S, 3) nT.
        reading: (N, S) rows with a reading of their own.
    """
    again = ~reading & reading.any(axis=1, keepdims=True)
    again[1:] &= (field[1:] == field[:-1]).all(axis=2)
    return np.asarray(again & (again.mean(axis=0) < NOW_AND_THEN))


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


def written_twice(field: Floats) -> tuple[int, int, int] | None:
    """The first row of a stretch, that of another one with the same readings, and their length; None where no noise
    comes twice. A sensor that rests repeats a row, and no sequence of them.

    Args:
        field: (N, S, 3) nT.
    """
    rows = np.ascontiguousarray(field.reshape(len(field), -1), dtype=np.float64)
    known = np.flatnonzero(np.isfinite(rows).all(axis=1))
    odd = np.random.default_rng(0).integers(0, 2**62, rows.shape[1], dtype=np.uint64) * np.uint64(2) + np.uint64(1)
    mixed = (rows[known].view(np.uint64) * odd).sum(axis=1, dtype=np.uint64)
    order = np.argsort(mixed, kind="stable")
    same = mixed[order[1:]] == mixed[order[:-1]]
    apart, often = np.unique((order[1:] - order[:-1])[same], return_counts=True)
    for lag in apart[np.argsort(-often)][:LAGS]:
        equal = mixed[lag:] == mixed[:-lag]
        for start, stop in in_a_row(equal):
            if len(np.unique(mixed[start:stop])) >= LEAST_SEQUENCE and np.array_equal(
                rows[known[start:stop]], rows[known[start + lag : stop + lag]]
            ):
                return int(known[start]), int(known[start + lag]), int(stop - start)
    return None


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
