"""A calibration with error models: its data, its state, and the joint refit of everything."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration import joint
from magtensor.calibration.by_sensor import by_sensor
from magtensor.calibration.coverage import Coverage
from magtensor.calibration.joint import JointFit, fit_joint, nearest_frame
from magtensor.calibration.nominal import Nominal, fit_nominal
from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.errors import NotEnoughData, UsageError
from magtensor.loop.assessment import Colours, colours_of, estimated, log_likelihood
from magtensor.loop.delays import cleared
from magtensor.loop.excitation import Excitation
from magtensor.loop.residual import Residual, quick, residual_of, taken_off
from magtensor.loop.station import Station
from magtensor.loop.statistics import Estimate
from magtensor.loop.stretches import borne_out, louder
from magtensor.loop.terms import Terms, joined

MOST_ROUNDS = 6
_SLACK = 4.0  # in the error accepted while an effect may yet turn out to cause most of it
SETTLED = 0.02  # of a standard deviation
HARDLY_SHOWN = 1e3  # times the variance that a coefficient would have alone
SHOWN = 3.0  # standard deviations
_MATTERS = 1e-10  # of the square of the field: noise with less makes no regressor noisy
_SHARES = (1.0, 0.5, 0.1)  # of a step, tried in this order
_LIKELIHOOD_ROUNDING = 0.5  # a spectrum fitted anew is not the same to the last digit


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
        )

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


def regressors(component: Component, x: Excitation, settings: Mapping[str, Any]) -> Terms:
    """An error model's terms on a survey.

    Raises
    ------
    UsageError: the plugin gives something else.
    """
    terms = component.function(x, **settings)
    if not isinstance(terms, Terms):
        raise UsageError(
            f"the error model {component.name} gives {type(terms).__name__}; magtensor.loop.terms.Terms would be right"
        )
    return terms if x.noisier is None else replace(terms, noise=_noise_in(terms, component, x.noisier, settings))


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

    def terms(self, x: Excitation) -> Terms:
        """Its regressors on a survey, those of other sensors left out."""
        if self.start is not None:
            x = replace(x, start=self.start)
        every = regressors(self.component, x, self.settings)
        if not self.sensors:
            return every
        return every.only(i for i, s in enumerate(every.sensors) if s in self.sensors or s == "")


def generic(model: Adopted) -> bool:
    """A model of anything that follows a channel says less than one that names a cause."""
    return model.name in ("channel_response", "latent_source")


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
    """

    reference_noise: float = 0.0
    worst_error: float = 0.05
    noise: Array | None = None
    complete: bool = False
    searching: bool = True
    nominal: Nominal | None = None


def joint_state(
    record: Record,
    adopted: Sequence[Adopted],
    how: Fitting,
    start: Sequence[Array] | None = None,
    lines: Sequence[float] = (),
    keep: NDArray[np.bool_] | None = None,
) -> State:
    """Fit C, o and every coefficient together.

    C and o are solved in closed form for given coefficients; the coefficients then move by a Newton step in which
    C and o are free (their tangent space projected off), until both rest.

    Parameters
    ----------
    start: coefficients of each model to begin with; zero if None.
    keep: (N,) samples to believe; judged anew if None.
    """
    theta = [np.zeros(0)] * len(adopted) if start is None else [np.array(t) for t in start]
    raw, reference = record.raw, record.total_field
    estimate: Estimate | None = None
    terms: Terms | None = None
    known: Coverage | None = None
    for round_ in range(MOST_ROUNDS):
        fit = _fit(record, raw, reference, how, keep, known if round_ + 1 < MOST_ROUNDS else None)
        known = fit.coverage  # between the first fit and the last nobody asks
        x = beside_the_site(excitation_of(record, fit, raw, lines), adopted, theta)
        if not adopted:
            break
        each = [a.terms(x) for a in adopted]
        if round_ == 0:
            theta = [t if len(t) == e.count else np.zeros(e.count) for t, e in zip(theta, each, strict=True)]
            if any(t.any() for t in theta):
                raw, reference = without(record, each, theta)
                fit = _fit(record, raw, reference, how, keep)
                x = beside_the_site(excitation_of(record, fit, raw, lines), adopted, theta)
                each = [a.terms(x) for a in adopted]
        residual = quick(residual_of(fit, raw, reference, how.reference_noise))
        terms = joined(each).at(residual.samples)
        colours = colours_of(residual)
        estimate = estimated(residual, terms, colours)
        edges = np.cumsum([e.count for e in each])[:-1]
        before = np.concatenate(theta)
        # what no data show stays zero, whatever earlier rounds made of it
        shown = estimate.seen(before)
        after = shown + share_of(residual, terms, estimate.theta, colours) * estimate.theta
        theta = np.split(after, edges)
        raw, reference = without(record, each, theta)
        step = np.abs(after - before) / np.sqrt(np.maximum(np.diag(estimate.covariance), 1e-300))
        if np.max(step, initial=0.0) < SETTLED:
            fit = _fit(record, raw, reference, how, keep)
            x = beside_the_site(excitation_of(record, fit, raw, lines), adopted, theta)
            break
    if estimate is not None:
        shown = without_noise(np.concatenate(theta), estimate)
        if not np.array_equal(shown, np.concatenate(theta)):
            theta = np.split(shown, edges)
            raw, reference = without(record, each, theta)
            fit = _fit(record, raw, reference, how, keep)
            x = beside_the_site(excitation_of(record, fit, raw, lines), adopted, theta)
    return _state(record, adopted, theta, fit, raw, reference, how, x, estimate, lines)


