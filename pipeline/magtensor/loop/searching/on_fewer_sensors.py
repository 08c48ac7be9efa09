"""Adopted effects on the sensors that need them, and on no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magtensor.error_models.waveform import NAME
from magtensor.loop.evidence.assessment import estimated, explained
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State, turning
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.separation import SECOND_ORDER, SEPARATION, fold_gain
from magtensor.loop.searching.contribution import (
    KEEP_ALPHA,
    families,
    happens_once,
    held_out,
    put_back,
    significance_at_once,
    slices,
)
from magtensor.loop.searching.overheard import shown_by_one

MOST = 0.5  # of a model's sensors


def on_those_needed(record: Record, state: State, which: int, how: Fitting) -> State:
    """Refit with one of the models on those of its sensors that need it."""
    sensors = _needed(state, which)
    state = _on_a_few(record, state, which, how) if sensors is None else narrowed(record, state, which, sensors, how)
    loudest = shown_by_one(record, state, which, how)
    return narrowed(record, state, which, (loudest,), how) if loudest else state


def _on_a_few(record: Record, state: State, which: int, how: Fitting) -> State:
    """Refit with one of the models on the few sensors that may have made all of it, if the others then predict nothing.

    What all sensors do alike is not seen where only they are compared: a turn of one, shared out, turns all. Of large
    ones the square is seen, so that what the others share, and cannot have, is significant on each of them and only a
    refit tells.
    """
    sensors = _a_few(state, which)
    if sensors is None:
        return state
    few = narrowed(record, state, which, sensors, how)
    assert state.terms is not None
    others = tuple(sorted(set(state.terms.sensors[slices(state)[which]]) - {*sensors, ""}))
    model = replace(state.adopted[which], sensors=others)
    gain = fold_gain(few, few.colours, model.terms(few.excitation).at(few.residual.samples))
    return state if gain.total >= SEPARATION and gain.consistent else few


def _a_few(state: State, which: int) -> tuple[str, ...] | None:
    """At most half of a model's sensors, one added after the other, without whose rest no more is lost than the square
    of a turn; None where there are none, where another choice of as many does, or where all that it does is seen."""
    assert state.terms is not None
    owners = sorted(set(state.terms.sensors[slices(state)[which]]) - {""})
    gone, seen, whole = _without_others(state, which, ())
    if seen == gone:
        return None
    found: tuple[str, ...] = ()
    while 2 * (len(found) + 1) <= len(owners):
        lost = {s: _without_others(state, which, (*found, s))[2] for s in owners if s not in found}
        enough = [s for s in lost if lost[s] < SECOND_ORDER * whole]
        found = (*found, min(lost, key=lambda s: lost[s]))
        if enough:
            return tuple(sorted(found)) if len(enough) == 1 else None
    return None


def narrowed(record: Record, state: State, which: int, sensors: tuple[str, ...], how: Fitting) -> State:
    """Refit with one of the models on some of its sensors only."""
    model = state.adopted[which]
    models = list(state.adopted)
    models[which] = Adopted(model.component, model.settings, sensors)
    assert state.terms is not None
    part = slices(state)[which]
    own = [i for i, s in enumerate(state.terms.sensors[part]) if s in sensors or s == ""]
    theta = list(state.theta)
    theta[which] = theta[which][own]
    return joint_state(record, models, how, theta)


def on_those_that_show(record: Record, state: State, how: Fitting, fixed: int) -> State:
    """Refit with every model that was found on those of its sensors that show it beside all others.

    When it was adopted, what had no name yet on one sensor was in the field that all of them see, and so seemed to be a
    little of it on each.
    """
    for which in range(fixed, len(state.adopted)):
        if state.adopted[which].name == NAME or len(state.adopted) == fixed + 1:
            continue
        state = on_those_needed(record, state, which, how)
    return state


def _needed(state: State, which: int) -> tuple[str, ...] | None:
    """The sensors on which alone a model does as well; None where it needs all that it has.

    What most of them show is an effect of all, of which the others have little: what they have of it would be in the
    field that all see, were it taken for none. They keep coefficients, and are not named (`named`).
    """
    sensors = _shown_alone(state, which)
    if sensors is None:
        return _sufficient(state, which)
    return None if len(sensors) > MOST * len(_owners(state, which)) else sensors


def named(state: State, which: int) -> tuple[str, ...]:
    """The sensors on which a model is said to act: those that show it, where it can do without the others."""
    found = None if state.adopted[which].name == NAME else _shown_alone(state, which)
    return found or _owners(state, which)


def _shown_alone(state: State, which: int) -> tuple[str, ...] | None:
    """Sensors whose own coefficients are significant, and as many of the next as it takes that all others can go
    together: of a law that hardly begins no block tells much. None where all are needed."""
    sensors = sensors_showing(state, which)
    if sensors is None:
        return None
    p_values = _significance(state, which)
    for following in sorted(set(p_values) - set(sensors), key=lambda s: p_values[s]):
        if _spare(state, which, sensors):
            return sensors
        sensors = tuple(s for s in p_values if s in (*sensors, following))
    return None


def _owners(state: State, which: int) -> tuple[str, ...]:
    """The sensors that have coefficients of a model, in their order."""
    assert state.terms is not None
    owners = set(state.terms.sensors[slices(state)[which]])
    return tuple(s for s in state.excitation.sensors if s in owners)


def _spare(state: State, which: int, sensors: tuple[str, ...], least: float = SEPARATION) -> bool:
    """Whether a model can do without its coefficients for all but some sensors.

    A coefficient may be insignificant because others can stand in for it, as where only differences between sensors
    are seen (a delay of all of them is a turn of the field): each could go, and not several of them. All that go have
    to predict no more on held-out blocks than what tells two models apart, or the least that is asked for.
    """
    gone, seen, _ = _without_others(state, which, sensors)
    if seen < gone:
        return False
    gain = held_out(state, _kept(state, which, sensors))
    return not (gain.total >= least and gain.consistent)


def _sufficient(state: State, which: int) -> tuple[str, ...] | None:
    """The one sensor whose coefficients explain all that a model does, where others can stand in for them.

    If only differences between sensors are seen, or little else, one that turned is like all others turned the other
    way: every coefficient is significant, or none is. None where no sensor suffices, or several do. What is not seen of
    several sensors is shared out among them, and wrong on each: where there is such a part, one alone may lose as much
    as does not tell two models apart. And what follows the turning may lose as much as its law may miss: by so much
    all of them are moved together, which only the second order would tell.
    """
    from scipy.special import chdtri

    assert state.terms is not None
    owners = state.terms.sensors[slices(state)[which]]
    missed = 0.0
    if turning(state.adopted[which].component):
        missed = SECOND_ORDER * _without_others(state, which, ())[2]
    found = []
    for sensor in sorted(set(owners) - {""}):
        gone, seen, lost = _without_others(state, which, (sensor,))
        if not seen:
            continue
        least = max(float(chdtri(seen, KEEP_ALPHA)), missed)
        if lost >= (max(least, SEPARATION + seen) if seen < gone else least):
            continue
        if seen < gone or _spare(state, which, (sensor,), max(SEPARATION, missed)):
            found.append(sensor)
    return tuple(found) if len(found) == 1 else None


def _without_others(state: State, which: int, sensors: tuple[str, ...]) -> tuple[int, int, float]:
    """Of a model's coefficients for all but some sensors: how many, how many directions of them the survey shows, and
    what is explained no longer without them."""
    assert state.terms is not None
    kept = _kept(state, which, sensors)
    back = put_back(state.residual, state.terms, np.concatenate(state.theta))
    every = estimated(back, state.terms, state.colours)
    fewer = estimated(back, state.terms.only(kept), state.colours)
    return state.terms.count - len(kept), every.rank - fewer.rank, explained(every) - explained(fewer)


def _kept(state: State, which: int, sensors: tuple[str, ...]) -> list[int]:
    """The numbers of all coefficients but those of a model for other sensors."""
    assert state.terms is not None
    part = slices(state)[which]
    return [i for i, s in enumerate(state.terms.sensors) if not part.start <= i < part.stop or s in sensors or s == ""]


def sensors_showing(state: State, which: int) -> tuple[str, ...] | None:
    """Sensors whose own coefficients are significant; None where all are, or the model is not of single sensors."""
    p_values = _significance(state, which)
    showing = tuple(s for s, p in p_values.items() if p < KEEP_ALPHA / len(p_values))
    return showing if showing and len(showing) < len(p_values) else None


def _significance(state: State, which: int) -> dict[str, float]:
    """The p value of a model's coefficients for each of its sensors, in their order; {} of a model of one."""
    part = slices(state)[which]
    assert state.terms is not None
    owners = state.terms.sensors[part]
    own = {s: [part.start + i for i, o in enumerate(owners) if o == s] for s in state.excitation.sensors if s in owners}
    if len(own) < 2:
        return {}
    if happens_once(state.adopted[which]):
        return {s: significance_at_once(state, theirs) for s, theirs in own.items()}
    tests = families(state)
    return {s: tests.p_value(theirs) for s, theirs in own.items()}
