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

    def reach(self, time: Array) -> float:
        """The share of the times (N,) s between the first and the last reading."""
        return float(np.mean((time >= self.time[0]) & (time <= self.time[-1])))
