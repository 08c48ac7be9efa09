"""Refit with a model that is adopted: on which of its sensors, and with its settings sought once more."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magtensor.error_models.settings import AsAWhole, Beginning, EventTimes, Forms, Frequencies, Range, profiled
from magtensor.error_models.terms import Terms
from magtensor.error_models.waveform import NAME
from magtensor.loop.evidence.assessment import estimated, explained
from magtensor.loop.evidence.golden import golden
from magtensor.loop.evidence.scoring import Scorer
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State, turning
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.separation import SEPARATION
from magtensor.loop.searching.beginnings import beginning, extent, least_gain, with_beginning
from magtensor.loop.searching.contribution import (
    KEEP_ALPHA,
    families,
    happens_once,
    held_out,
    moments,
    put_back,
    significance_at_once,
    slices,
)
from magtensor.loop.searching.gates import SECOND_ORDER, Candidate
from magtensor.loop.searching.profiling import of_ratios
from magtensor.loop.searching.split import coefficients

POLISH = 0.1  # of a setting, or of the width of a line, to either side
_SWEEPS = 6  # over all settings, where two models of one kind are in
_RESTS = 0.02  # relative: a setting that moves no further is settled


def adopt(record: Record, state: State, chosen: Candidate, how: Fitting) -> State:
    """Refit with the chosen model, first on all sensors, then on those that show it."""
    return on_those_needed(record, on_all_sensors(record, state, chosen, how), len(state.adopted), how)


def on_those_needed(record: Record, state: State, which: int, how: Fitting) -> State:
    """Refit with one of the models on those of its sensors that need it."""
    sensors = _needed(state, which)
    return state if sensors is None else narrowed(record, state, which, sensors, how)


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


def narrowed(record: Record, state: State, which: int, sensors: tuple[str, ...], how: Fitting) -> State:
    """Refit with one of the models on some of its sensors only."""
    model = state.adopted[which]
    models = list(state.adopted)
    models[which] = Adopted(model.component, model.settings, sensors)
    assert state.terms is not None
    part = slices(state)[which]
    keep = [i for i, s in enumerate(state.terms.sensors[part]) if s in sensors or s == ""]
    theta = list(state.theta)
    theta[which] = theta[which][keep]
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
    """The sensors on which alone a model does as well; None where it needs all that it has."""
    sensors = sensors_showing(state, which)
    return sensors if sensors is not None and _spare(state, which, sensors) else _sufficient(state, which)


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
    part = slices(state)[which]
    assert state.terms is not None
    owners = state.terms.sensors[part]
    names = [s for s in state.excitation.sensors if s in owners]
    if len(names) < 2:
        return None
    own = {s: [part.start + i for i, o in enumerate(owners) if o == s] for s in names}
    if happens_once(state.adopted[which]):
        p_values = [significance_at_once(state, own[s]) for s in names]
    else:
        tests = families(state)
        p_values = [tests.p_value(own[s]) for s in names]
    showing = [s for s, p in zip(names, p_values, strict=True) if p < KEEP_ALPHA / len(names)]
    return tuple(showing) if showing and len(showing) < len(names) else None


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
