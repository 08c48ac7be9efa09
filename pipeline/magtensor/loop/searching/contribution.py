"""What adopted models contribute beside each other, and which no longer earn their place."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.error_models.settings import EventTimes, Frequencies, profiled
from magtensor.error_models.terms import Terms
from magtensor.error_models.waveform import NAME
from magtensor.errors import DataError
from magtensor.loop.evidence.assessment import WHITE, Colours
from magtensor.loop.evidence.folds import Blocks
from magtensor.loop.evidence.gains import Gain, concentrated, focused_gain, held_out_gain
from magtensor.loop.evidence.grams import Grams, grams
from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.evidence.residual import Residual, taken_off
from magtensor.loop.evidence.statistics import Families
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.trial import WORST_RISE, on_the_folds_of, trial
from magtensor.loop.searching.beginnings import at_its_limit

LEAST_FALL = 5e-4  # of the error on held-out blocks, by what lasts: 3 % of the noise is no effect anybody would miss
LEAST_SAMPLES = 6.0  # that hold nearly all of what happened once
KEEP_ALPHA = 0.01  # an adopted effect that is no longer significant at this level is dropped


def slices(state: State) -> list[slice]:
    edges = np.cumsum([0, *(len(t) for t in state.theta)])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]


def families(state: State) -> Families:
    """Tests of some of the adopted coefficients, the others free: of the residual with their part put back."""
    assert state.terms is not None
    return Families(_blocks(state), state.terms.sensors)


def significance_at_once(state: State, chosen: Sequence[int]) -> float:
    """The same of something that happened once, of which the scatter over blocks tells nothing: in noise of each
    sensor's own spectrum."""
    assert state.terms is not None
    back = put_back(state.residual, state.terms, np.concatenate(state.theta))
    others = [i for i in range(state.terms.count) if i not in set(chosen)]
    given = state.terms.only(others) if others else None
    return OwnNoise(back, given).by_score(state.terms.only(chosen))


def held_out(state: State, given: Sequence[int]) -> Gain:
    """What all other coefficients gain on held-out blocks beside the given ones."""
    assert state.terms is not None
    return held_out_gain(_blocks(state), state.residual.freedom, np.isin(np.arange(state.terms.count), given))


def _blocks(state: State, colours: Colours | None = None, parts: Blocks | None = None) -> Grams:
    """Of the adopted terms and the residual with their part put back, in the finest blocks or in others, in noise of
    its own colour or another."""
    assert state.terms is not None
    back = put_back(state.residual, state.terms, np.concatenate(state.theta))
    noise, edges = colours or state.colours, (parts or Blocks.equal(len(state.residual.affine))).edges
    return grams(back, state.terms, noise.across, noise.along, edges)


def _gain_of(state: State, place: int, blocks: Grams, colours: Colours | None = None) -> Gain:
    """What one of the adopted models gains on held-out folds beside the others: of what happened once, on its parts; of
    what lies in one fold, as a warming up that is soon over, on folds that know equally much, where there are any.

    Parameters
    ----------
    blocks: the finest ones, in noise of its own colour or another.
    """
    assert state.terms is not None
    others, freedom = _all_but(state, [place]), state.residual.freedom
    if not happens_once(state.adopted[place]):
        focused = focused_gain(blocks, freedom, others) if concentrated(blocks, others) else None
        return focused or held_out_gain(blocks, freedom, others)
    parts = Blocks.of_an_event(state.terms.only(np.flatnonzero(~others).tolist()))
    return held_out_gain(_blocks(state, colours, parts), freedom, others, parts)


def removal(state: State, *places: int) -> tuple[float, float]:
    """Held-out rms of the residual in nT, all noise alike, without and with some of the adopted models, the others in
    both."""
    blocks = _blocks(state, WHITE)
    if len(places) == 1:
        gain = _gain_of(state, places[0], blocks, WHITE)
    else:
        gain = held_out_gain(blocks, state.residual.freedom, _all_but(state, places))
    before, after = gain.rms
    return before * state.residual.scale, after * state.residual.scale


def _all_but(state: State, places: Sequence[int]) -> NDArray[np.bool_]:
    """(P,) the coefficients of the other models."""
    assert state.terms is not None
    others = np.ones(state.terms.count, dtype=bool)
    for place in places:
        others[slices(state)[place]] = False
    return others


def put_back(residual: Residual, terms: Terms, theta: Array) -> Residual:
    """The residual as it would be without the correction, to first order."""
    return taken_off(residual, terms, -theta)


def put_back_one(state: State, place: int) -> State:
    """As `put_back_some`, of one."""
    return put_back_some(state, [place])


