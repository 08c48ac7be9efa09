"""What an error model may look at: time, field, channels."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magtensor.attitude import into_platform_frame, to_world
from magtensor.calibration.by_sensor import by_sensor
from magtensor.calibration.types import Array
from magtensor.error_models import first_order, rates
from magtensor.error_models.acting import Acting
from magtensor.error_models.delays import contiguous
from magtensor.error_models.held_logs import unheld
from magtensor.error_models.station import Station
from magtensor.errors import DataError, did_you_mean

MOVING = 2.0  # times the noise, of a mean square that a dozen values or more make up
VECTORS = ("acceleration", "angular_rate")  # channels with a value for each axis whatever the number of sensors


@dataclass(frozen=True)
class Excitation(Acting):
    """A survey as error models see it.

    Attributes:
        time: (N,) s on the survey's clock.
        start: s, where the survey's time begins (drift and warm-up count from here).
        sensors: names.
        output: (N, S, 3) nT, raw output without noise as far as known: C b + o of the fitted field.
        field: (N, S, 3) nT at each sensor, in the common frame.
        total_field: (N,) nT of the reference; None where there is none.
        logged: name -> (N,), (N, S) or (N, 3); the mean over the calibration survey taken off.
        units: name -> units of the channel.
        run: (N,) number of the contiguous run a sample belongs to (a gap or a new segment starts one).
        segment: (N,) the survey's own segment number; all 0 where it has none.
        position: (S, 3) m; None where not known.
        attitude: (N, 4) scalar last, platform to world; None where not known.
        lines: Hz, the strongest lines in the residual's spectrum, for models that look for one.
        waveform: (N,) of a source that nobody logged, found in what the sensors share; None where none was.
        site: (N, S, 3) nT, what the adopted models of the site add to `field` at each sensor; None where they add none.
        station: the base station's own readings; None where `total_field` is all that is known of it.
        part_of: what this is a part of, and the numbers of the samples in it; None for a whole survey.
        courses: name of a thermometer -> its log, and its course without the noise of the log; filled as they are
            asked for, so that one is made for all fits of a record.
        apart: (N,) mean square of what a fit leaves between the sensors, whitened, at samples without a part in it too;
            known where what a model means is told. None elsewhere, and of a single sensor.
        again: `output` and `field` with as much noise again as they hold; None where that is too little to make any
            difference.
    """

    time: Array
    start: float
    sensors: tuple[str, ...]
    output: Array
    field: Array
    total_field: Array | None
    logged: Mapping[str, Array]
    units: Mapping[str, str]
    run: NDArray[np.int_]
    segment: NDArray[np.int_]
    position: Array | None = None
    attitude: Array | None = None
    lines: Sequence[float] = ()
    waveform: Array | None = None
    site: Array | None = None
    station: Station | None = None
    part_of: tuple[Excitation, NDArray[np.int_]] | None = None
    courses: dict[str, tuple[Array, Array]] = dataclasses.field(default_factory=dict, compare=False, repr=False)
    apart: Array | None = None
    again: tuple[Array, Array] | None = dataclasses.field(default=None, compare=False, repr=False)

    def at(self, samples: NDArray[np.int_]) -> Excitation:
        """What an error model sees that looks at some of the samples only, each by itself. Logged channels are seen
        through lags as in the whole survey."""
        chosen = replace(
            self,
            time=self.time[samples],
            output=self.output[samples],
            field=self.field[samples],
            total_field=None if self.total_field is None else self.total_field[samples],
            logged={name: values[samples] for name, values in self.logged.items()},
            run=self.run[samples],
            segment=self.segment[samples],
            attitude=None if self.attitude is None else self.attitude[samples],
            waveform=None if self.waveform is None else self.waveform[samples],
            site=None if self.site is None else self.site[samples],
            apart=None if self.apart is None else self.apart[samples],
            part_of=(self, samples),
            again=None,
        )
        vars(chosen)["matrix"] = self.matrix  # that of all samples
        return chosen

    @cached_property
    def noisier(self) -> Excitation | None:
        """The same seen through as much noise again; None where that makes no difference."""
        if self.again is None:
            return None
        output, field = self.again
        seen = replace(self, output=output, field=field, again=None)
        vars(seen)["matrix"] = self.matrix
        return seen

    @property
    def duration(self) -> float:
        """s, from first to last sample."""
        return float(self.time[-1] - self.time[0])

    @property
    def spacing(self) -> float:
        """s between neighbouring samples, the median."""
        return float(np.median(np.diff(self.time)))

    @property
    def elapsed(self) -> Array:
        """(N,) s since the survey's start."""
        return self.time - self.start

    @property
    def reference(self) -> Array:
        """(N,) nT, the reference total field.

        Raises:
            DataError: there is none.
        """
        if self.total_field is None:
            raise DataError("the survey has no reference total field")
        return self.total_field

    @cached_property
    def readings(self) -> Station:
        """Of the reference total field: the base station's own, or those at the samples.

        Raises:
            DataError: there is no reference.
        """
        return self.station or Station(self.time, self.reference)

    def channels_like(self, pattern: str, without: tuple[str, ...] = ()) -> list[str]:
        """The logged channels whose names fit."""
        return sorted(n for n in self.logged if fnmatchcase(n, pattern) and not any(fnmatchcase(n, w) for w in without))

    def channel(
        self, name: str, lag_s: float = 0.0, delayed: bool = False, smooth: bool = False, at_start: float = 0.0
    ) -> Array:
        """A logged channel, (N,), (N, S) or (N, 3), seen through a lag as in `lagged`, or later by it as a whole;
        `smooth`: without the noise of its log. `at_start`: by how much the lagged one exceeded its first reading then;
        taken for 0 where it is not known.

        Raises:
            KeyError: there is none of that name.
        """
        if name not in self.logged:
            raise KeyError(f"no channel {name}{did_you_mean(name, self.logged)}")
        if not (lag_s or smooth):
            return self.logged[name]
        seen = self._course(name, lag_s, delayed, smooth)
        if lag_s <= 0 or delayed:
            return seen
        return seen + self.dying(lag_s, at_start).reshape(-1, *[1] * (seen.ndim - 1))

    def rate_of(self, name: str, lag_s: float = 0.0, smooth: bool = False, at_start: float = 0.0) -> Array:
        """How fast a logged channel changes, (N,), (N, S) or (N, 3) in its units/s, seen through a first-order lag;
        `smooth` and `at_start` as in `channel`.

        Raises:
            KeyError: there is none of that name.
        """

        def made(x: Excitation) -> Array:
            return first_order.rate(x.time, x._without_noise(name) if smooth else x.channel(name), lag_s)

        rate = self._kept(("rate", name, lag_s, smooth), made)
        if lag_s <= 0:
            return rate
        return rate - self.dying(lag_s, at_start).reshape(-1, *[1] * (rate.ndim - 1)) / lag_s

    def dying(self, tau: float, at_start: float) -> Array:
        """(N,) what is left of what a first-order lag tau, s, was out of equilibrium by when the survey began; none
        where that is not known."""
        if not at_start or np.isnan(at_start):
            return np.zeros(len(self.time))
        whole = self.part_of[0] if self.part_of else self
        return at_start * np.exp((whole.time[0] - self.time) / tau)

    def thermometer(self, name: str, lag_s: float = 0.0, delayed: bool = False, at_start: float = 0.0) -> Array:
        """A logged temperature without the noise of its log, seen through a lag as in `channel`: what has a thermal
        mass does not jump, neither between samples nor where a log that is written seldom has a new value.

        Below 0 the thermometer is the one that is behind: with a time constant, so that the temperature is the logged
        one and that times its rate of change, or `delayed` as a whole; from where a log ends the temperature goes on
        straight.
        """
        if lag_s >= 0:
            return self.channel(name, lag_s, delayed, smooth=True, at_start=at_start)
        ahead = first_order.ahead if delayed else first_order.undone
        return self._kept((name, lag_s, delayed), lambda x: ahead(x.time, x.thermometer(name), -lag_s))

    def _course(self, name: str, lag_s: float, delayed: bool, smooth: bool) -> Array:
        def made(x: Excitation) -> Array:
            values = x._without_noise(name) if smooth else x.channel(name)
            seen = x.later if delayed else x.lagged
            return seen(values, lag_s) if lag_s else values

        return self._kept((name, lag_s, delayed, smooth), made)

    def _kept(self, key: tuple[Hashable, ...], made: Callable[[Excitation], Array]) -> Array:
        """What is made of the whole survey, once, at the samples of this part of it."""
        if self.part_of is not None:
            whole, samples = self.part_of
            return whole._kept(key, made)[samples]
        if key not in self._lagged:
            self._lagged[key] = made(self)
        return self._lagged[key]

    def _without_noise(self, name: str) -> Array:
        log = self.channel(name)
        if name not in self.courses or self.courses[name][0] is not log:
            columns = [unheld(self.time, column) for column in log.reshape(len(log), -1).T]
            self.courses[name] = log, np.column_stack(columns).reshape(log.shape)
        return self.courses[name][1]

    def is_vector(self, name: str) -> bool:
        """Whether a logged channel has a value for each axis rather than one, or one for each sensor."""
        shape = self.channel(name).shape
        return len(shape) == 2 and shape[1] == 3 and (len(self.sensors) != 3 or name in VECTORS)

    @cached_property
    def _lagged(self) -> dict[tuple[Hashable, ...], Array]:
        return {}

    @cached_property
    def uniform(self) -> bool:
        """Whether all sensors see one field."""
        return bool(np.array_equal(self.field, np.broadcast_to(self.field[:, :1], self.field.shape)))

    @property
    def local_field(self) -> Array:
        """(N, S, 3) nT: the field at each sensor with what is known of the site's own."""
        return self.field if self.site is None else self.field + self.site

    @property
    def field_or_fields(self) -> Array:
        """(N, 3) nT where all sensors see one field, else (N, S, 3)."""
        return self.field[:, 0] if self.uniform else self.field

    @cached_property
    def matrix(self) -> Array:
        """C (S, 3, 3) of each sensor, from output = C field + o.

        A field that stays in a plane shows only a part of it; the rest is that of the unit matrix.
        """
        b = self.field - self.field.mean(axis=0)
        beyond = self.output - self.output.mean(axis=0) - b
        grams = np.einsum("nsi,nsj->sij", b, b)
        mixed = np.einsum("nsi,nsj->sij", b, beyond)
        out: Array = np.eye(3) + np.swapaxes(np.linalg.pinv(grams, rcond=1e-9, hermitian=True) @ mixed, 1, 2)
        return out

    def sensed(self, vectors: Array) -> Array:
        """C v (N, S, 3): what the sensors make of a vector (N, 3), or one for each sensor, in the common frame."""
        return by_sensor(self.matrix, vectors)

    @cached_property
    def world_axes(self) -> Array:
        """(N, 3, 3): row k is the world's axis k in the platform frame.

        Raises:
            KeyError: the survey has no attitude.
        """
        if self.attitude is None:
            raise KeyError("the survey has no attitude")
        return to_world(self.attitude)

    @cached_property
    def from_platform(self) -> Array:
        """(3, 3): takes vectors of the platform frame into the common one, which a calibration without attitude puts
        near the mean of the sensors' axes, a degree from the platform's; the unit matrix without attitude."""
        if self.part_of is not None:
            return self.part_of[0].from_platform
        if self.attitude is None:
            return np.eye(3)
        return into_platform_frame(self.attitude, self.field.mean(axis=1)).T

    @cached_property
    def direction(self) -> Array:
        """(N, 3) or (N, S, 3), the unit vector along `field_or_fields`."""
        field = self.field_or_fields
        out: Array = field / np.linalg.norm(field, axis=-1, keepdims=True)
        return out

    @cached_property
    def gradient(self) -> Array:
        """(N, 3, 3) nT/m, [i, j] = dB_i / dx_j, by least squares from the field at the sensors and what is known of the
        site's own; 0 in a uniform field.

        Of an array that cannot determine it the smallest that fits.

        Raises:
            KeyError: the positions are not known.
        """
        from magtensor.tensor.elements import full
        from magtensor.tensor.geometry import array_design, array_radius

        if self.position is None:
            raise KeyError("the survey has no positions, so the field has no known gradient")
        if self.site is None and self.uniform:
            return np.zeros((len(self.time), 3, 3))  # not its rounding, which a coefficient could be found of
        solver = np.linalg.pinv(array_design(self.position, "gradient"))[3:8] / (array_radius(self.position) or 1.0)
        return full(self.local_field.reshape(len(self.time), -1) @ solver.T)

    def lagged(self, series: Array, tau: float) -> Array:
        """As `relaxed`, but straight across gaps: for what goes on between recordings, such as a temperature.

        A tau below 0 is the delay of a log that is late: the series comes so much earlier.
        """
        if tau < 0:
            return self.later(series, tau)
        return first_order.straight(self.time, np.asarray(series, dtype=float), tau) if tau > 0 else series

    def later(self, series: Array, delay: float) -> Array:
        """A series (N, ...) later by a delay, s, or earlier where that is below 0; held beyond its ends."""
        flat = np.asarray(series, dtype=float).reshape(len(self.time), -1)
        moved = [np.interp(self.time - delay, self.time, column) for column in flat.T]
        return np.column_stack(moved).reshape(np.shape(series))

    def relaxed(self, series: Array, tau: float) -> Array:
        """A series (N, ...) that turns with the platform, seen through a first-order lag tau, s.

        Each run starts in equilibrium with its first value.
        """
        if tau <= 0:
            return series
        out = np.array(series, dtype=float)
        for a, b in self.runs():
            response = first_order.smooth if b - a >= rates.SPLINED else first_order.straight
            out[a:b] = response(self.time[a:b], out[a:b], tau)
        return out

    def changes_within_runs(self, name: str) -> bool:
        """Whether a channel changes within runs by more than the noise that neighbouring samples show: means of four
        samples do, or of half a run that is shorter than eight."""
        series = self.logged[name].reshape(len(self.time), -1)
        runs = [series[a:b] for a, b in self.runs() if b - a >= 4]
        if not runs:
            return False
        noise = np.mean(np.concatenate([np.diff(run, axis=0) for run in runs]) ** 2) / 2.0
        square, freedom = 0.0, 0
        for run in runs:
            size = min(4, len(run) // 2)
            means = run[: len(run) // size * size].reshape(-1, size, run.shape[1]).mean(axis=1)
            square += size * float(np.sum((means - means.mean(axis=0)) ** 2))
            freedom += (len(means) - 1) * run.shape[1]
        return bool(square > MOVING * noise * freedom)

    def derivative(self, series: Array) -> Array:
        """d/dt of a series (N, ...), 1/s, within each run; zero where a run is a single sample."""
        return rates.derivative(self.time, self.runs(), series)

    @cached_property
    def turns(self) -> bool:
        """Whether the field turns, and slowly enough between the samples of a run for its rate to be known."""
        return rates.rate_known(self.time, self.runs(), self.field[:, 0])

    @property
    def swept(self) -> float:
        """rad, the rms angle between the field and its mean direction in the platform."""
        directions = self.field[:, 0] / np.linalg.norm(self.field[:, 0], axis=1, keepdims=True)
        return float(np.sqrt(max(1.0 - float(np.sum(directions.mean(axis=0) ** 2)), 0.0)))

    @property
    def turns_unseen(self) -> bool:
        """Whether there are runs long enough to tell how the field turns, and it does so too fast, or not at all."""
        return not self.turns and max(b - a for a, b in self.runs()) >= rates.LEAST_IN_A_RUN

    @cached_property
    def rate(self) -> Array:
        """dB/dt (N, 3) nT/s where all sensors see one field, else (N, S, 3)."""
        return rates.turning(self.time, self.runs(), self.field_or_fields)

    @cached_property
    def rate_error(self) -> float:
        """How wrong the rate of the field is, rms, as a share of it; 0 where it is not known at all."""
        return rates.error(self.time, self.runs(), self.field[:, 0]) if self.turns else 0.0

    @cached_property
    def curvature(self) -> Array:
        """d2B/dt2 (N, 3) nT/s2 where all sensors see one field, else (N, S, 3)."""
        return rates.curvature(self.time, self.runs(), self.field_or_fields, self.rate)

    @cached_property
    def with_turning_points(self) -> Array:
        """(2 N - 1, S, 3) nT: the outputs, and after each the one at which the field in it turns back before the next;
        the sample itself once more where it does not, or where the rate is not known."""
        if not self.turns:
            return np.repeat(self.output, 2, axis=0)[:-1]
        return rates.with_turning_points(self.time, self.runs(), self.output, self.sensed(self.rate))

    def runs(self) -> list[tuple[int, int]]:
        """(first, one past last) sample of each contiguous run."""
        return contiguous(self.run)
