"""The law of an adopted effect that follows a channel: any curve of it, where no power of it explains what is left.

A dead zone, a root, a rectifier: a line explains most of such a law, and what it leaves has no other cause. So when
nothing else is left to adopt, every effect that follows one channel is asked for once more with straight lines between
values of it. That accuses nothing new: the channel has been adopted; it says how the effect follows it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import comb

import numpy as np

from magtensor.calibration.joint_together import ABOUT
from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.error_models.curves import bends_of
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel, Bends, Choice, profiled
from magtensor.error_models.terms import Terms, joined
from magtensor.golden import golden
from magtensor.loop.evidence.assessment import WHITE, assess, colours_of, estimated, likeliest
from magtensor.loop.evidence.estimate import Estimate
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.evidence.scoring import Scorer
from magtensor.loop.fitting.log_noise import brought_in
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.separation import fold_gain, separated
from magtensor.loop.fitting.trial import Trial, on_the_folds_of, trial
from magtensor.loop.remainder.curve_of_a_channel import PIECES, another_curve, followed
from magtensor.loop.remainder.flagged import end_of
from magtensor.loop.searching.adopting import polished
from magtensor.loop.searching.contribution import eliminate, put_back_some
from magtensor.loop.searching.found import Step
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.kin import explained_beside
from magtensor.loop.searching.profiling import REFINING_SAMPLES, Thinned, already, thinned

OUTPUTS = ""  # instead of a channel: what each axis reads
FINEST = 48  # pieces of the curve between whose bends the few are chosen that the data ask for
MOST_BENDS = 8
SWEEPS = 2  # over all bends, once they are chosen
MOST_SERIES = 128  # of a curve: what a million samples have room for


def by_any_law(
    record: Record, standing: Trial, how: Fitting, places: Sequence[int], alpha: float, models: int, fixed: int = 0
) -> tuple[Trial, list[Step]]:
    """The fit with the adopted effects at some places by curves of their channels, where such a curve predicts held-out
    blocks better than the law that the effect has, until another effect is no longer needed beside it; and the rounds'
    story, none where there is no such.

    Parameters
    ----------
    models: that are open; fixed: how many were declared.
    """
    steps: list[Step] = []
    for place in places:
        gone = [place, *_other_powers(standing.state, place, fixed)]
        while (
            chosen := _by_a_curve(standing.state, standing.state.adopted[place], gone, 1, alpha, models)
        ) is not None:
            found = _in_their_place(record, standing, gone, chosen, how, fixed)
            if found is None:
                break
            after, dropped = found
            steps.append(Step(standing.state, (chosen,), chosen, dropped=dropped))
            standing = after
            if dropped:
                return standing, steps
    return standing, steps


def _in_their_place(
    record: Record, standing: Trial, gone: Sequence[int], chosen: Candidate, how: Fitting, fixed: int
) -> tuple[Trial, tuple[str, ...]] | None:
    """The fit with a curve in the place of the first of some models, which are gone, and what was dropped beside it;
    None where it does not do better."""
    state = standing.state
    adopted = [chosen.model if i == gone[0] else a for i, a in enumerate(state.adopted) if i not in gone[1:]]
    fit = joint_state(record, adopted, how, _coefficients(state, gone, chosen), state.lines)
    last, dropped = eliminate(record, polished(record, fit, how), how, fixed)
    after = trial(record, last, how)
    before = on_the_folds_of(after, record, standing, how)
    if not by_a_curve_of(last, chosen.model) or before.hurt_by(after) or not before.likelier(after):
        return None
    return after, (*(state.adopted[i].name for i in gone[1:]), *dropped)


def _other_powers(state: State, place: int, fixed: int) -> list[int]:
    """The places of other models of that name that follow its channel: powers of it, which a curve stands for."""
    one, x = state.adopted[place], state.excitation
    if not (follows := one.channels(x)):
        return []
    added = one.terms(x).adds_to_axes
    return [
        i
        for i, other in enumerate(state.adopted)
        if i >= fixed
        and i != place
        and (other.name, other.channels(x)) == (one.name, follows)
        and other.terms(x).adds_to_axes == added
    ]


def by_a_curve_of(state: State, model: Adopted) -> bool:
    """Whether a model that follows its channel by a curve is among the adopted ones."""
    return any(a.name == model.name and by_a_curve(a) for a in state.adopted)


def by_any_law_of(channel: str, state: State, models: Sequence[Component], alpha: float) -> list[Candidate]:
    """The models that can follow a channel, each by the curve of it that predicts best, where that passes both gates.

    Parameters
    ----------
    channel: of `OUTPUTS` the models of each axis's transfer curve; models: all that are open.
    """
    x = state.excitation
    channels = 1 if channel == OUTPUTS else sum(not x.is_vector(name) for name in x.logged)
    found = []
    for component in models:
        grids = profiled(component)
        any_ = {name: grid for name, grid in grids.items() if isinstance(grid, AnyChannel)}
        places = [name for name, grid in any_.items() if channel in grid.values(x)]
        own = channel == OUTPUTS and not any_
        if not (own or len(places) == 1) or not any(isinstance(grid, Bends) for grid in grids.values()):
            continue
        plain = {name: component.parameters[name].default for name in grids} | dict.fromkeys(places, channel)
        if already(state.adopted, component, plain):
            continue
        powers = {name for grid in grids.values() if isinstance(grid, Bends) for name in grid.instead}
        open_ = {name: grid.options for name, grid in grids.items() if type(grid) is Choice and name not in powers}
        ways = [dict(zip(open_, values, strict=True)) for values in itertools.product(*open_.values())]
        curves = [_by_a_curve(state, Adopted(component, plain | way), [], channels, alpha, len(models)) for way in ways]
        found += [max((c for c in curves if c), key=lambda c: c.assessment.gain.total)] if any(curves) else []
    return found


def at_an_end(state: State) -> list[str]:
    """The channels with one value that are at an end of their range where samples fit nothing, if these are more than a
    few, and `OUTPUTS` where what an axis reads is: there something may act that does so nowhere else."""
    wrong, x = ~np.asarray(state.fit.keep), state.excitation
    if wrong.sum() <= ABOUT:
        return []
    read = np.abs(x.output.reshape(len(x.time), -1).T)
    ends = [name for name, values in x.logged.items() if end_of(values, wrong)]
    return [*ends, *([OUTPUTS] if any(end_of(values, wrong) == "largest" for values in read) else [])]


def outdone_by(chosen: Candidate, state: State) -> str:
    """The channel any curve of which explains more than a candidate that follows another; "" where there is none."""
    theta = chosen.assessment.theta[-chosen.terms.count :]
    seen = chosen.before or state  # at the samples of its terms
    return another_curve(seen, chosen.model, chosen.terms, theta, chosen.assessment.colours)


def by_a_curve(model: Adopted) -> bool:
    """Whether a model follows its channel by a curve that bends."""
    return any(isinstance(grid, Bends) and model.settings.get(name) for name, grid in profiled(model.component).items())


def _by_a_curve(
    state: State, model: Adopted, gone: Sequence[int], tried: int, alpha: float, models: int
) -> Candidate | None:
    """A model that follows one channel, by the curve of it that predicts best in the place of some that are gone, with
    the fewest bends that are not separated from that; None where it does not pass both gates beside these, or the model
    can follow none.

    Parameters
    ----------
    tried: channels; models: error models that it was found among.
    """
    x = state.excitation
    mark = next(((name, grid) for name, grid in profiled(model.component).items() if isinstance(grid, Bends)), None)
    column = _what_drives(model, x)
    if mark is None or column is None:
        return None
    name, grid = mark
    line = {other: profiled(model.component)[other].options[0] for other in grid.instead}
    column = column[state.residual.samples]
    has = tuple(model.settings.get(name, ()))

    def curve(bends: Sequence[float]) -> Adopted:
        return replace(model, settings={**model.settings, **line, name: (*has, *bends)})

    options = [bend for bend in bends_of(column, FINEST) if bend not in has]
    base = put_back_some(state, gone) if gone else state
    asked_for = _asked_for(base, curve, options, alpha / (tried * models)) if options else []
    if not asked_for:
        return None
    every = [curve(bends).terms(x).at(state.residual.samples) for bends in asked_for]
    together = every[0] if base.terms is None else joined([base.terms, every[0]])
    colours = likeliest(base.residual, together, [state.colours, WHITE]).colours
    gains = [fold_gain(base, colours, terms) for terms in every]
    best = max(gains, key=lambda gain: gain.total)
    chosen = max(k for k, gain in enumerate(gains) if not separated(best, gain))
    spacing = float(np.ptp(column)) / FINEST
    bends = _moved(base, curve, asked_for[chosen], spacing)
    while len(bends) > 1:  # where each explains most two of them may be one
        fewer = _moved(base, curve, _without_the_least(base, curve, bends), spacing)
        here, there = (fold_gain(base, colours, curve(b).terms(x).at(state.residual.samples)) for b in (bends, fewer))
        if separated(here, there):
            break
        bends = fewer
    moved = curve(bends)
    moved = replace(moved, settings={**moved.settings, name: tuple(sorted(moved.settings[name]))})
    found = _assessed(state, moved, tried * comb(len(options), len(asked_for[chosen])), alpha).among(models)
    return found if found.passes else None


def _what_drives(model: Adopted, x: Excitation) -> Array | None:
    """What a model would follow by a curve: the channel (N,), or the axes' outputs (N, 3 S) nT where it needs none;
    None where it follows more."""
    if not model.channels(x):
        return x.output.reshape(len(x.time), -1)
    courses = followed(model, x)
    return np.atleast_2d(courses[0][1].T).mean(axis=0) if len(courses) == 1 else None


def _asked_for(
    state: State, curve: Callable[[Sequence[float]], Adopted], options: Sequence[float], alpha: float
) -> list[list[float]]:
    """The bends of a curve that the data ask for, chosen one after the other from options, and then without one after
    the other again, that which explains least; none where chance explains the first.

    Source: Friedman 1991 (multivariate adaptive regression splines), of one variable.
    """
    few, (residual, given) = Thinned.of(state, REFINING_SAMPLES), thinned(state, REFINING_SAMPLES)
    line = few.of_model(curve([]))

    def beyond(bend: float) -> Terms:
        every = few.of_model(curve([bend]))
        return every.only(range(line.count, every.count))

    def beside(terms: Terms) -> Terms:
        return terms if given is None else joined([given, terms])

    rich = few.of_model(curve(options[:: -(-len(options) // PIECES[-1])]))
    colours = likeliest(residual, beside(rich), [colours_of(residual), WHITE]).colours
    chosen: list[float] = []
    one = few.of_model(curve(options[:1]))
    room = (MOST_SERIES - line.series.shape[1]) // (one.series.shape[1] - line.series.shape[1])
    while len(chosen) < min(MOST_BENDS, len(options), room):
        left = [bend for bend in options if bend not in chosen]
        score = Scorer(residual, beside(few.of_model(curve(chosen))), colours)
        values = score.of_each([beyond(bend) for bend in left])
        best = int(np.argmax(values))
        if np.exp(-values[best]) * len(left) > alpha:
            break
        chosen.append(left[best])
    if not chosen:
        return []
    whole = estimated(residual, beside(few.of_model(curve(chosen))), colours)
    return _fewer_and_fewer(whole, chosen, one.count - line.count)


def _moved(
    state: State, curve: Callable[[Sequence[float]], Adopted], bends: Sequence[float], spacing: float
) -> list[float]:
    """The bends where they explain most, each within the spacing of the options to either side."""
    few, (residual, given) = Thinned.of(state, REFINING_SAMPLES), thinned(state, REFINING_SAMPLES)
    terms = few.of_model(curve(bends))
    together = terms if given is None else joined([given, terms])
    score = Scorer(residual, given, likeliest(residual, together, [colours_of(residual), WHITE]).colours)
    here = list(bends)
    for k in [*range(len(here))] * SWEEPS:

        def gain(value: float, k: int = k) -> float:
            return score(few.of_model(curve([*here[:k], value, *here[k + 1 :]])))

        here[k] = golden(gain, here[k] - spacing, here[k] + spacing, here[k])
    return here


def _without_the_least(state: State, curve: Callable[[Sequence[float]], Adopted], bends: list[float]) -> list[float]:
    """The bends of a curve without that which explains least."""
    few, (residual, given) = Thinned.of(state, REFINING_SAMPLES), thinned(state, REFINING_SAMPLES)
    every = few.of_model(curve(bends))
    each = every.count - few.of_model(curve(bends[:-1])).count
    together = every if given is None else joined([given, every])
    whole = estimated(residual, together, likeliest(residual, together, [colours_of(residual), WHITE]).colours)
    return _fewer_and_fewer(whole, bends, each)[1]


def _fewer_and_fewer(whole: Estimate, bends: list[float], each: int) -> list[list[float]]:
    """The bends, and always those of them that explain most without one of them, down to one.

    Parameters
    ----------
    whole: the coefficients with all of them, the last ones of each bend, in their order.
    """
    n, y = whole.normal, whole.normal @ whole.theta
    first = len(y) - each * len(bends)

    def lost(kept: list[int]) -> float:
        own = [*range(first), *(first + each * k + i for k in kept for i in range(each))]
        return -float(y[own] @ np.linalg.pinv(n[np.ix_(own, own)], hermitian=True) @ y[own])

    kept = list(range(len(bends)))
    found = [list(bends)]
    while len(kept) > 1:
        kept = min(([k for k in kept if k != gone] for gone in kept), key=lost)
        found.append([bends[k] for k in kept])
    return found


def _assessed(state: State, model: Adopted, tried: int, alpha: float) -> Candidate:
    """What a curve explains beside the law that is adopted, which is one of its own."""
    terms = model.terms(state.excitation).at(state.residual.samples)
    now = Whitened.of(state.residual, state.colours.across, state.colours.along, state.terms)
    assessment = assess(now, terms)
    follows = model.channels(state.excitation)
    log_noise = brought_in(state, follows)  # flat where a switched channel rests, a curve has less of it
    return Candidate(
        model, tried, terms, assessment, assessment.p * tried, assessment.own_p * tried, assessment.null_p * tried,
        alpha, log_noise, explained_beside(state, model, terms, assessment),
    )  # fmt: skip


def _coefficients(state: State, gone: Sequence[int], chosen: Candidate) -> list[Array]:
    """Of every model that is left, where a joint fit with the curve in the place of the first that is gone begins."""
    without = put_back_some(state, gone)
    together = chosen.terms if without.terms is None else joined([without.terms, chosen.terms])
    theta = estimated(without.residual, together, chosen.assessment.colours).theta
    rest = [t for i, t in enumerate(state.theta) if i not in gone]
    *moves, own = np.split(theta, np.cumsum([len(t) for t in rest])) if rest else [theta]
    start = [t + move for t, move in zip(rest, moves, strict=True)]
    at = gone[0] - sum(i < gone[0] for i in gone[1:])
    return [*start[:at], own, *start[at:]]
