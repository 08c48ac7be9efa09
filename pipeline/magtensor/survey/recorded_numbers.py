"""The numbers that a recording holds: the step they were rounded to, the runs of equal ones, and how far they move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtensor.in_a_row import in_a_row

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LOOKED_AT = 200_000  # samples; a step shows in these as in ten million


def resolution(values: Floats, *, repeats: float = 0.1) -> float:
    """The quantisation step of a channel, 0 where none shows.

    The largest number of which (nearly) all differences between recorded values are whole multiples, found as
    Euclid finds a common divisor; 2 % of a step is granted for rounding and 5 % of the differences for corrupt
    values. Noise that was never quantised hardly ever repeats, and its common divisor falls to the rounding error.

    Args:
        values: (N,) numbers, NaN allowed.
        repeats: the part of them that have to be equal to another one; none of what sweeps over all its range.
    """
    thinned = values[:: max(1, len(values) // LOOKED_AT)]
    finite = thinned[np.isfinite(thinned)]
    distinct = np.unique(finite)
    if len(distinct) < 3 or len(distinct) > (1.0 - repeats) * len(finite):
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
    starts, stops = in_a_row(equal).T
    return starts, stops - starts + 1


def believable_run(count: int, repeats: float, least: float = 10.0) -> float:
    """The longest run of one number that chance explains.

    If a share q of the samples repeats the one before (slow instruments, coarse steps), the longest run to be
    expected among N samples is about ln N / -ln q; a chance of 1e-6 is granted, and `least` samples in any case.

    Args:
        count: N.
        repeats: q.
        least: a longer one may yet be chance, where the share is not known for a part of the record.
    """
    share = min(max(repeats, 1.0 / count), 1.0 - 1.0 / count)
    return float(max(least, np.log(count * 1e6) / -np.log(share)))


def span(field: Floats) -> float:
    """How far the field vector moved from where it was, nT; of several sensors the one that moved least."""
    away = np.linalg.norm(field - field[0], axis=-1)
    if not np.isfinite(away).any():
        return 0.0
    return float(np.min(np.nanmax(np.where(np.isfinite(away), away, 0.0), axis=0)))


def noise(field: Floats) -> float:
    """Noise from second differences, which a smooth motion hardly enters, nT; the noisiest axis."""
    second = np.abs(field[2:] - 2 * field[1:-1] + field[:-2])
    return float(np.max(np.nan_to_num(np.nanmedian(second, axis=0)))) * 1.4826 / np.sqrt(6.0)