def _state(
    record: Record,
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    fit: JointFit,
    raw: Array,
    reference: Array | None,
    how: Fitting,
    x: Excitation,
    estimate: Estimate | None,
    lines: Sequence[float],
) -> State:
    """What a fit of outputs and total field, with the effects taken off, leaves."""
    entire = residual_of(fit, raw, reference, how.reference_noise)
    entire = replace(entire, time=record.time[entire.samples])
    residual = quick(entire)
    terms = joined([a.terms(x) for a in adopted]).at(residual.samples) if adopted else None
    left_out = None if residual is entire else entire
    return State(tuple(adopted), tuple(theta), fit, residual, x, terms, estimate, tuple(lines), left_out)


def without_noise(theta: Array, estimate: Estimate) -> Array:
    """Coefficients (P,) without what noise alone has made of directions that the data hardly show.

    A delay of all sensors alike is a turn of the field, and shows in the second order only, if the total field is
    known: what is found of it is noise, many times what the differences between the sensors are known to, and would be
    applied to every survey. Such a direction stays zero until it is significant.
    """
    known = np.sqrt(np.maximum(np.diag(estimate.normal), 0.0))
    if not (known > 0).all():
        return theta
    inflated, directions = np.linalg.eigh(estimate.covariance * np.outer(known, known))
    for variance, direction in zip(inflated, directions.T / known, strict=True):
        along = float(theta @ direction) / float(direction @ direction)
        if variance > HARDLY_SHOWN and along**2 < SHOWN**2 * variance:
            theta = theta - along * direction
    return theta


def share_of(residual: Residual, terms: Terms, step: Array, colours: Colours) -> float:
    """The part of a step that makes the residual, in noise of its own colour then, likelier; 0 if none does.

    The step is the best one in noise of the colour that the residual has now, and the colour changes with it: a slow
    effect not quite taken off looks like slow noise, in which it is then taken off even less.
    """
    now = log_likelihood(residual, colours)
    for share in _SHARES:
        left = taken_off(residual, terms, share * step)
        if log_likelihood(left, colours_of(left)) >= now - _LIKELIHOOD_ROUNDING:
            return share
    return 0.0


def _fit(
    record: Record,
    raw: Array,
    reference: Array | None,
    how: Fitting,
    keep: NDArray[np.bool_] | None,
    known: Coverage | None = None,
) -> JointFit:
    assert reference is not None and record.total_field is not None and record.quiet_field is not None
    loud = record.total_field - record.quiet_field

    def fitted(believed: NDArray[np.bool_] | None) -> JointFit:
        options: dict[str, Any] = {
            "noise": how.noise, "reference_noise": how.reference_noise, "keep": believed, "complete": how.complete,
            "worst_error": how.worst_error if how.complete else _SLACK * how.worst_error,
        }  # fmt: skip
        if how.nominal is None:
            return fit_joint(raw, reference, known=known, **options)
        return fit_nominal(raw, reference, how.nominal, quiet_field=reference - loud, **options)

    try:
        fit = fitted(keep)
    except NotEnoughData:
        if not how.complete:  # refused with slack, it is refused without, and by the figures that were asked for
            _fit(record, raw, reference, replace(how, complete=True), keep)
        raise
    if keep is not None or fit.keep.all():
        return fit
    more = (borne_out if how.searching else louder)(fit, raw, reference, how.reference_noise)
    return fit if np.array_equal(more, fit.keep) else fitted(more)


