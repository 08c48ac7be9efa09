"""What an error model leaves open besides its coefficients: settings that are profiled over a range.

lag_s: Annotated[float, Range(0.0, 600.0)] = 0.0
channel: Annotated[str, AnyChannel("current_*")]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from magtensor.components import Component
    from magtensor.error_models.excitation import Excitation

_LEAST_REACH = 0.8  # of the samples, or of the survey's duration


@dataclass(frozen=True)
class Range:
    """Numbers between two limits.

    Attributes:
        low, high: the limits.
        count: how many are tried before the best is refined between its neighbours.
        spacing: "linear" or "log" (with 0 added in front where `low` is 0, and where it is below 0 the same on the
            other side, beyond `count`, up to a fifth of the survey: a log that is late tells nothing of the end).
        of_duration: the limits are fractions of the survey's duration.
        sampled: nothing shorter than the time between samples, which no sample would show, is tried or kept; where the
            field turns too fast between them to be known there, nothing shorter than twice that.
        late: below 0 the log of what is followed comes so much too late as a whole, in whatever form it is followed;
            such delays are no part of the grid, but found from the residual.
    """

    low: float
    high: float
    count: int = 9
    spacing: str = "linear"
    of_duration: bool = False
    sampled: bool = False
    late: bool = False

    def between(self, low: float, high: float) -> list[float]:
        """Values between two neighbours of the grid, where more than one could be the best there; none."""
        return []

    def values(self, x: Excitation) -> list[Any]:
        """The grid for a survey."""
        return [v for v in self._grid(x) if v >= self.least(x)]

    def least(self, x: Excitation) -> float:
        """The least value that the samples of a survey can show, s."""
        if not self.sampled:
            return -np.inf
        return 2.0 * x.spacing if x.turns_unseen else x.spacing

    def _grid(self, x: Excitation) -> list[float]:
        low, high = (self.low * x.duration, self.high * x.duration) if self.of_duration else (self.low, self.high)
        if self.spacing == "linear":
            return [float(v) for v in np.linspace(low, high, self.count)]
        first = low if low > 0 else high / 10 ** (self.count / 4)
        grid = [float(v) for v in np.geomspace(first, high, self.count - (low <= 0))]
        late = min(-low, (1.0 - _LEAST_REACH) * x.duration)
        return [-v for v in grid[::-1] if v <= late] + [0.0, *grid] if low <= 0 else grid


@dataclass(frozen=True)
class LagsOf(Range):
    """Time constants of a response to a logged vector, tried only where it changes within the runs of a survey: where
    every run stands still a lag is no more than a mean over the noise of the log.

    Attributes:
        channel: its name.
    """

    channel: str = ""

    def values(self, x: Excitation) -> list[Any]:
        """The grid for a survey."""
        still = self.channel in x.logged and not x.changes_within_runs(self.channel)
        return [self.low] if still else super().values(x)


@dataclass(frozen=True)
class Plays(Range):
    """Half widths of a play, nT, tried only where some output goes farther from where it began: a play that is never
    taken up follows nothing, and is no more than a scale factor."""

    def values(self, x: Excitation) -> list[Any]:
        """The grid for a survey."""
        farthest = float(np.max(np.abs(x.output - x.output[:1]), initial=0.0))
        return [v for v in super().values(x) if v < farthest]


@dataclass(frozen=True)
class Delays(Range):
    """Delays of the base station, s, that its readings can show: they reach all but a fifth of the samples then.

    Attributes:
        evenly: s, so far `count` values lie evenly; beyond it each is half as long again, and whole hours.
    """

    evenly: float = 120.0

    def values(self, x: Excitation) -> list[Any]:
        """The grid for a survey."""
        even = np.linspace(-self.evenly, self.evenly, self.count)
        longer = [*self.evenly * 1.5 ** np.arange(1.0, 20.0), *np.arange(3600.0, self.high + 1.0, 3600.0)]
        grid = sorted({*even, *longer, *(-v for v in longer)})
        within = (float(v) for v in grid if self.low <= v <= self.high)
        return [v for v in within if x.readings.reach(x.time + v) >= _LEAST_REACH]

    def between(self, low: float, high: float) -> list[float]:
        """Values between two of the grid, as near to each other as the even ones, which pulsations need."""
        step = 2.0 * self.evenly / (self.count - 1)
        return [float(v) for v in np.linspace(low, high, max(round((high - low) / step), 1) + 1)[1:-1]]


@dataclass(frozen=True)
class AnyChannel:
    """The logged channels whose names fit a pattern or that have certain units, those of `without` left out.

    Attributes:
        pattern: for the names.
        without: patterns for names that are left out.
        or_units: channels in units of this dimension fit whatever their name.
        but_units: channels in units of this dimension do not.
        vectors: channels with a value for each axis fit too.
    """

    pattern: str
    without: tuple[str, ...] = ()
    or_units: str = ""
    but_units: str = ""
    vectors: bool = True

    def values(self, x: Excitation) -> list[Any]:
        """The names of the channels a survey has."""
        found = set(x.channels_like(self.pattern, self.without))
        if self.or_units:
            found |= {n for n in x.channels_like("*", self.without) if _alike(x.units.get(n, ""), self.or_units)}
        if self.but_units:
            found = {n for n in found if not _alike(x.units.get(n, ""), self.but_units)}
        return sorted(n for n in found if self.vectors or not x.is_vector(n))

    def pick(self, x: Excitation, name: str) -> str:
        """The channel of that name; where it is "", the only one that fits.

        Raises:
            DataError: no channel of that name, or not exactly one fits.
        """
        from magtensor.errors import DataError, did_you_mean

        if name:
            if name not in x.logged:
                raise DataError(
                    f"no channel {name!r}{did_you_mean(name, x.logged)}",
                    hint=f"the survey has {', '.join(sorted(x.logged)) or 'none'}",
                )
            return name
        fitting = self.values(x)
        if len(fitting) != 1:
            raise DataError(
                f"{len(fitting)} channels fit {self.pattern!r}: {', '.join(fitting) or 'none'}",
                hint="name the channel in the recipe",
            )
        return str(fitting[0])


def _alike(units: str, other: str) -> bool:
    from magtensor.units import dimension, is_unit

    return is_unit(units) and dimension(units) == dimension(other)


@dataclass(frozen=True)
class Duration:
    """A time that is the survey's own duration, s, unless a recipe gives another one: kept with the model, so that it
    means the same on another survey."""

    def values(self, x: Excitation) -> list[Any]:
        """The survey's duration."""
        return [x.duration]


