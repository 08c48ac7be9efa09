"""Logs that are written seldom: a value is held until the next one is read."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.smoothing import smoothed

LEAST_HELD = 3.0  # samples, on average: a log that changes more often is used as it is
LEAST_READINGS = 5
ONE_STEP = 0.9  # of the changes
STEPS_APART = 1.5  # the least change: more is two steps
REGULAR = 0.7  # of the readings come at the usual interval, within a third, and none much sooner: a series of its own


def unheld(time: Array, values: Array) -> Array:
    """A slow series (N,) between the moments at which its log changed, not held after them, and without the white
    noise of its readings.

    A value is right when it is read, and late until the next one: held, it seems to lag by half the time between two
    readings, and to jump. Readings at a regular interval are joined by a cubic spline: straight lines would round off
    what goes on between them, as if it lagged less. Beyond the last reading it stays held. What changes by a step of
    its resolution each time, whenever it comes to that, was not held but rounded.
    """
    from scipy.interpolate import CubicSpline

    changed = np.flatnonzero(np.diff(values, prepend=np.nan) != 0)
    if len(changed) < LEAST_READINGS or len(values) < LEAST_HELD * len(changed):
        return smoothed(time, values)
    at, readings = time[changed], values[changed]
    if by_single_steps(readings):
        return unrounded(time, values)
    interval = np.diff(at)
    usual = float(np.median(interval))
    if np.mean(np.abs(interval - usual) < usual / 3.0) < REGULAR or interval.min() < usual / 2.0:
        return np.interp(time, at, readings)
    out: Array = CubicSpline(at, smoothed(at, readings), bc_type="natural")(np.clip(time, at[0], at[-1]))
    return out


def unrounded(time: Array, values: Array) -> Array:
    """A slow series (N,) from one that was rounded to some step: where it changes it is half way between two of them.

    Between two changes it went straight; where it turned back, it was at its rounded value in the middle, if it stayed
    there as long as it takes from one change to the next elsewhere (else it flickers about half a step). So it was at
    the ends.
    """
    changed = np.flatnonzero(np.diff(values) != 0) + 1
    at = (time[changed - 1] + time[changed]) / 2.0
    half = (values[changed - 1] + values[changed]) / 2.0
    stays, back = np.diff(at), np.diff(values[changed], prepend=values[changed[0] - 1])
    turns = np.sign(back[:-1]) != np.sign(back[1:])
    onward = stays[~turns]
    turned = turns & (stays > (np.median(onward) / 2.0 if len(onward) else np.inf))
    tops = np.flatnonzero(turned)
    points = np.concatenate([at, (at[tops] + at[tops + 1]) / 2.0, time[[0, -1]]])
    course = np.concatenate([half, values[changed[tops]], values[[0, -1]]])
    order = np.argsort(points, kind="stable")
    return np.interp(time, points[order], course[order])


def by_single_steps(readings: Array) -> bool:
    """Whether a series that changes at these readings does so by one step at a time, as what is slow does once it is
    rounded."""
    steps = np.abs(np.diff(readings))
    return bool(np.mean(steps < STEPS_APART * steps.min()) >= ONE_STEP)
