"""The base station's own readings, which reach further than the survey does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array


@dataclass(frozen=True)
class Station:
    """Readings of the total field.

    Attributes:
        time: (M,) s on the survey's clock, increasing.
        field: (M,) nT, without the station's own noise as far as known.
    """

    time: Array
    field: Array

    def at(self, time: Array) -> Array:
        """The field (N,) nT at times (N,) s; held beyond the ends."""
        return np.interp(time, self.time, self.field)

    def reach(self, time: Array) -> float:
        """The share of the times (N,) s between the first and the last reading."""
        return float(np.mean((time >= self.time[0]) & (time <= self.time[-1])))
