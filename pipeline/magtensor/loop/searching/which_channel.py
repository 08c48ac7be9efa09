"""Which of several channels an effect follows, where the survey hardly tells: two thermometers on one payload, say.

A channel that each sensor has of its own is nearer to it than one logged elsewhere, and the others are named.
"""

from __future__ import annotations

from dataclasses import replace

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


def nearest(chosen: Candidate, state: State, models: int) -> tuple[Candidate, tuple[str, ...]]:
    """A candidate, following the sensors' own channel in the place of one logged elsewhere where held-out blocks do not
    tell the two apart; and the names of the other channels that they do not tell from it. One that slow noise could
    explain is named, and not taken. What goes beside another of its kind follows the channel of that one.

    Parameters
    ----------
    models: that it was found among, for the correction of p.
    """
    component, settings = chosen.model.component, chosen.model.settings
    name = next((n for n, g in profiled(component).items() if isinstance(g, AnyChannel)), None)
    if name is None or generic(chosen.model) or chosen.moved is not None:
        return chosen, ()
    reference = _gain(chosen, chosen, state)
    alike = {str(settings[name]): chosen}
    orders = {n: settings[n] for n, g in profiled(component).items() if isinstance(g, Orders)}
    for channel in profiled(component)[name].values(state.excitation):
        held = {**orders, name: channel}
        if channel in alike or already(state.adopted, component, {**settings, **held}):
            continue
        for found in candidates_of(state, [pinned(component, held)], {}, chosen.alpha):
            model = replace(found.model, component=component, settings={**settings, **found.model.settings, **held})
            other = replace(found.among(models), model=model)
            gain = _gain(other, chosen, state)
            behind = reference.over(gain).total
            if other.predicts and (not separated(reference, gain) or worse_log(chosen, other, behind, state)):
                alike[channel] = other
    own = [c for c, found in alike.items() if found.passes and _of_each_sensor(state.excitation, c)]
    which = str(settings[name]) if not own or settings[name] in own else max(own, key=lambda c: _total(alike[c]))
    return alike[which], tuple(sorted(set(alike) - {which}))


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