def reweighed(record: Record, state: State, how: Fitting) -> State:
    """The state with C and o fitted as `how` says, its coefficients and the samples that it believes as they are."""
    each = [a.terms(state.excitation) for a in state.adopted]
    raw, reference = without(record, each, state.theta)
    fit = _fit(record, raw, reference, how, np.asarray(state.fit.keep))
    x = beside_the_site(excitation_of(record, fit, raw, state.lines), state.adopted, state.theta)
    return _state(record, state.adopted, state.theta, fit, raw, reference, how, x, state.estimate, state.lines)


def require_determined(record: Record, state: State, how: Fitting) -> None:
    """Refuse a calibration whose attitudes, with all that was adopted, do not determine C and o.

    Raises
    ------
    NotEnoughData: as in `fit_joint`.
    """
    raw, reference = without(record, [a.terms(state.excitation) for a in state.adopted], state.theta)
    _fit(record, raw, reference, replace(how, complete=True), np.asarray(state.fit.keep))


def with_colour(record: Record, state: State, how: Fitting) -> State:
    """The state whose calibration knows the colour of its noise, as its covariance needs it."""
    keep = slice(None) if state.fit.keep.all() else state.fit.keep
    raw, reference = without(record, [a.terms(state.excitation) for a in state.adopted], state.theta)
    assert reference is not None
    return replace(state, fit=joint.with_colour(state.fit, raw[keep], reference[keep], how.reference_noise))


def without(record: Record, each: Sequence[Terms], theta: Sequence[Array]) -> tuple[Array, Array | None]:
    """Raw outputs and total field with the terms' contributions taken off."""
    raw, reference = cleared(record.raw, record.time, record.run, each, theta), record.total_field
    if reference is not None:
        for terms, coefficients in zip(each, theta, strict=True):
            reference = reference - terms.on_reference(coefficients)
    return raw, reference


def excitation_of(record: Record, fit: JointFit, raw: Array, lines: Sequence[float] = ()) -> Excitation:
    """Modelled outputs and field of every sample from the common field of a fit, of the length that is known: the noise
    in what is seen of it is what the total field's residual is made of, and models would find it there.

    Parameters
    ----------
    raw: (N, S, 3) nT, that the fit was made from: a strong effect on one sensor would else be in the common field.
    """
    b = fit.scalar.field(fit.plane.coordinates(raw)) if fit.posterior is None else fit.posterior.field
    b = of_known_length(b, record.total_field)
    q = nearest_frame(fit.forward)

    def seen(b: Array) -> tuple[Array, Array]:
        return by_sensor(fit.forward, b) + fit.offset, np.repeat((b @ q)[:, None], len(record.sensors), axis=1)

    again, noise = None, fit.scalar.matrix  # of outputs divided by theirs
    if fit.posterior is None and np.mean(noise**2) > _MATTERS * np.mean(b**2):
        more = np.random.default_rng(0).normal(size=b.shape) @ noise.T
        again = seen(of_known_length(b + more, record.total_field))
    return record.excitation(*seen(b), lines, matrix=fit.forward @ q, again=again)


def of_known_length(b: Array, total_field: Array | None) -> Array:
    """Fields (N, 3) nT of the length (N,) nT that is known."""
    return b if total_field is None else b * (total_field / np.linalg.norm(b, axis=1))[:, None]


def beside_the_site(x: Excitation, adopted: Sequence[Adopted], theta: Sequence[Array]) -> Excitation:
    """What error models see beside those of the site that are adopted: the field of these at each sensor, too.

    Only of sources that are fixed in the world: their field is another one at each sensor, and turns with the attitude.
    """
    count, sensors = len(x.time), len(x.sensors)
    site = np.zeros((count, 3 * sensors))
    for model, coefficients in zip(adopted, theta, strict=True):
        if of_the_site(model.component) and np.any(coefficients):
            terms = model.terms(x)
            if terms.count == len(coefficients):  # a fit may begin from those of other settings
                site += terms.contribution(coefficients, 3 * sensors)
    if not site.any():
        return x
    seen = replace(x, site=by_sensor(np.linalg.inv(x.matrix), site.reshape(count, sensors, 3)))
    vars(seen)["matrix"] = x.matrix
    return seen


def of_the_site(component: Component) -> bool:
    """Whether a model is of sources that are fixed in the world."""
    return component.effect == "site" and "attitude" in component.declared({}).needs


Progress = Callable[[str], None]
