"""What an error model leaves open besides its coefficients: settings that are profiled over a range.

    lag_s: Annotated[float, Range(0.0, 600.0)] = 0.0
    channel: Annotated[str, AnyChannel("current_*")]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from magtensor.loop.excitation import Excitation


@dataclass(frozen=True)
class Range:
    """Numbers between two limits.

    Attributes:
        low, high: the limits.
        count: how many are tried before the best is refined between its neighbours.
        spacing: "linear" or "log" (with 0 added in front where `low` is 0).
        of_duration: the limits are fractions of the survey's duration.
    """

    low: float
    high: float
    count: int = 9
    spacing: str = "linear"
    of_duration: bool = False

    def values(self, x: Excitation) -> list[Any]:
        """The grid for a survey."""
        low, high = (self.low * x.duration, self.high * x.duration) if self.of_duration else (self.low, self.high)
        if self.spacing == "linear":
            return [float(v) for v in np.linspace(low, high, self.count)]
        first = low if low > 0 else high / 10 ** (self.count / 4)
        grid = [float(v) for v in np.geomspace(first, high, self.count - (low <= 0))]
        return [0.0, *grid] if low <= 0 else grid


@dataclass(frozen=True)
class AnyChannel:
    """The logged channels whose names fit a pattern, those of `without` left out."""

    pattern: str
    without: tuple[str, ...] = ()

    def values(self, x: Excitation) -> list[Any]:
        """The names of the channels a survey has."""
        return x.channels_like(self.pattern, self.without)


@dataclass(frozen=True)
class Choice:
    """A few fixed values."""

    options: tuple[Any, ...]

    def values(self, x: Excitation) -> list[Any]:
        """The options."""
        return list(self.options)


@dataclass(frozen=True)
class EventTimes:
    """Times at which something may have happened, at a spacing, away from both ends, s after the start.

    Attributes:
        count: how many.
    """

    count: int = 60

    def values(self, x: Excitation) -> list[Any]:
        """The grid for a survey."""
        edges = np.linspace(0.0, x.duration, self.count + 2)[1:-1]
        return [float(v) for v in edges]


@dataclass(frozen=True)
class Frequencies:
    """The strongest lines in the spectrum of the residual, Hz.

    Attributes:
        count: how many.
    """

    count: int = 5

    def values(self, x: Excitation) -> list[Any]:
        """The candidates the residual's spectrum proposes."""
        return [float(f) for f in x.lines[: self.count]]
