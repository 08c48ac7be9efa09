"""What a calibration with error models is made of: its samples, its models, how it is fitted and where it stands."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.joint import JointFit
from magtensor.calibration.nominal import Nominal
from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel, Duration, EventTimes, Range, profiled
from magtensor.error_models.station import Station
from magtensor.error_models.terms import Terms, joined
from magtensor.errors import UsageError
from magtensor.loop.evidence.assessment import Colours, colours_of
from magtensor.loop.evidence.estimate import Estimate
from magtensor.loop.evidence.residual import Residual


@dataclass(frozen=True)
class Record:
    """The samples of a survey that the loop may use.

    Attributes:
        time: (N,) s; start: s, where the survey began.
        raw: (N, S, 3) nT; total_field: (N,) nT or None.
        quiet_field: (N,) nT, the total field without the reference's own noise, for regressors; None without one.
        sensors: names.
        logged: channels at the samples, their origins taken off; origins: those; units: of each.
        run, segment: (N,) as in Excitation.
        position: (S, 3) m or None; attitude: (N, 4) or None.
        samples: (N,) their numbers in the survey.
        waveform: (N,) of a source that nobody logged, once it was found.
        station: the base station's own readings without their noise; None where only `total_field` is known.
        courses: of its thermometers, as in Excitation.
        absent: names of channels that are missing too often to be searched.
        readings: (N, S) which sensor's sample may be used and is a reading; None where all are.
    """

    time: Array
    start: float
    raw: Array
    total_field: Array | None
    quiet_field: Array | None
    sensors: tuple[str, ...]
    logged: Mapping[str, Array]
    origins: Mapping[str, Array]
    units: Mapping[str, str]
    run: NDArray[np.int_]
    segment: NDArray[np.int_]
    position: Array | None
    attitude: Array | None
    samples: NDArray[np.int_]
    waveform: Array | None = None
    station: Station | None = None
    courses: dict[str, tuple[Array, Array]] = field(default_factory=dict, compare=False, repr=False)
    absent: tuple[str, ...] = ()
    readings: NDArray[np.bool_] | None = None

    def at(self, keep: NDArray[np.int_]) -> Record:
        """Some of the samples."""
        return replace(
            self,
            time=self.time[keep],
            raw=self.raw[keep],
            total_field=None if self.total_field is None else self.total_field[keep],
            quiet_field=None if self.quiet_field is None else self.quiet_field[keep],
            logged={k: v[keep] for k, v in self.logged.items()},
            run=self.run[keep],
            segment=self.segment[keep],
            attitude=None if self.attitude is None else self.attitude[keep],
            samples=self.samples[keep],
            waveform=None if self.waveform is None else self.waveform[keep],
            courses={},
            readings=None if self.readings is None else self.readings[keep],
        )

    def believed(self, values: Array) -> Array:
        """Values (N, S, 3), missing for a sensor that gives no reading while another one does."""
        if self.readings is None or self.readings.all():
            return values
        silent = ~self.readings & self.readings.any(axis=1, keepdims=True)
        return np.where(silent[..., None], np.nan, values)

    def excitation(
        self,
        output: Array,
        field_: Array,
        lines: Sequence[float] = (),
        *,
        matrix: Array | None = None,
        again: tuple[Array, Array] | None = None,
    ) -> Excitation:
        """What error models see, given the modelled outputs and fields (N, S, 3).

        Parameters
        ----------
        matrix: (S, 3, 3) C by which outputs follow from fields; None where the two have to tell.
        again: as in `Excitation`.
        """
        x = Excitation(
            self.time, self.start, self.sensors, output, field_, self.quiet_field, self.logged, self.units, self.run,
            self.segment, self.position, self.attitude, tuple(lines), self.waveform, station=self.station,
            courses=self.courses, again=again,
        )  # fmt: skip
        if matrix is not None:
            vars(x)["matrix"] = matrix
        return x


LAW = 5e-4  # of the variance: the law of what follows the turning is known to 2 %, in the second order not, and what a
# log of its own shows of a sensor is no better known


def regressors(component: Component, x: Excitation, settings: Mapping[str, Any]) -> Terms:
    """An error model's terms on a survey.

    Raises
    ------
    UsageError: the plugin gives something else.
    """
    terms = component.function(x, **settings)
    if not isinstance(terms, Terms):
        raise UsageError(
            f"the error model {component.name} gives {type(terms).__name__}; "
            "magtensor.error_models.terms.Terms would be right"
        )
    if x.noisier is not None:
        terms = replace(terms, noise=_noise_in(terms, component, x.noisier, settings))
    if turning(component) or _follows_logs_of_each(component, x, settings):
        terms = replace(terms, noise=np.maximum(terms.noise, LAW))
    return terms


def _follows_logs_of_each(component: Component, x: Excitation, settings: Mapping[str, Any]) -> bool:
    """Whether a model follows a log that has a value for each of several sensors."""
    marks = {name: mark for name, mark in profiled(component).items() if isinstance(mark, AnyChannel)}
    names = {str(settings.get(name, "")) or next(iter(mark.values(x)), "") for name, mark in marks.items()}
    logs = [name for name in names if name in x.logged and not x.is_vector(name)]
    return len(x.sensors) > 1 and any(x.logged[name].ndim == 2 for name in logs)


def turning(component: Component) -> bool:
    """Whether an effect follows the turning of the platform, by a law that is known to first order."""
    return "rotation" in component.declared({}).needs


def _noise_in(terms: Terms, component: Component, noisier: Excitation, settings: Mapping[str, Any]) -> Array:
    """(K,) part of the variance of each series that noise of the outputs makes: what as much noise again changes."""
    again = component.function(noisier, **settings)
    if again.series.shape != terms.series.shape:
        return np.zeros(terms.series.shape[1])
    made = np.mean((again.series - terms.series) ** 2, axis=0)
    out: Array = np.minimum(made / np.maximum(terms.series.var(axis=0), 1e-300), 1.0)
    return out


@dataclass(frozen=True)
class Adopted:
    """An error model in the calibration.

    Attributes:
        component: the plugin's function with its kind.
        settings: chosen values.
        sensors: names of the sensors it acts on; () for one that is not of single sensors.
        start: s on the survey's clock, from which its times count; None for the survey's own start.
    """

    component: Component
    settings: Mapping[str, Any]
    sensors: tuple[str, ...] = ()
    start: float | None = None

    @property
    def name(self) -> str:
        return self.component.name

    def channels(self, x: Excitation) -> set[str]:
        """The logged channels that it follows."""
        marks = profiled(self.component).items()
        return {mark.pick(x, str(self.settings.get(name, ""))) for name, mark in marks if isinstance(mark, AnyChannel)}

    @property
    def shifted_s(self) -> float:
        """s by which it acts after what it follows was logged, as a whole, or before, if negative: of as much at the
        beginning or at the end of a survey the log tells nothing."""
        lag, grid = float(self.settings.get("lag_s", 0.0)), profiled(self.component).get("lag_s")
        if not isinstance(grid, Range) or grid.spacing != "log":
            return 0.0
        return lag if self.settings.get("delayed", False) or (grid.late and lag < 0) else 0.0

    def terms(self, x: Excitation) -> Terms:
        """Its regressors on a survey, those of other sensors left out."""
        if self.start is not None:
            x = replace(x, start=self.start)
        every = regressors(self.component, x, self.settings)
        if not self.sensors:
            return every
        return every.only(i for i, s in enumerate(every.sensors) if s in self.sensors or s == "")


def as_declared(chosen: Iterable[tuple[Component, Mapping[str, Any]]], time: Array) -> list[Adopted]:
    """Error models that a recipe declares for a survey with samples at these times (N,) s, whose duration stands where
    a model knows a course over so much time and the recipe does not say over how much."""
    models = []
    for component, settings in chosen:
        spans = {name for name, mark in profiled(component).items() if isinstance(mark, Duration)}
        known = dict.fromkeys(spans - set(settings), float(time[-1] - time[0]))
        models.append(Adopted(component, {**settings, **known}))
    return models


def unread(adopted: Sequence[Adopted], time: Array, station: Station | None = None) -> NDArray[np.bool_]:
    """(N,) samples at whose times (N,) s nothing is known of what an adopted model follows.

    A channel had not been read yet, its log being late, or what was read before the log begins still acts: the model
    goes on as well as it can. Or the stamps of a base station are late or early, and the field is not known at them as
    they are or as they should be.
    """
    out = np.zeros(len(time), dtype=bool)
    for model in adopted:
        if shift := model.shifted_s:
            out |= (time - shift < time[0]) | (time - shift > time[-1])
        lag = float(model.settings.get("lag_s", 0.0)) if model.component.effect == "reference" else 0.0
        if station is not None and lag:
            out |= ~(station.known(time) & station.known(time + lag))
    return out


CHANNEL = "channel_response"  # of a channel that nobody wrote a model for


def of_time(component: Component) -> bool:
    """Whether an effect drifts, warms up or happens once: a setting is a time of the survey, or a part of it."""
    return any(
        isinstance(grid, (Duration, EventTimes)) or (isinstance(grid, Range) and grid.of_duration)
        for grid in profiled(component).values()
    )


def generic(model: Adopted) -> bool:
    """A model of anything that follows a channel says less than one that names a cause."""
    return model.name in (CHANNEL, "channel_rate", "latent_source")


def of_the_site(component: Component) -> bool:
    """Whether a model is of sources that are fixed in the world."""
    return component.effect == "site" and "attitude" in component.declared({}).needs


@dataclass(frozen=True)
class State:
    """A calibration with its error models, fitted.

    Attributes:
        adopted: the error models.
        theta: coefficients of each.
        fit: C and o.
        residual: what is left, and its tangent space, at `quick` many of the samples that the fit believes.
        excitation: at all samples of the record.
        terms: of all adopted models, at the residual's samples; None without any.
        estimate: of all coefficients together; None without any.
        entire: the residual at all samples that the fit believes; None where `residual` is.
    """

    adopted: tuple[Adopted, ...]
    theta: tuple[Array, ...]
    fit: JointFit
    residual: Residual
    excitation: Excitation
    terms: Terms | None
    estimate: Estimate | None = None
    lines: tuple[float, ...] = field(default=())
    entire: Residual | None = None

    @cached_property
    def colours(self) -> Colours:
        """Of the residual."""
        return colours_of(self.residual)

    @property
    def unabridged(self) -> State:
        """The same at all samples that the fit believes."""
        if self.entire is None:
            return self
        terms = None if self.terms is None else joined([a.terms(self.excitation) for a in self.adopted])
        terms = None if terms is None else terms.at(self.entire.samples)
        return replace(self, residual=self.entire, terms=terms, entire=None)


@dataclass(frozen=True)
class Fitting:
    """How the joint fit is made.

    Attributes:
        reference_noise: nT, of the total field.
        worst_error: accepted predicted error of |b|, a fraction of F.
        noise: (S, 3) nT or None.
        complete: whether what the fit leaves is noise; while effects are still being searched it is not.
        searching: samples beyond all noise are believed where their neighbours agree (`stretches`), for an effect may
            yet explain them; otherwise where the noise is louder than elsewhere.
        nominal: what is assumed of the sensors where the attitudes do not determine them; None where they do.
        without: s, from when to when the noise is so loud that the calibration is better without these samples.
    """

    reference_noise: float = 0.0
    worst_error: float = 0.05
    noise: Array | None = None
    complete: bool = False
    searching: bool = True
    nominal: Nominal | None = None
    without: tuple[tuple[float, float], ...] = ()

    def among(self, time: Array) -> NDArray[np.bool_]:
        """(N,) the samples at these times (N,) s that are not too loud."""
        out = np.ones(len(time), dtype=bool)
        for begin, until in self.without:
            out &= (time < begin) | (time > until)
        return out
