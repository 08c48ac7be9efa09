"""Logs that are written seldom: a value is held until the next one is read."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.smoothing import smoothed

LEAST_HELD = 3.0  # samples, on average: a log that changes more often is used as it is
LEAST_READINGS = 5
REGULAR = 0.7  # of the readings come at the usual interval, within a third: a series of its own


def unheld(time: Array, values: Array) -> Array:
    """A slow series (N,) between the moments at which its log changed, not held after them, and without the white
    noise of its readings.

    A value is right when it is read, and late until the next one: held, it seems to lag by half the time between two
    readings, and to jump. Beyond the last reading it stays held.
    """
    changed = np.flatnonzero(np.diff(values, prepend=np.nan) != 0)
    if len(changed) < LEAST_READINGS or len(values) < LEAST_HELD * len(changed):
        return smoothed(time, values)
    readings, interval = values[changed], np.diff(time[changed])
    usual = float(np.median(interval))
    if np.mean(np.abs(interval - usual) < usual / 3.0) >= REGULAR:
        readings = smoothed(time[changed], readings)
    return np.interp(time, time[changed], readings)