@dataclass(frozen=True)
class Choice:
    """A few fixed values."""

    options: tuple[Any, ...]

    def values(self, x: Excitation) -> list[Any]:
        """The options."""
        return list(self.options)


@dataclass(frozen=True)
class Forms(Choice):
    """Forms of the same response, alike in what they explain: the first is searched with, and an adopted model is given
    another one where the data separate the two."""

    def values(self, x: Excitation) -> list[Any]:
        """The first."""
        return list(self.options[:1])


class Cleaned(Forms):
    """A channel as it was logged, or without the noise of its log: forms alike only where that noise is small beside
    the channel's course. So the second one is tried as soon as a model is looked at closely."""


@dataclass(frozen=True)
class AsAWhole(Forms):
    """Whether what follows a channel is behind it with a time constant, or later as a whole, or earlier. Delays are
    found from what the channel has in common with the residual, and searched with where they are the likelier.

    Attributes:
        lag: the setting that is the lag, s.
    """

    options: tuple[bool, bool] = (False, True)
    lag: str = "lag_s"


@dataclass(frozen=True)
class Bends(Forms):
    """Values of a channel at which the line that a response follows bends: in between it is straight, and beyond the
    first and the last it goes on. None is searched with; they are found once nothing else explains what is left.

    Attributes:
        instead: the settings that say which powers of the channel are followed, at their first option beside bends.
    """

    options: tuple[Any, ...] = ((),)
    instead: tuple[str, ...] = ()


@dataclass(frozen=True)
class Beginning:
    """What a response that lags had from before the survey began, in the units of its channel.

    Settings are tried in equilibrium; with the lag that is best it is fitted where the data separate the two. It is no
    part of the calibration: what another survey began with is found from its own outputs (`another_survey`).

    Attributes:
        lag, unless: the settings that are the lag, and that say of it that it is none.
    """

    lag: str = "lag_s"
    unless: str = "delayed"

    def values(self, x: Excitation) -> list[Any]:
        """Equilibrium."""
        return [0.0]

    def matters(self, settings: Mapping[str, Any]) -> bool:
        """Whether there is a lag for these settings."""
        return bool(settings.get(self.lag, 0.0) > 0 and not settings.get(self.unless))


NOT_KNOWN = float("nan")  # what the response had when a survey began that the model was not fitted to


@dataclass(frozen=True)
class Orders(Choice):
    """Numbers of which a higher one keeps all coefficients of a lower one and adds some.

    The lowest is chosen that held-out blocks do not separate from the best.
    """


@dataclass(frozen=True)
class Laws(Choice):
    """Laws that the same thing may follow, all of them searched with.

    The first is the plainest: it is chosen where held-out blocks do not separate it from the best.
    """


@dataclass(frozen=True)
class EventTimes:
    """Times at which something may have happened, at a spacing, away from both ends, s after the start.

    Attributes:
        count: how many.
        since: the setting of the time at which that began which ends then, for parts of the survey that are too short
            for two grids.
    """

    count: int = 60
    since: str = ""

    def values(self, x: Excitation) -> list[Any]:
        """The grid for a survey."""
        edges = np.linspace(0.0, x.duration, self.count + 2)[1:-1]
        return [float(v) for v in edges]

    def short_parts(self, x: Excitation) -> list[tuple[float, float]]:
        """Where parts as long as the grid's spacing, half and a quarter of it begin and end, every half of a part."""
        found = []
        for k in range(3):
            length = x.duration / (self.count + 1) / 2**k
            begins = np.arange(0.5 * length, x.duration - 1.4 * length, 0.5 * length)
            found += [(float(begin), float(begin + length)) for begin in begins]
        return found


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


def profiled(model: Component) -> dict[str, Any]:
    """The settings of a model that are searched over, with their grids."""
    found = {}
    for name, parameter in model.parameters.items():
        for mark in getattr(parameter.annotation, "__metadata__", ()):
            if hasattr(mark, "values") and callable(mark.values):
                found[name] = mark
    return found
