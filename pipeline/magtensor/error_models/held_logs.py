"""Logs that are written seldom: a value is held until the next one is read."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.smoothing import smoothed

LEAST_HELD = 3.0  # samples, on average: a log that changes more often is used as it is
LEAST_READINGS = 5
REGULAR = 0.7  # of the readings come at the usual interval, within a third, and none much sooner: a series of its own


def unheld(time: Array, values: Array) -> Array:
    """A slow series (N,) between the moments at which its log changed, not held after them, and without the white
    noise of its readings.

    A value is right when it is read, and late until the next one: held, it seems to lag by half the time between two
    readings, and to jump. Readings at a regular interval are joined by a cubic spline: straight lines would round off
    what goes on between them, as if it lagged less. Beyond the last reading it stays held.
    """
    from scipy.interpolate import CubicSpline

    changed = np.flatnonzero(np.diff(values, prepend=np.nan) != 0)
    if len(changed) < LEAST_READINGS or len(values) < LEAST_HELD * len(changed):
        return smoothed(time, values)
    at, readings = time[changed], values[changed]
    interval = np.diff(at)
    usual = float(np.median(interval))
    if np.mean(np.abs(interval - usual) < usual / 3.0) < REGULAR or interval.min() < usual / 2.0:
        return np.interp(time, at, readings)
    out: Array = CubicSpline(at, smoothed(at, readings), bc_type="natural")(np.clip(time, at[0], at[-1]))
    return out
