"""Takes the adopted effects off raw outputs, on any survey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.by_sensor import by_sensor
from magtensor.calibration.types import Array, ArrayCalibration
from magtensor.error_models.delays import cleared, lateness, on_time, unseen
from magtensor.error_models.terms import Terms
from magtensor.error_models.waveform import NAME, bends, course_of, too_little_shows
from magtensor.errors import DataError
from magtensor.loop.correcting.another_survey import as_begun_here
from magtensor.loop.correcting.filled import filled
from magtensor.loop.fitting.model import Adopted, Record, State
from magtensor.loop.fitting.refit import without
from magtensor.loop.fitting.seen import over_disturbances, spread
from magtensor.tensor.geometry import array_design

MOST_STEPS = 8
SETTLED_NT = 1e-4
LARGE_NT = 1.0  # what steps that grow may still move the median output by


def corrected_raw(
    record: Record,
    calibration: ArrayCalibration,
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    good: NDArray[np.bool_] | None = None,
) -> Array:
    """Raw outputs (N, S, 3) nT without the instrument's effects.

    Outputs that come late are brought back to their time; what was not recorded before an end is missing then. The
    other effects depend on the field that is being sought: b is found from the outputs as they are, the effects from b,
    and so on until neither moves. Effects of the site belong to the calibration's place and are left alone here.

    Raises
    ------
    DataError: the steps grow.

    Parameters
    ----------
    record: all samples of the survey, channels with the calibration's origins taken off.
    calibration: C and o.
    adopted: the effects; theta: their coefficients.
    good: (N,) samples from which others may be interpolated and the waveform of a source that nobody logged be found;
        over those that are not error models look from the ones beside them.
    """
    hidden = _hidden(adopted)
    if hidden is not None:
        others = [i for i in range(len(adopted)) if i != hidden]
        left = corrected_raw(record, calibration, [adopted[i] for i in others], [theta[i] for i in others], good)
        noise = _weights(adopted[hidden], record.raw[0].size)
        waveform = hidden_waveform(left, calibration, record.position, theta[hidden], noise, good)
        record = replace(record, waveform=waveform)
    own = [(a, t) for a, t in zip(adopted, theta, strict=True) if a.component.effect == "instrument"]
    if not own:
        return record.raw
    record, own = on_its_time(record, calibration, own, good)
    raw = record.raw
    own = as_begun_here(record, calibration, own, good)
    models, theta = [model for model, _ in own], [t for _, t in own]
    last = np.inf
    for _ in range(MOST_STEPS if own else 0):
        each = _terms(record, calibration, raw, models, good)
        after = cleared(record.raw, record.time, record.run, each, theta)
        moves = np.abs(after - raw)
        raw = after
        if float(np.nanmax(moves, initial=0.0)) < SETTLED_NT:
            break
        usual = float(np.nanmedian(moves))  # a spike may be where a law has no inverse
        if usual > max(last, LARGE_NT):
            raise DataError(
                f"the effects ({', '.join(m.name for m in models)}) cannot be taken off: a step moves the outputs by "
                f"{usual:.3g} nT, the one before by {last:.3g}",
                hint="coefficients so large are no small errors: calibrate without these effects",
            )
        last = usual
    return raw


def on_its_time(
    record: Record, calibration: ArrayCalibration, own: Sequence[tuple[Adopted, Array]], good: NDArray[np.bool_] | None
) -> tuple[Record, list[tuple[Adopted, Array]]]:
    """A record whose outputs are at their time, and the effects of the instrument that are not delays of these."""
    each = _terms(record, calibration, record.raw, [model for model, _ in own], good)
    record = replace(record, raw=_on_time(record, each, [t for _, t in own], good))
    return record, [pair for terms, pair in zip(each, own, strict=True) if terms.delay is None]


def _terms(
    record: Record, calibration: ArrayCalibration, raw: Array, models: Sequence[Adopted], good: NDArray[np.bool_] | None
) -> list[Terms]:
    """What error models make of the field that outputs (N, S, 3) nT tell."""
    forward = np.asarray(np.linalg.inv(calibration.matrix), dtype=float)
    b = filled(record.believed(calibration.apply(raw)), good)
    if good is not None:
        b = over_disturbances(b, good, record.time, record.run, spread(b))
    x = record.excitation(by_sensor(forward, b) + calibration.offset, b, matrix=forward)
    return [model.terms(x) for model in models]


def _on_time(record: Record, each: Sequence[Terms], theta: Sequence[Array], good: NDArray[np.bool_] | None) -> Array:
    """Raw outputs (N, S, 3) nT at their time; NaN where that was recorded after the end."""
    late = lateness(each, theta, record.raw[0].size)
    if late is None:
        return record.raw
    trusted = good
    if good is not None and record.readings is not None:  # one that is silent makes no other one late
        own = record.readings & ~record.readings.all(axis=1, keepdims=True)
        trusted = np.repeat(good[:, None] | own, 3, axis=1)
    flat = on_time(record.raw.reshape(len(record.raw), -1), record.time, record.run, late, trusted)
    return np.where(unseen(record.time, record.run, late), np.nan, flat).reshape(record.raw.shape)


def hidden_waveform(
    raw: Array,
    calibration: ArrayCalibration,
    position: Array | None,
    theta: Array,
    noise: Array,
    good: NDArray[np.bool_] | None = None,
) -> Array:
    """(N,) waveform of a source that nobody logged, from where neither a uniform field nor a gradient could make it.

    So no field that a survey may hold is taken for the source. Two sensors have no such outputs, three have one in
    each sample, and where the positions are not known nobody can say; what cannot be told is not taken off.

    Parameters
    ----------
    raw: (N, S, 3) nT, other effects taken off.
    theta: (3 S,) nT, what a unit of the waveform adds to the outputs; noise: (3 S,) nT of these.
    """
    usable = _usable(raw, good)
    if position is None or not usable.any():
        return np.zeros(len(raw))
    return course_of(*_beside_a_field(raw, calibration, position, noise), theta / noise, usable).values


def _usable(raw: Array, good: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    whole: NDArray[np.bool_] = np.asarray(np.isfinite(raw).all(axis=(1, 2)))
    return whole if good is None else whole & good


def _beside_a_field(raw: Array, calibration: ArrayCalibration, position: Array, noise: Array) -> tuple[Array, Array]:
    """Whitened outputs (N, 3 S), and the directions (3 S, k) in which a uniform field and a gradient move them."""
    forward = np.linalg.inv(calibration.matrix)
    field = array_design(position, "gradient").reshape(len(forward), 3, -1)
    held = np.einsum("sij,sjk->sik", forward, field).reshape(len(noise), -1) / noise[:, None]
    return (np.nan_to_num(raw) - calibration.offset).reshape(len(raw), -1) / noise, held


def hidden_objection(
    record: Record,
    calibration: ArrayCalibration,
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    good: NDArray[np.bool_] | None = None,
) -> str:
    """Why the source that nobody logged cannot be taken off a survey; "" where it can, or where none is known."""
    hidden = _hidden(adopted)
    if hidden is None or record.position is None:
        return ""
    others = [i for i in range(len(adopted)) if i != hidden]
    raw = corrected_raw(record, calibration, [adopted[i] for i in others], [theta[i] for i in others], good)
    noise, usable = _weights(adopted[hidden], raw[0].size), _usable(raw, good)
    whitened, held = _beside_a_field(raw, calibration, record.position, noise)
    direction = theta[hidden] / noise
    if bends(whitened[usable], held, direction):
        return "the field bends within the array, by more than it may be told from"
    if too_little_shows(held, direction) and not course_of(whitened, held, direction, usable).switches:
        return "as the sensors lie, nearly all of it could be a uniform field or a gradient"
    return ""


def as_elsewhere(record: Record, calibration: ArrayCalibration, state: State) -> Record:
    """The record with the waveform that a correction would find on another survey, which knows less of it."""
    which = _hidden(state.adopted)
    if which is None:
        return record
    others = [i for i in range(len(state.adopted)) if i != which]
    each = [state.adopted[i].terms(state.excitation) for i in others]
    raw, _ = without(record, each, [state.theta[i] for i in others])
    good = np.asarray(state.fit.keep)
    noise = _weights(state.adopted[which], raw[0].size)
    waveform = hidden_waveform(raw, calibration, record.position, state.theta[which], noise, good)
    return replace(record, waveform=waveform)


def _hidden(adopted: Sequence[Adopted]) -> int | None:
    """Which of the models is a source that nobody logged."""
    return next((i for i, a in enumerate(adopted) if a.name == NAME), None)


def _weights(source: Adopted, outputs: int) -> Array:
    """(outputs,) nT noise by which the outputs are weighed when its waveform is sought; all alike where not known."""
    known = np.asarray(source.settings.get("noise_nT", ()), dtype=float)
    return known if len(known) == outputs else np.ones(outputs)


def corrected_reference(record: Record, adopted: Sequence[Adopted], theta: Sequence[Array]) -> Array | None:
    """The total field (N,) nT without the base station's adopted errors; None where there is none."""
    field = record.total_field
    if field is None:
        return None
    placeholder = np.zeros_like(record.raw)
    for model, coefficients in zip(adopted, theta, strict=True):
        if model.component.effect == "reference":
            terms = model.terms(record.excitation(placeholder, placeholder))
            field = field - terms.on_reference(coefficients)
    return field