def put_back_some(state: State, places: Sequence[int]) -> State:
    """The state as it would be without some of the models, to first order: their part in the residual, the terms of the
    others alone."""
    assert state.terms is not None
    gone = {i for place in places for i in range(*slices(state)[place].indices(state.terms.count))}
    rest = [i for i in range(state.terms.count) if i not in gone]
    theta = np.concatenate(state.theta)[sorted(gone)]
    residual = put_back(state.residual, state.terms.only(sorted(gone)), theta)
    return replace(state, residual=residual, terms=state.terms.only(rest) if rest else None)


def eliminate(record: Record, state: State, how: Fitting, fixed: int) -> tuple[State, tuple[str, ...]]:
    """Drop models that no longer earn their place, the weakest first: those whose coefficients are not what their
    settings assume, those that are not significant beside the others, and those without which the others predict
    held-out blocks as well, or better if all noise counts alike. A single one has just passed the gates but for the
    last: what raises the error on blocks that it has not seen is no effect, whatever noise it makes white; nor is what
    is over at once."""
    if len(state.adopted) == 1:
        if fixed or not (over_at_once(state, 0) or (_lasts(state.adopted[0]) and _rise(state, 0) > 1.0)):
            return state, ()
        return without_models(record, state, [0], how), (state.adopted[0].name,)
    dropped: list[str] = []
    while len(state.adopted) > fixed:
        assert state.terms is not None
        tests = families(state)
        blocks = tests.finest
        parts = slices(state)[fixed:]
        values = [
            _of_an_event(state, fixed + i)
            if happens_once(state.adopted[fixed + i])
            else tests.p_value(range(p.start, p.stop))
            for i, p in enumerate(parts)
        ]
        gains = [_gain_of(state, fixed + i, blocks).total for i in range(len(parts))]
        rises = [_rise(state, fixed + i) for i in range(len(parts))]
        unlike = [i for i in range(fixed, len(state.adopted)) if not agrees(state, i) or over_at_once(state, i)]
        if unlike:
            weakest = unlike[0]
        elif max(values) >= KEEP_ALPHA:
            weakest = fixed + int(np.argmax(values))
        elif min(gains) <= 0:
            weakest = fixed + int(np.argmin(gains))
        elif max(rises) > 1.0:
            weakest = fixed + int(np.argmax(rises))
        else:
            break
        dropped.append(state.adopted[weakest].name)
        state = without_models(record, state, [weakest], how)
    return state, tuple(dropped)


def borne_out(record: Record, state: State, how: Fitting, fixed: int) -> tuple[State, tuple[str, ...]]:
    """Without those adopted models that make the calibration worse for blocks it was not fitted to, each of them fitted
    anew. Every one passed this gate when it was adopted, but beside others that have been taken out since."""
    dropped: list[str] = []
    while len(state.adopted) > fixed:
        now = trial(record, state, how)
        rises = {}
        for place in range(fixed, len(state.adopted)):
            others = possible_without(record, state, [place], how)
            if others is None:
                continue
            without = on_the_folds_of(now, record, trial(record, others, how), how)
            errors = without.beside(now)
            if errors[0]:
                before, after = (float(np.sqrt(np.mean(np.square(list(e.values()))))) for e in errors)
                rises[place] = after / before / (1.0 if _lasts(state.adopted[place]) else 1.0 + WORST_RISE)
        worst = max(rises, key=lambda place: rises[place], default=None)
        if worst is None or rises[worst] <= 1.0:
            break
        dropped.append(state.adopted[worst].name)
        state = without_models(record, state, [worst], how)
    return state, tuple(dropped)


def _of_an_event(state: State, place: int) -> float:
    """P value of an adopted model of what happened once, beside the others, all times corrected for at which it might
    have: its part in two or three blocks has no scatter."""
    assert state.terms is not None
    own = slices(state)[place]
    mine = state.terms.only(range(own.start, own.stop))
    others = [i for i in range(state.terms.count) if not own.start <= i < own.stop]
    noise = OwnNoise(put_back(state.residual, mine, state.theta[place]), state.terms.only(others) if others else None)
    times = [g.count for g in profiled(state.adopted[place].component).values() if isinstance(g, EventTimes)]
    return noise.p_value(mine) * float(np.prod(times))


def over_at_once(state: State, place: int) -> bool:
    """Whether what an adopted model says of something that happens once lies in a handful of samples that the fit
    believes, or in none, all others being flagged: a sensor that hangs, a spark. It has nearly as many coefficients."""
    if not happens_once(state.adopted[place]):
        return False
    assert state.terms is not None
    mine = state.terms.only(range(*slices(state)[place].indices(state.terms.count)))
    theta, outputs = state.theta[place], 3 * len(state.excitation.sensors)
    on_each = np.column_stack([mine.contribution(theta, outputs), mine.on_reference(theta)])
    size = np.sum((on_each - on_each.mean(axis=0)) ** 2, axis=1)
    return float(size.sum()) ** 2 < LEAST_SAMPLES * float(np.sum(size**2)) or not size.any()


