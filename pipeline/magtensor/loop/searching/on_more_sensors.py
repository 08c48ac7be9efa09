"""Adopted effects on the sensors that show them only now.

A sensor on which an effect was cancelled by another one, or lay along one, was left out when it was adopted. Beside
what has been found since it may show it as clearly as the others do; and what another model took up there meanwhile may
be nothing else.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magtensor.error_models.terms import joined
from magtensor.error_models.waveform import NAME
from magtensor.loop.evidence.assessment import estimated, explained
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.separation import fold_gain, separated
from magtensor.loop.fitting.trial import Trial, on_the_folds_of, trial
from magtensor.loop.searching.contribution import KEEP_ALPHA, happens_once, possible_without, put_back_one, slices
from magtensor.loop.searching.on_fewer_sensors import narrowed, sensors_showing


def on_more_sensors(record: Record, standing: Trial, how: Fitting, places: Sequence[int]) -> Trial:
    """The fit with each of some adopted models on the sensors, too, that it was left out of and that show it beside the
    others, where held-out blocks of none are worse for it."""
    for place in places:
        state = standing.state
        more = _that_may_show(state, place)
        if not more:
            continue
        wide = _on(record, state, place, (*state.adopted[place].sensors, *more), how)
        showing = sensors_showing(wide, place)
        kept = tuple(s for s in more if showing is None or s in showing)
        if not kept:
            continue
        if len(kept) < len(more):
            wide = narrowed(record, wide, place, (*state.adopted[place].sensors, *kept), how)
        tried = trial(record, wide, how)
        before = on_the_folds_of(tried, record, standing, how)
        if not before.hurt_by(tried) and before.likelier(tried):
            standing = tried
    return standing


def in_the_place_of_others(
    record: Record, standing: Trial, how: Fitting, places: Sequence[int]
) -> tuple[Trial, tuple[str, ...]]:
    """The fit with some of the adopted models on the sensors, too, of another one of them that acts on none of their
    own, and without that one, where held-out blocks do not tell the two apart and its coefficients are more, or as many
    and it happens once; and the names of those that are gone."""
    gone: list[str] = []
    left = list(places)
    while (pair := _as_well(standing.state, left)) is not None:
        place, other = pair
        state = standing.state
        wide = _on(record, state, place, (*state.adopted[place].sensors, *state.adopted[other].sensors), how)
        left.remove(place)  # each once
        if (without := possible_without(record, wide, [other], how)) is None:
            continue
        tried = trial(record, without, how)
        if on_the_folds_of(tried, record, standing, how).hurt_by(tried):
            continue
        gone.append(state.adopted[other].name)
        left = [i - (i > other) for i in left if i != other]
        standing = tried
    return standing, tuple(gone)


def _as_well(state: State, places: Sequence[int]) -> tuple[int, int] | None:
    """The places of an adopted model and of one on other sensors in whose place it would do there."""
    x, models = state.excitation, state.adopted
    for place, other in itertools.permutations(places, 2):
        mine, theirs = models[place].sensors, models[other].sensors
        kinds = {models[i].component.effect for i in (place, other)}
        if not mine or not theirs or set(mine) & set(theirs) or kinds != {"instrument"} or models[place].name == NAME:
            continue
        own = slices(state)[other]
        wider = replace(models[place], sensors=theirs).terms(x).at(state.residual.samples)
        most = own.stop - own.start
        # a law that is in already is simpler than something that happens once
        if not 0 < wider.count < most + (happens_once(models[other]) and not happens_once(models[place])):
            continue
        assert state.terms is not None
        without = put_back_one(state, other)
        best = fold_gain(without, state.colours, state.terms.only(range(own.start, own.stop)))
        if not separated(best, fold_gain(without, state.colours, wider)):
            return place, other
    return None


def _that_may_show(state: State, place: int) -> list[str]:
    """The sensors that an adopted model was left out of, and no other one of its kind acts on, whose residual it
    explains more of than noise of the residual's colour would let it."""
    from scipy.special import chdtrc

    model, x = state.adopted[place], state.excitation
    acts = {s for a in state.adopted if a.name == model.name for s in a.sensors or x.sensors}
    left_out = [s for s in x.sensors if s not in acts] if model.sensors and model.name != NAME else []
    if not left_out:
        return []
    assert state.terms is not None
    now, found = explained(estimated(state.residual, state.terms, state.colours)), []
    for sensor in left_out:
        own = replace(model, sensors=(sensor,)).terms(x).at(state.residual.samples)
        together = joined([state.terms, own])
        gained = explained(estimated(state.residual, together, state.colours)) - now
        if own.count and float(chdtrc(own.count, max(gained, 0.0))) < KEEP_ALPHA / len(left_out):
            found.append(sensor)
    return found


def _on(record: Record, state: State, place: int, sensors: tuple[str, ...], how: Fitting) -> State:
    """Refit with one of the models on these sensors, begun with the coefficients that it has."""
    old, x = state.adopted[place], state.excitation
    sensors = tuple(s for s in x.sensors if s in sensors)
    new = replace(old, sensors=() if len(sensors) == len(x.sensors) else sensors)
    owners = new.terms(x).sensors
    theta = list(state.theta)
    theta[place] = np.zeros(len(owners))
    theta[place][[i for i, s in enumerate(owners) if s in old.sensors or s == ""]] = state.theta[place]
    models: list[Adopted] = [*state.adopted[:place], new, *state.adopted[place + 1 :]]
    return joint_state(record, models, how, theta, state.lines)
