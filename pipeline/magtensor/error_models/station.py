"""The base station's own readings, which reach further than the survey does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magtensor.between_readings import Course, course
from magtensor.calibration.types import Array


@dataclass(frozen=True)
class Between:
    """Where times (N,) lie between a base station's readings.

    Attributes:
        number: (N,) how many readings there are until then.
        share: (N,) of the time from the reading before to the one after that has gone by; 0 or 1 beyond the ends.
        apart_s: (N,) from the one reading to the other; beyond the ends, of the two nearest.
    """

    number: NDArray[np.intp]
    share: Array
    apart_s: Array


@dataclass(frozen=True)
class Station:
    """Readings of the total field.

    Attributes:
        time: (M,) s on the survey's clock, increasing.
        field: (M,) nT, without the station's own noise as far as known.
        how: what goes on between its readings, as the total field was read.
    """

    time: Array
    field: Array
    how: Course = "linear"

    def at(self, time: Array) -> Array:
        """The field (N,) nT at times (N,) s; held beyond the ends."""
        return self._course(np.clip(time, self.time[0], self.time[-1]))

    @cached_property
    def _course(self) -> Callable[[Array], Array]:
        return course(self.time, self.field, self.how)

    @property
    def step_s(self) -> float:
        """Median time between its readings."""
        return float(np.median(np.diff(self.time)))

    def known(self, time: Array) -> NDArray[np.bool_]:
        """(N,) at which of the times (N,) s the field is: not before the second reading nor after the last but one, for
        at an end of what was read its noise is hard to tell from its course."""
        begin, end = (self.time[1], self.time[-2]) if len(self.time) > 3 else (self.time[0], self.time[-1])
        return (time >= begin) & (time <= end)

    def between(self, time: Array) -> Between:
        """Where times (N,) s lie between the readings."""
        number = np.searchsorted(self.time, time, side="right")
        after = np.clip(number, 1, len(self.time) - 1)
        apart = self.time[after] - self.time[after - 1]
        return Between(number, np.clip((time - self.time[after - 1]) / apart, 0.0, 1.0), apart)

    def reach(self, time: Array) -> float:
        """The share of the times (N,) s between the first and the last reading."""
        return float(np.mean((time >= self.time[0]) & (time <= self.time[-1])))