def _rise(state: State, place: int) -> float:
    """The factor by which an adopted model raises the error on held-out blocks, over what it may.

    What lasts has to lower it. Of what happened once the blocks where it did say little, and what holds a waveform has
    its noise: both may raise it somewhat. Where only a few blocks know anything it is as if it had happened once.
    """
    others, lasting = _all_but(state, [place]), _lasts(state.adopted[place])
    blocks = _blocks(state, WHITE)
    gain = _gain_of(state, place, blocks, WHITE)
    if lasting and concentrated(blocks, others):
        lasting = focused_gain(blocks, state.residual.freedom, others) is not None
    before, after = gain.rms
    return after / before / (1.0 - LEAST_FALL if lasting else 1.0 + WORST_RISE)


def _lasts(model: Adopted) -> bool:
    """Whether a model is neither of what happened once nor of a waveform found in the data."""
    return model.name != NAME and not happens_once(model)


def happens_once(model: Adopted) -> bool:
    """Whether a model is of an event, whose time is a setting."""
    return any(isinstance(g, EventTimes) for g in profiled(model.component).values())


def moments(model: Adopted) -> list[float]:
    """s after the survey's start, when an event happened, in order."""
    marks = profiled(model.component).items()
    return sorted(float(model.settings[name]) for name, mark in marks if isinstance(mark, EventTimes))


def a_tone(model: Adopted) -> bool:
    """Whether a model is of a tone, whose frequency is where the spectrum of what is left is strongest."""
    return any(isinstance(g, Frequencies) for g in profiled(model.component).values())


def tones_of(model: Adopted) -> list[float]:
    """Hz of the tones that a model is of."""
    return [float(model.settings[n]) for n, g in profiled(model.component).items() if isinstance(g, Frequencies)]


def agrees(state: State, place: int) -> bool:
    """Whether the coefficients of an adopted model are what its settings assume, and explain what they then must; and
    whether it began as a response may."""
    model = state.adopted[place]
    if at_its_limit(model.component, model.settings, state.excitation):
        return False
    test = model.component.agrees
    return test is None or test(state.excitation, model.settings, state.theta[place], explained_share(state, place))


def explained_share(state: State, place: int) -> float:
    """The share of |b| - F that an adopted model explains, of what lasts from one sample to the next: white noise, in
    which there is nothing to explain, has no part in it. 1 without a total field, or where nothing lasts."""
    assert state.terms is not None
    own = slices(state)[place]
    mine = state.terms.only(range(own.start, own.stop))
    without, left = put_back(state.residual, mine, state.theta[place]).along, state.residual.along
    if without is None or left is None:
        return 1.0
    lasting = without[1:] @ without[:-1]
    its = without - left
    both = 0.5 * (without[1:] @ its[:-1] + without[:-1] @ its[1:])
    return float(both / lasting) if lasting > 0 else 1.0


def share_of_differences(state: State, place: int) -> float:
    """What an adopted model makes of differences of the field between the sensors, rms over these; 0 where it does not
    need them.

    A law that is of first order in an error of positions, or in what one sensor does to another, makes little of them.
    If it makes much, it amplifies the noise, and fields that are not uniform are lost.
    """
    model = state.adopted[place]
    if "gradient" not in model.component.declared({}).needs:
        return 0.0
    x = state.excitation
    differs = np.random.default_rng(0).standard_normal((len(x.sensors), 3))
    differs -= differs.mean(axis=0)
    made = [
        model.terms(replace(x, site=np.broadcast_to(site, x.field.shape))).contribution(
            state.theta[place], differs.size
        )
        for site in (np.zeros_like(differs), differs)
    ]
    return float(np.sqrt(np.mean((made[1] - made[0]) ** 2) / np.mean(differs**2)))


def share_of_the_field(state: State, place: int) -> float:
    """The largest coefficient of an adopted model that is a share of the field; 0 of a model in other units."""
    assert state.terms is not None
    units = state.terms.units[slices(state)[place]]
    return max((abs(c) * 1e-6 for c, u in zip(state.theta[place], units, strict=True) if u == "ppm"), default=0.0)


def without_models(record: Record, state: State, places: Sequence[int], how: Fitting) -> State:
    """The fit without some of its models."""
    rest = [i for i in range(len(state.adopted)) if i not in places]
    return joint_state(record, [state.adopted[i] for i in rest], how, [state.theta[i] for i in rest], state.lines)


def possible_without(record: Record, state: State, places: Sequence[int], how: Fitting) -> State | None:
    """The same; None where what they explain is as large as the field, and the others leave nothing to calibrate."""
    try:
        return without_models(record, state, places, how)
    except DataError:
        return None
