"""The base station's own readings, which reach further than the survey does."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from magtensor.calibration.types import Array

if TYPE_CHECKING:
    from scipy.interpolate import PchipInterpolator


@dataclass(frozen=True)
class Station:
    """Readings of the total field.

    Attributes:
        time: (M,) s on the survey's clock, increasing.
        field: (M,) nT, without the station's own noise as far as known.
        smooth: read between its readings by a monotone cubic (PCHIP), as the total field was; else by straight lines.
    """

    time: Array
    field: Array
    smooth: bool = False

    def at(self, time: Array) -> Array:
        """The field (N,) nT at times (N,) s; held beyond the ends."""
        if self._cubic is None:
            return np.interp(time, self.time, self.field)
        out: Array = self._cubic(np.clip(time, self.time[0], self.time[-1]))
        return out

    @cached_property
    def _cubic(self) -> PchipInterpolator | None:
        from scipy.interpolate import PchipInterpolator

        return PchipInterpolator(self.time, self.field) if self.smooth and len(self.time) > 2 else None

    @property
    def step_s(self) -> float:
        """Median time between its readings."""
        return float(np.median(np.diff(self.time)))

    def reach(self, time: Array) -> float:
        """The share of the times (N,) s between the first and the last reading."""
        return float(np.mean((time >= self.time[0]) & (time <= self.time[-1])))
