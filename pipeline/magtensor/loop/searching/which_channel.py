"""Which of several channels an effect follows, where the survey hardly tells: two thermometers on one payload, say.

A channel that each sensor has of its own is nearer to it than one logged elsewhere, and the others are named. So is a
channel that goes as the one that is followed does, whatever its name, where its own noise is all that it is behind by.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel, Orders, profiled
from magtensor.loop.evidence.gains import Gain
from magtensor.loop.fitting.model import State, generic
from magtensor.loop.fitting.separation import fold_gain, separated
from magtensor.loop.searching.by_hand import pinned
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.profiling import already
from magtensor.loop.searching.screening import candidates_of
from magtensor.loop.searching.several_logs import worse_log

TOGETHER = 0.7  # correlation: half of the variance


def nearest(
    chosen: Candidate, state: State, models: int, anything: Component | None = None
) -> tuple[Candidate, tuple[str, ...]]:
    """A candidate, following the sensors' own channel in the place of one logged elsewhere where held-out blocks do not
    tell the two apart; and the names of the other channels that they do not tell from it, or that are behind by no more
    than the noise of their own logs. One that slow noise could explain is named, and not taken. What goes beside
    another of its kind follows the channel of that one.

    Parameters
    ----------
    models: that it was found among, for the correction of p.
    anything: the model of a response to any channel: channels with another name are asked with that, if they go as the
        candidate's does.
    """
    component, settings, x = chosen.model.component, chosen.model.settings, state.excitation
    name = next((n for n, g in profiled(component).items() if isinstance(g, AnyChannel)), None)
    if name is None or chosen.moved is not None:
        return chosen, ()
    followed = str(settings[name])
    reference = _gain(chosen, chosen, state)
    alike = {followed: chosen}
    orders = {n: settings[n] for n, g in profiled(component).items() if isinstance(g, Orders)}
    tried = [] if generic(chosen.model) else [(component, c, {**orders, name: c}) for c in _channels(component, x)]
    with_names = {followed, *(c for _, c, _ in tried)}
    if anything is not None:
        power = settings.get("power", 1)
        for c in _channels(anything, x):
            if c not in with_names and _go_together(x, followed, c):
                tried.append((anything, c, {"channel": c, "power": power}))
    for model, channel, held in tried:
        if channel in alike or already(state.adopted, model, {**settings, **held}):
            continue
        for found in candidates_of(state, [pinned(model, held)], {}, chosen.alpha):
            following = replace(found.model, component=model, settings={**found.model.settings, **held})
            other = replace(found.among(models), model=following)
            gain = _gain(other, chosen, state)
            behind = reference.over(gain).total
            if other.predicts and (not separated(reference, gain) or worse_log(chosen, other, behind, state)):
                alike[channel] = other
    same = {c: found for c, found in alike.items() if found.model.name == chosen.model.name}
    own = [c for c, found in same.items() if found.passes and _of_each_sensor(x, c) and not generic(chosen.model)]
    which = followed if not own or followed in own else max(own, key=lambda c: _total(alike[c]))
    return alike[which], tuple(sorted(set(alike) - {which}))


def _channels(component: Component, x: Excitation) -> list[str]:
    """The channels that a model may follow."""
    return next(list(g.values(x)) for g in profiled(component).values() if isinstance(g, AnyChannel))


def _go_together(x: Excitation, one: str, other: str) -> bool:
    """Whether two channels with one number each go the same way, or the opposite one."""
    a, b = x.logged[one], x.logged[other]
    if a.ndim > 1 or b.ndim > 1 or not (np.ptp(a) > 0 and np.ptp(b) > 0):
        return False
    return bool(abs(np.corrcoef(a, b)[0, 1]) > TOGETHER)


def _gain(candidate: Candidate, chosen: Candidate, state: State) -> Gain:
    """In noise of the colour that the chosen one leaves, beside the fit without either: one of them may have been
    judged at its own."""
    terms = candidate.model.terms(state.excitation).at(state.residual.samples)
    return fold_gain(state, chosen.assessment.colours, terms)


def _total(candidate: Candidate) -> float:
    return candidate.assessment.gain.total


def _of_each_sensor(x: Excitation, channel: str) -> bool:
    """Whether a channel has a value for each sensor."""
    values = x.logged[channel]
    return values.ndim == 2 and not x.is_vector(channel)
