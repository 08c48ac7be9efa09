"""Refit with a model that is adopted, and with its settings sought once more."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magtensor.error_models.settings import AsAWhole, Beginning, EventTimes, Forms, Frequencies, Range, profiled
from magtensor.error_models.terms import Terms
from magtensor.golden import golden
from magtensor.loop.evidence.scoring import Scorer
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.separation import SEPARATION
from magtensor.loop.searching.beginnings import beginning, extent, least_gain, with_beginning
from magtensor.loop.searching.contribution import moments, put_back, slices
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.on_fewer_sensors import on_those_needed
from magtensor.loop.searching.profiling import of_ratios
from magtensor.loop.searching.split import coefficients

POLISH = 0.1  # of a setting, or of the width of a line, to either side
_SWEEPS = 6  # over all settings, where two models of one kind are in
_RESTS = 0.02  # relative: a setting that moves no further is settled


def adopt(record: Record, state: State, chosen: Candidate, how: Fitting) -> State:
    """Refit with the chosen model, first on all sensors, then on those that show it."""
    return on_those_needed(record, on_all_sensors(record, state, chosen, how), len(state.adopted), how)


def on_all_sensors(record: Record, state: State, chosen: Candidate, how: Fitting) -> State:
    """Refit with the chosen model on all its sensors, whether they show it or not."""
    models = [*state.adopted, chosen.model]
    # what it found of the others too: begun from zero, a strong slow effect would pass for the colour of the noise
    if chosen.moved is not None:
        place, models[place] = chosen.moved
        start = coefficients(state, chosen)
    else:
        moves = np.split(chosen.assessment.theta, np.cumsum([len(t) for t in state.theta]))
        start = [t + move for t, move in zip([*state.theta, np.zeros(chosen.terms.count)], moves, strict=True)]
    return joint_state(record, models, how, start)


def polished(record: Record, state: State, how: Fitting) -> State:
    """The forms of the models, what they began with and their settings on a range, sought once more now that everything
    is fitted together; a setting that is a little off leaves a residual that another model would be adopted for. Beside
    one that has moved another form may be right, and a lag show that did not, or no longer be needed."""
    state = _at_one_moment(record, state, how)
    state = _at_rest(record, _as_they_began(record, _in_their_forms(record, state, how), how), how)
    formed = _in_their_forms(record, _with_lags_that_show(record, state, how), how)
    return state if formed is state else _at_rest(record, formed, how)


def _at_one_moment(record: Record, state: State, how: Fitting) -> State:
    """The models with the events at the time of another one where that is likelier: of what happened at one moment the
    part that was found first was fitted best some samples off while the other had no name."""
    for number, model in enumerate(state.adopted):
        others = sorted({at for i, m in enumerate(state.adopted) if i != number for at in moments(m)})
        for name, grid in profiled(model.component).items() if others else ():
            if not isinstance(grid, EventTimes):
                continue
            here = state.adopted[number].settings
            gain = _Beside.of(state, number)
            best = max((float(here[name]), *others), key=lambda at: gain({**here, name: at}))
            if best != here[name]:
                state = _changed(record, state, number, {name: best}, how)
    return state


def _at_rest(record: Record, state: State, how: Fitting) -> State:
    """The models with the settings on a range that suit each other."""
    for _ in range(_SWEEPS):
        moved = False
        for number, model in enumerate(state.adopted):
            for name, grid in profiled(model.component).items():
                if not isinstance(grid, (Range, Frequencies)) or not state.adopted[number].settings.get(name):
                    continue
                here = float(state.adopted[number].settings[name])
                whole = abs(here) if isinstance(grid, Range) else 1.0 / state.excitation.duration
                gain = _Beside.of(state, number)
                best = _near(gain, state.adopted[number].settings, name, here - POLISH * whole)
                if best == here:
                    continue
                moved |= abs(best - here) > _RESTS * abs(here)
                state = _changed(record, state, number, {name: best}, how)
        # one setting of a kind rests at once; of two, one moves as the other does
        if not moved or len({a.name for a in state.adopted}) == len(state.adopted):
            break
    return state


def _with_lags_that_show(record: Record, state: State, how: Fitting) -> State:
    """The models without the lags that the data do not separate from none beside the others, and with those that they
    do; of two of one kind, what one lacks the other makes up for."""
    names = [model.name for model in state.adopted]
    for number, model in enumerate(state.adopted):
        if names.count(model.name) > 1:
            continue
        gain = _Beside.of(state, number)
        best = dict(model.settings)
        for name, grid in profiled(model.component).items():
            if not of_ratios(grid) or grid.low > 0 or name not in best:
                continue
            none = {**best, name: 0.0, **_of_the_lag(model, name)}
            if not best[name]:
                best[name] = _best_of(gain, best, name, [0.0, *(v for v in grid.values(state.excitation) if v > 0)])
            if gain(none) > gain(best) - SEPARATION / 2.0:
                best = none
        if best != model.settings:
            state = _changed(record, state, number, best, how)
    return state


def _of_the_lag(model: Adopted, lag: str) -> dict[str, Any]:
    """The other settings that say something of a lag, as they are without one."""
    grids = profiled(model.component)
    forms = {n: g.options[0] for n, g in grids.items() if isinstance(g, AsAWhole) and g.lag == lag}
    return forms | {n: 0.0 for n, g in grids.items() if isinstance(g, Beginning) and g.lag == lag}


def _in_their_forms(record: Record, state: State, how: Fitting) -> State:
    """Every model in the forms that the data separate from others, with the settings on a range that suit these."""
    for number, model in enumerate(state.adopted):
        grids = profiled(model.component)
        # of a declared model those that the recipe leaves open stay as they are
        forms = {name: grid for name, grid in grids.items() if isinstance(grid, Forms) and name in model.settings}
        if not forms:
            continue
        ranges = {name: grid for name, grid in grids.items() if isinstance(grid, Range) and name in model.settings}
        gain = _Beside.of(state, number)
        best = dict(model.settings)
        for name, grid in forms.items():
            for form in [form for form in grid.options if form != best[name]]:
                changed = _suited(gain, {**best, name: form}, ranges)
                if gain(changed) > gain(best) + SEPARATION / 2.0:
                    best = changed
        if best != model.settings:
            state = _changed(record, state, number, best, how)
    return state


def _as_they_began(record: Record, state: State, how: Fitting) -> State:
    """Every lagged model with what it had from before the survey began, where the data separate it from nothing."""
    for number, model in enumerate(state.adopted):
        found = beginning(model.component, model.settings)
        if found is None or not found[1].matters(model.settings):
            continue
        names, mark = found
        gain = _Beside.of(state, number)
        widest = extent(model.component, model.settings, state.excitation)
        best = _with_beginning(gain, model.settings, names, mark.lag, widest)
        at_rest = {**model.settings, **dict.fromkeys(names, 0.0)}
        if gain(best) <= gain(at_rest) + least_gain(names):
            best = at_rest
        if best != model.settings:
            state = _changed(record, state, number, best, how)
    return state


def _with_beginning(
    gain: _Beside, settings: Mapping[str, Any], names: Sequence[str], lag: str, widest: float
) -> dict[str, Any]:
    """Settings with the best beginning within limits, and the lag that goes with it."""
    best = dict(settings)
    for _ in range(_SWEEPS):
        found = with_beginning(gain.score.white, gain.terms, best, names, widest, _SWEEPS)
        if found is None:
            return best
        before, best = best[lag], found
        best[lag] = _near(gain, best, lag, (1.0 - POLISH) * before)
        if abs(best[lag] - before) <= _RESTS * before:
            break
    return best


def _suited(
    gain: Callable[[Mapping[str, Any]], float], settings: dict[str, Any], ranges: Mapping[str, Range]
) -> dict[str, Any]:
    """Settings whose lags suit the others: up to twice as long as they are, none if the data do not separate it."""
    for name, grid in ranges.items():
        if settings[name]:
            settings = {**settings, name: _near(gain, settings, name, max(grid.low, 0.0))}
            none = {**settings, name: 0.0}
            if grid.low <= 0 and gain(settings) < gain(none) + SEPARATION / 2.0:
                settings = none
    return settings


def _changed(record: Record, state: State, number: int, settings: Mapping[str, Any], how: Fitting) -> State:
    """Refit with other settings of one of the models."""
    models = list(state.adopted)
    models[number] = replace(models[number], settings={**models[number].settings, **settings})
    return joint_state(record, models, how, state.theta)


def _best_of(
    gain: Callable[[Mapping[str, Any]], float], settings: Mapping[str, Any], name: str, values: Sequence[float]
) -> float:
    """The best of some values of a setting, in order, and of what lies between it and its neighbours."""

    def at(value: float) -> float:
        return gain({**settings, name: value})

    best = max(range(len(values)), key=lambda i: at(values[i]))
    return golden(at, values[max(best - 1, 0)], values[min(best + 1, len(values) - 1)], values[best])


def _near(gain: Callable[[Mapping[str, Any]], float], settings: Mapping[str, Any], name: str, low: float) -> float:
    """The best value of a setting as far from where it is as `low` is."""
    here = float(settings[name])
    first, last = sorted((low, 2.0 * here - low))
    return golden(lambda value: gain({**settings, name: value}), first, last, here)


@dataclass(frozen=True)
class _Beside:
    """What one of the adopted models explains beside the others, for given settings.

    Attributes:
        own: the model; score: beside the others, in noise of the colour that all of them leave.
    """

    own: Adopted
    state: State
    score: Scorer

    @classmethod
    def of(cls, state: State, number: int) -> _Beside:
        own = slices(state)[number]
        assert state.terms is not None
        mine = state.terms.only(range(own.start, own.stop))
        others = [i for i in range(state.terms.count) if not own.start <= i < own.stop]
        back = put_back(state.residual, mine, state.theta[number])
        score = Scorer(back, state.terms.only(others) if others else None, state.colours)
        return cls(state.adopted[number], state, score)

    def terms(self, settings: Mapping[str, Any]) -> Terms:
        """Its regressors at the residual's samples."""
        return replace(self.own, settings=settings).terms(self.state.excitation).at(self.state.residual.samples)

    def __call__(self, settings: Mapping[str, Any]) -> float:
        return self.score(self.terms(settings))
