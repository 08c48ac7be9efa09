"""What can be wrong with a survey's values: one small function for each fault.

The functions find; the stage `load` decides what to refuse and what to flag. Rows that repeat are in `repeated`.
"""

from __future__ import annotations

import re

import numpy as np

from magtensor.survey.recorded_numbers import Bools, Floats, believable_run, resolution, runs, span

# The Earth's total field at its surface lies between 22 and 67 uT; offsets and nearby iron widen what a raw
# sensor shows, at 31 km height it is 1.5 % less. Half and twice are far from every factor between two units.
EARTH_FIELD_NT = (22_000.0, 67_000.0)
MARGIN = 2.0
LARGEST_ARRAY_M = 100.0
FAR_FILL = 5.0  # times what all other values span
NINES = re.compile(r"-?9{2,}\.?9+")  # as six digits show it
ENORMOUS = 1e15  # no channel of an instrument goes so far in any units: what a file format puts where nothing is
ABSOLUTE_ZERO = -273.15  # degC
IMPOSSIBLE = 1e3  # times a sensor's median magnitude: no range reaches so far beyond what it measures
# What a number that was labelled nT may have been, with the factor that makes nT of it.
RIVALS = (
    ("uT labelled nT", 1e3), ("mG labelled nT", 1e2), ("G labelled nT", 1e5), ("mT labelled nT", 1e6),
    ("T labelled nT", 1e9), ("nT labelled uT, or pT labelled nT", 1e-3), ("nT labelled T", 1e-9),
)  # fmt: skip


def zeros(field: Floats) -> Bools:
    """(N, S) where a sensor gives zero on all axes of (N, S, 3) nT at once, and usually does not: no field does that,
    but a logger does that has nothing to write."""
    nothing = np.asarray((field == 0.0).all(axis=2))
    usual = nothing.mean(axis=0) < 0.5
    out: Bools = nothing & usual
    return out


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


def fill_value(values: Floats) -> float | None:
    """The number that stands for a missing value in a logged channel though nothing declares it; else None.

    Three nines or more, or a number beyond all that is measured (1e20, 9.96921e36), with either sign, that no other
    value of the channel comes near: farther from all of them than `FAR_FILL` times what they span. In less than half of
    the samples.

    Args:
        values: a channel, NaN allowed.
    """
    finite = values[np.isfinite(values)]
    for found in (float(finite.min()), float(finite.max())) if len(finite) else ():
        others = finite[finite != found]
        if len(others) <= len(finite) / 2 or not (NINES.fullmatch(f"{found:.6g}") or abs(found) > ENORMOUS):
            continue
        spread, away = float(np.ptp(others)), float(np.min(np.abs(others - found)))
        if 0 < FAR_FILL * spread < away:
            return found
    return None


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
                if n >= 3 and (span(others[a : a + n]) > 20 * step or n > believable)
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
