"""Whether a jump or a drift of a scale factor is a stretch of a gain that wanders.

Any walk has its largest step, and a line through it. Events are judged by the slow noise of the outputs, which a walk
of the gain is none of: it turns with the field and is as quick as that. Along what the sensor reads it is slow.
"""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.terms import Terms
from magtensor.loop.evidence.by_blocks import BLOCKS, least_t, means_of, t_of
from magtensor.loop.fitting.model import State
from magtensor.loop.searching.contribution import happens_once
from magtensor.loop.searching.course_of_time import is_a_course

MEANS = 8  # samples taken together
ALPHA = 0.001  # of one sensor
A_GAIN = 0.7  # of what an effect adds to a sensor, along what it reads: of the gain of one axis three quarters
AN_OFFSET = 0.95  # the same of what adds to the axes too, of which an offset is across the field at other attitudes
MUCH_OF_IT = 0.3  # of what an effect adds to a sensor, that its gain wanders by beside it


def of_a_wandering_gain(state: State, fixed: int) -> tuple[list[int], str] | None:
    """The place of the adopted course of time or event that lies along what its sensors read, and beside which the gain
    of the one that has most of it goes on to wander by much of that; of several the smallest, and why. None where there
    is none."""
    x, doubted = state.excitation, []
    if state.residual.across is None or len(state.residual.across) < 2 * BLOCKS * MEANS:
        return None
    for place, model in enumerate(state.adopted[fixed:], start=fixed):
        terms = model.terms(x).at(state.residual.samples)
        if not (happens_once(model) or is_a_course(model, x)) or terms.delay is not None:
            continue
        added, along = _added(state, terms, state.theta[place])
        sensor = int(np.argmax(added))
        if along[sensor] < (AN_OFFSET if terms.adds_to_axes else A_GAIN) * added[sensor] or not added[sensor]:
            continue
        wanders = _of_its_gain(state, sensor)
        if wanders > MUCH_OF_IT * added[sensor]:
            doubted.append((float(added[sensor]), place, x.sensors[sensor], wanders))
    if not doubted:
        return None
    amount, place, name, wanders = min(doubted)
    return [place], f"it makes {amount:.3g} nT rms of {name}, whose gain wanders by {wanders:.3g} nT rms beside it"


def _of_its_gain(state: State, sensor: int) -> float:
    """nT rms of what is left of a sensor slowly along what it reads; 0 where noise may have made it."""
    residual, x = state.residual, state.excitation
    assert residual.across is not None
    noise = residual.noise.reshape(-1, 3)[sensor]
    reads = x.sensed(x.field)[residual.samples, sensor] / noise
    length = np.linalg.norm(reads, axis=1)
    left = np.sum(residual.across.reshape(len(reads), -1, 3)[:, sensor] * reads, axis=1) / length
    means = left[: len(left) // MEANS * MEANS].reshape(-1, MEANS).mean(axis=1)
    each = means_of(means[:-1] * means[1:])
    if t_of(each) < least_t(ALPHA):
        return 0.0
    seen = float(np.diagonal(residual.projector).reshape(-1, 3).mean(axis=1)[sensor])
    one = np.mean(np.sum((reads * noise) ** 2, axis=1)) / np.mean(length**2)  # nT2 of a unit along what it reads
    return float(np.sqrt(each.mean() * one)) / seen


def _added(state: State, terms: Terms, theta: Array) -> tuple[Array, Array]:
    """(S,) nT rms that terms of an adopted model add to each sensor, beside what C and o take, and of that along what
    it reads."""
    x, samples = state.excitation, state.residual.samples
    made = terms.contribution(theta, 3 * len(x.sensors)).reshape(len(samples), -1, 3)
    out, along = np.zeros((2, len(x.sensors)))
    reads = x.sensed(x.field)[samples]
    reads = reads / np.linalg.norm(reads, axis=2, keepdims=True)
    for sensor in range(len(x.sensors)):
        free = np.column_stack([np.ones(len(samples)), x.output[samples, sensor]])
        left = made[:, sensor] - free @ np.linalg.lstsq(free, made[:, sensor], rcond=None)[0]
        out[sensor] = np.sqrt(np.mean(np.sum(left**2, axis=1)))
        along[sensor] = np.sqrt(np.mean(np.sum(left * reads[:, sensor], axis=1) ** 2))
    return out, along
