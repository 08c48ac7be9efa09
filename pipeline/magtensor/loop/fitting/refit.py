"""The joint fit of C, o and the coefficients of every error model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration import joint
from magtensor.calibration.coverage import Coverage
from magtensor.calibration.joint import JointFit, fit_recording
from magtensor.calibration.joint_together import MOSTLY
from magtensor.calibration.nominal import fit_nominal
from magtensor.calibration.recording import InMemory
from magtensor.calibration.types import Array
from magtensor.error_models.delays import cleared
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.needs import measured
from magtensor.error_models.terms import Terms, joined
from magtensor.errors import DataError, NotEnoughData
from magtensor.loop.evidence.assessment import WHITE, Colours, colours_of, estimated, log_likelihood
from magtensor.loop.evidence.estimate import Estimate
from magtensor.loop.evidence.residual import Residual, quick, residual_of, taken_off
from magtensor.loop.evidence.stretches import borne_out, louder, too_loud
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State, unread
from magtensor.loop.fitting.seen import beside_the_site, excitation_of

MOST_ROUNDS = 6
_SLACK = 4.0  # in the error accepted while an effect may yet turn out to cause most of it
SETTLED = 0.02  # of a standard deviation
HARDLY_SHOWN = 1e3  # times the variance that a coefficient would have alone
SHOWN = 3.0  # standard deviations
OF_A_LAW = 1e-3  # of what it explains: no law is known better
MOST_OF_THE_NOISE = 0.5  # of its square
_SHARES = (1.0, 0.5, 0.1)  # of a step, tried in this order
_LIKELIHOOD_ROUNDING = 0.5  # a spectrum fitted anew is not the same to the last digit


def joint_state(
    record: Record,
    adopted: Sequence[Adopted],
    how: Fitting,
    start: Sequence[Array] | None = None,
    lines: Sequence[float] = (),
    keep: NDArray[np.bool_] | None = None,
    seen: NDArray[np.bool_] | None = None,
) -> State:
    """Fit C, o and every coefficient together.

    C and o are solved in closed form for given coefficients; the coefficients then move by a Newton step in which
    C and o are free (their tangent space projected off), until both rest.

    Parameters
    ----------
    start: coefficients of each model to begin with; zero if None.
    keep: (N,) samples to believe; judged anew if None.
    seen: (N,) samples in whose field error models may look; those that the fit believes if None.
    """
    theta = [np.zeros(0)] * len(adopted) if start is None else [np.array(t) for t in start]
    raw, reference = record.raw, record.total_field
    estimate: Estimate | None = None
    terms: Terms | None = None
    fit: JointFit | None = None
    residual: Residual | None = None
    for round_ in range(MOST_ROUNDS):
        # what attitudes can determine nobody asks between the first fit and the last
        known = None if fit is None or round_ + 1 == MOST_ROUNDS else fit.coverage
        if fit is None:
            fit = _begun(record, adopted, theta, how, keep)
        else:
            fit = _fit(record, adopted, raw, reference, how, keep, known, fit)
        x = beside_the_site(excitation_of(record, fit, raw, lines, seen), adopted, theta)
        if not adopted:
            break
        each = [a.terms(x) for a in adopted]
        if round_ == 0:
            theta = [t if len(t) == e.count else np.zeros(e.count) for t, e in zip(theta, each, strict=True)]
        if any(t.any() for t in theta):
            # the coefficients are to be of these regressors, not of those that an earlier fit has made
            before_this = raw
            raw, reference = without(record, each, theta)
            if residual is None or _moved(raw - before_this, residual):
                fit = _fit(record, adopted, raw, reference, how, keep, start=fit)
                x = beside_the_site(excitation_of(record, fit, raw, lines, seen), adopted, theta)
                each = [a.terms(x) for a in adopted]
        residual = quick(residual_of(fit, raw, reference, how.reference_noise))
        terms = joined(each).at(residual.samples)
        colours = colours_of(residual)
        estimate = estimated(residual, terms, colours)
        edges = np.cumsum([e.count for e in each])[:-1]
        before = np.concatenate(theta)
        # what no data show stays zero, whatever earlier rounds made of it
        shown = estimate.seen(before)
        after = shown + move_of(residual, terms, estimate, colours, fresh=not before.any())
        theta = np.split(after, edges)
        raw, reference = without(record, each, theta)
        if small(after - before, estimate) or round_ + 1 == MOST_ROUNDS:
            fit = _fit(record, adopted, raw, reference, how, keep, start=fit)
            x = beside_the_site(excitation_of(record, fit, raw, lines, seen), adopted, theta)
            break
    if estimate is not None:
        shown = without_noise(np.concatenate(theta), estimate)
        if not np.array_equal(shown, np.concatenate(theta)):
            theta = np.split(shown, edges)
            raw, reference = without(record, each, theta)
            fit = _fit(record, adopted, raw, reference, how, keep, start=fit)
            x = beside_the_site(excitation_of(record, fit, raw, lines, seen), adopted, theta)
    assert fit is not None
    return _state(record, adopted, theta, fit, raw, reference, how, x, estimate, lines)


def _begun(
    record: Record,
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    how: Fitting,
    keep: NDArray[np.bool_] | None,
) -> JointFit:
    """The fit of the outputs as they are; where that is refused, for they hold an effect as strong as the field, of the
    outputs without what the coefficients add, the regressors made of the outputs themselves."""
    try:
        return _fit(record, adopted, record.raw, record.total_field, how, keep)
    except DataError:
        if not any(t.any() for t in theta):
            raise
        each = [a.terms(record.excitation(record.raw, record.raw)) for a in adopted]
        if [len(t) for t in theta] != [e.count for e in each]:
            raise
    return _fit(record, adopted, *without(record, each, theta), how, keep)


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
    reading_s = 0.0 if record.station is None else record.station.step_s
    entire = replace(entire, time=record.time[entire.samples], reading_s=reading_s)
    residual = quick(entire)
    terms = joined([a.terms(x) for a in adopted]).at(residual.samples) if adopted else None
    left_out = None if residual is entire else entire
    return State(tuple(adopted), tuple(theta), fit, residual, x, terms, estimate, tuple(lines), left_out)


def require_more_than_a_constant(record: Record, how: Fitting) -> None:
    """Refuse a single sensor near nominal that has but a constant to be compared with.

    Raises
    ------
    NotEnoughData: nothing tells what the sensor adds from the field.
    """
    field = record.total_field
    if how.nominal is None or field is None or record.raw.shape[1] > 1:
        return
    if not measured(field):
        raise NotEnoughData(
            "one sensor beside a total field that is a constant: what the sensor adds cannot be told from the field",
            hint="a measured total field, a second sensor, or attitudes all round would tell",
        )


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


def move_of(residual: Residual, terms: Terms, estimate: Estimate, colours: Colours, *, fresh: bool) -> Array:
    """(P,) by how much coefficients are moved, so that the residual gets likelier in noise of its own colour then.

    The estimate is the best one in noise of the colour that the residual has now, and the colour changes with it: a
    slow effect not quite taken off looks like slow noise, in which it is then taken off even less. A `fresh` one, of
    which nothing is taken off yet, may be that noise altogether: so it is sought in white noise as well. Not later:
    where a drift of another law stays, that is no noise either, and a response to a thermometer would follow it.
    """
    best, reached = _likelier(residual, terms, estimate.theta, colours)
    if fresh:
        other, likelihood = _likelier(residual, terms, estimated(residual, terms, WHITE).theta, colours)
        best = other if likelihood > reached else best
    return best


def _likelier(residual: Residual, terms: Terms, step: Array, colours: Colours) -> tuple[Array, float]:
    """The part of a step (P,) that makes the residual likelier, and how likely it is then; none of it if none does."""
    now = log_likelihood(residual, colours)
    for share in _SHARES:
        left = taken_off(residual, terms, share * step)
        if (likelihood := log_likelihood(left, colours_of(left))) >= now - _LIKELIHOOD_ROUNDING:
            return share * step, likelihood
    return np.zeros_like(step), now


def small(step: Array, estimate: Estimate) -> bool:
    """Whether a step (P,) is one that the data hardly see."""
    deviations = np.sqrt(np.maximum(np.diag(estimate.covariance), 1e-300))
    return bool(np.max(np.abs(step) / deviations, initial=0.0) < SETTLED)


def _moved(change: Array, residual: Residual) -> bool:
    """Whether a change of the outputs (N, S, 3), nT, shows beside their noise."""
    rms = np.sqrt(np.mean(change**2, axis=0)).ravel()
    return bool(np.any(rms > SETTLED * residual.noise))


def _fit(
    record: Record,
    adopted: Sequence[Adopted],
    raw: Array,
    reference: Array | None,
    how: Fitting,
    keep: NDArray[np.bool_] | None,
    known: Coverage | None = None,
    start: JointFit | None = None,
) -> JointFit:
    assert reference is not None and record.total_field is not None and record.quiet_field is not None
    loud = record.total_field - record.quiet_field
    usable = how.among(record.time) & ~unread(adopted, record.time, record.station)

    def fitted(believed: NDArray[np.bool_] | None) -> JointFit:
        options: dict[str, Any] = {
            "noise": how.noise, "reference_noise": how.reference_noise, "keep": believed, "complete": how.complete,
            "worst_error": how.worst_error if how.complete else _SLACK * how.worst_error,
        }  # fmt: skip
        if how.nominal is None:
            return fit_recording(InMemory(raw, reference, None if usable.all() else usable), known=known, **options)
        # what is searched near nominal is not refused for its attitudes
        seen = start.coverage if start is not None and how.searching else known
        return fit_nominal(
            raw, reference, how.nominal, quiet_field=reference - loud, start=start, known=seen, **options
        )

    try:
        fit = fitted(keep)
    except NotEnoughData:
        if not how.complete:  # refused with slack, it is refused without, and by the figures that were asked for
            _fit(record, adopted, raw, reference, replace(how, complete=True), keep)
        raise
    if keep is not None or fit.keep.all():
        return fit
    more = (borne_out if how.searching else louder)(fit, raw, reference, how.reference_noise)
    more = more & usable
    return fit if np.array_equal(more, fit.keep) else fitted(more)


def rounding(record: Record, state: State, sensor: int | None = None) -> float:
    """nT, the steps that the outputs come in, or those of one sensor, where rounding makes most of their noise; 0
    elsewhere."""
    from magtensor.survey.recorded_numbers import resolution

    asked = slice(None) if sensor is None else slice(3 * sensor, 3 * sensor + 3)
    outputs, noise = record.raw.reshape(len(record.raw), -1)[:, asked], state.residual.noise[asked]
    step = float(np.median([resolution(output, repeats=0.0) for output in outputs.T]))
    return step if step**2 / 12.0 > MOST_OF_THE_NOISE * float(np.median(noise)) ** 2 else 0.0


def loud_stretches(record: Record, state: State, how: Fitting) -> tuple[tuple[float, float], ...]:
    """s, from when to when the noise is so loud that the calibration is better without these samples; none beside an
    effect a thousand times as large. A stretch of which a fit doubts most is wrong, and not loud."""
    if rounding(record, state):
        return ()  # outputs that are repeated tell no noise
    each = [a.terms(state.excitation) for a in state.adopted]
    raw, reference = without(record, each, state.theta)
    assert reference is not None
    effects = [
        without(record, [terms], [-theta])[0] - record.raw for terms, theta in zip(each, state.theta, strict=True)
    ]
    if any(float(np.std(effect)) * OF_A_LAW > float(np.median(state.residual.noise)) for effect in effects):
        return ()  # it may be what their laws leave
    loud = too_loud(state.fit, raw, reference, effects, how.reference_noise)
    edges = np.flatnonzero(np.diff(loud.astype(int), prepend=0, append=0)).reshape(-1, 2)
    believed = [(first, end) for first, end in edges if np.mean(state.fit.keep[first:end]) >= 1.0 - MOSTLY]
    return tuple((float(record.time[first]), float(record.time[end - 1])) for first, end in believed)


def disturbed(record: Record, state: State, how: Fitting) -> NDArray[np.bool_]:
    """(N,) samples that neither the calibration nor noise explains, be it as loud as it is there; those at which a late
    log leaves the calibration without what it follows are none of them."""
    out = ~np.asarray(state.fit.keep) & ~unread(state.adopted, record.time, record.station)
    if not how.without or not out.any():
        return out
    raw, reference = without(record, [a.terms(state.excitation) for a in state.adopted], state.theta)
    assert reference is not None
    return out & (how.among(record.time) | ~louder(state.fit, raw, reference, how.reference_noise))


def settled(record: Record, state: State, how: Fitting) -> State:
    """The fit at the end of a search: what nothing explains is a disturbance after all, and no part of it.

    Samples that were flagged before an effect had a name may be good ones. Of what follows the field, or remembers it,
    they are not told, for error models do not look at the field of flagged ones: they are believed again if they fit
    with what they saw themselves.
    """
    ended = replace(how, searching=False)
    last = joint_state(record, state.adopted, ended, state.theta, state.lines)
    keep = np.asarray(last.fit.keep)
    if keep.all() or not state.adopted:
        return last
    try:
        every = joint_state(record, state.adopted, ended, last.theta, state.lines, seen=np.ones_like(keep))
        if not (more := np.asarray(every.fit.keep) & ~keep).any():
            return last
        again = joint_state(record, state.adopted, ended, last.theta, state.lines, seen=keep | more)
    except DataError:  # what disturbs them is as large as the field
        return last
    return again if np.sum(again.fit.keep) > np.sum(keep) else last


def reweighed(record: Record, state: State, how: Fitting) -> State:
    """The state with C and o fitted as `how` says, its coefficients and the samples that it believes as they are."""
    each = [a.terms(state.excitation) for a in state.adopted]
    raw, reference = without(record, each, state.theta)
    fit = _fit(record, state.adopted, raw, reference, how, np.asarray(state.fit.keep))
    x = beside_the_site(excitation_of(record, fit, raw, state.lines), state.adopted, state.theta)
    return _state(record, state.adopted, state.theta, fit, raw, reference, how, x, state.estimate, state.lines)


def require_determined(record: Record, state: State, how: Fitting) -> None:
    """Refuse a calibration whose attitudes, with all that was adopted, do not determine C and o.

    Raises
    ------
    NotEnoughData: as in `fit_joint`.
    """
    raw, reference = without(record, [a.terms(state.excitation) for a in state.adopted], state.theta)
    _fit(record, state.adopted, raw, reference, replace(how, complete=True), np.asarray(state.fit.keep))


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


def everywhere(record: Record, state: State) -> Residual:
    """What a fit leaves at all samples, those that have no part in it as well."""
    raw, reference = without(record, [a.terms(state.excitation) for a in state.adopted], state.theta)
    return residual_of(replace(state.fit, keep=np.ones(len(raw), dtype=bool)), raw, reference)
