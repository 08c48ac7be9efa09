"""The search: screen every error model, adopt what the data want on blocks the fit has not seen, refit, repeat.

An effect is adopted only when it passes two independent gates: a jackknife over blocks that autocorrelation cannot
fool, with the family-wise error held by Holm's rule over every model and every setting tried, and a gain on held-out
contiguous folds. Rivals that do as well on this survey are named, and the simplest of them is adopted.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.errors import DataError
from magtensor.loop.assessment import WHITE, Colours, estimated, explained
from magtensor.loop.evidence import Grams
from magtensor.loop.excitation import Excitation
from magtensor.loop.latent import NAME, Sought, renewed, sought, tried_source
from magtensor.loop.model import Adopted, Fitting, Record, State, joint_state
from magtensor.loop.needs import missing
from magtensor.loop.residual import Residual
from magtensor.loop.scoring import Scorer
from magtensor.loop.screening import ALPHA, Candidate, candidates_of, generic, golden, profiled, repeatable
from magtensor.loop.separation import SEPARATION, fold_gain, separated
from magtensor.loop.settings import Range
from magtensor.loop.spectrum import spectral_lines
from magtensor.loop.statistics import family_p, held_out_gain
from magtensor.loop.terms import Terms
from magtensor.loop.trial import WORST_RISE, Trial, trial

KEEP_ALPHA = 0.01  # an adopted effect that is no longer significant at this level is dropped
MOST_EFFECTS = 8
ROUNDING = 1e-4  # mean square of the whitened residual: far below the least noise that any sensor is believed to have
POLISH = 0.1  # of a setting, to either side
_SWEEPS = 6  # over all settings, where two models of one kind are in
_RESTS = 0.02  # relative: a setting that moves no further is settled


@dataclass(frozen=True)
class Step:
    """One round of the search: what was looked at and what was done.

    Attributes:
        before: state before; candidates: by held-out gain, best first.
        adopted: the candidate adopted, None where none was.
        rivals: names of models that the data do not separate from it.
        dropped: models dropped after the refit.
        refused: model -> why it was not kept after it had been fitted.
    """

    before: State
    candidates: tuple[Candidate, ...]
    adopted: Candidate | None
    rivals: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Search:
    """The whole search.

    Attributes:
        first, last: states with the declared model and with all that was adopted.
        steps: in order.
        not_tested: model -> what the survey lacks for it.
        failed: model -> why its regressors could not be made.
        record: the samples, with the waveform of a source that nobody logged where one was adopted.
        shared: the waveform that the sensors share after all that was adopted; None where it cannot be asked for.
    """

    first: State
    last: State
    steps: tuple[Step, ...]
    not_tested: Mapping[str, tuple[str, ...]]
    failed: Mapping[str, str]
    record: Record
    shared: Sought | None


def search(
    record: Record,
    models: Sequence[Component],
    how: Fitting,
    *,
    declared: Sequence[Adopted] = (),
    most_effects: int = MOST_EFFECTS,
    alpha: float = ALPHA,
    lines: Sequence[float] | None = None,
    say: Callable[[str], None] | None = None,
) -> Search:
    """Find the effects that the declared model lacks.

    Parameters
    ----------
    record: the samples.
    models: the error models that may be adopted.
    how: how the joint fit is made.
    declared: error models that are in the fit from the beginning, never dropped.
    most_effects: stop after so many adoptions.
    alpha: family-wise false-alarm probability of the first gate.
    lines: Hz, the strongest in the spectrum of the survey that the record is a part of; sought in the record if None.
    say: called with a line about each round.
    """
    if declared:
        _require_channels(joint_state(record, [], how).excitation, declared)
    state = first = joint_state(record, declared, how)
    testable, not_tested = _testable(first.excitation, models)
    hidden = next((m for m in models if m.name == NAME), None)
    not_tested.pop(NAME, None)
    shared: Sought | None = None
    standing = trial(record, first, how)
    steps: list[Step] = []
    failed: dict[str, str] = {}
    for _ in range(most_effects + 1):
        state = with_lines(state, record, lines)
        if len(state.adopted) - len(declared) >= most_effects or state.residual.square() < ROUNDING:
            break
        taken = {a.name for a in state.adopted}
        open_ = [m for m in testable if m.name not in taken or repeatable(m)]
        candidates = candidates_of(state, open_, failed, alpha)
        adopted = _first_kept(record, standing, candidates, how, len(declared), say)
        steps.append(Step(state, tuple(candidates), *adopted.step))
        if adopted.standing is not None:
            record, state = renewed(record, adopted.standing.state, how)
            standing = replace(adopted.standing, state=state)
            continue
        shared = sought(state, record)
        if shared is None or hidden is None or NAME in taken:
            break
        shared, source = tried_source(hidden, record, state, shared, how, alpha)
        if source is None:
            break
        if say is not None:
            say(f"adopting {NAME}")
        steps[-1] = replace(steps[-1], adopted=source.evidence)
        record, state, shared = source.record, source.after, None
        standing = trial(record, state, how)
    # what nothing explains is a disturbance after all, and no part of the calibration
    last = joint_state(record, state.adopted, replace(how, searching=False), state.theta, state.lines)
    return Search(first, last, tuple(steps), not_tested, failed, record, shared or sought(last, record))


@dataclass(frozen=True)
class _Kept:
    """The outcome of a round; `standing` is None where nothing was kept."""

    standing: Trial | None
    chosen: Candidate | None = None
    rivals: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)

    @property
    def step(self) -> tuple[Candidate | None, tuple[str, ...], tuple[str, ...], Mapping[str, str]]:
        return self.chosen, self.rivals, self.dropped, self.refused


def _first_kept(
    record: Record,
    before: Trial,
    candidates: Sequence[Candidate],
    how: Fitting,
    fixed: int,
    say: Callable[[str], None] | None,
) -> _Kept:
    """Fit the candidates that pass, the best first, until one is kept."""
    refused: dict[str, str] = {}
    while passing := [c for c in candidates if c.passes and c.model.name not in refused]:
        best = max(passing, key=lambda c: c.assessment.gain.total)
        possible = [c for c in candidates if c.predicts and c.model.name not in refused]
        best = _containing(best, possible, before.state)
        chosen, rivals = simplest(best, possible, before.state)
        if say is not None:
            say(f"adopting {chosen.model.name}")
        after, why = _kept(record, before, chosen, how)
        if after is None:
            refused[chosen.model.name] = why
            continue
        last, dropped = _eliminate(record, after.state, how, fixed)
        if dropped:
            after = trial(record, last, how)
        if chosen.model.name in dropped and len(last.adopted) <= len(before.state.adopted):
            return _Kept(None, chosen, rivals, dropped, refused)
        return _Kept(after, chosen, rivals, dropped, refused)
    return _Kept(None, refused=refused)


def _kept(record: Record, before: Trial, chosen: Candidate, how: Fitting) -> tuple[Trial | None, str]:
    """The fit with a model, on fewer sensors where it hurts one that it does not help; None, and why, if it fails."""
    try:
        after = trial(record, _polished(record, adopt(record, before.state, chosen, how), how), how)
    except DataError as error:  # with coefficients that run away nothing is left to calibrate
        return None, f"it cannot be fitted: {error.what.split(':')[0]}"
    hurt = before.hurt_by(after)
    if hurt:
        which = len(before.state.adopted)
        own = after.state.adopted[which].sensors or tuple(record.sensors)
        helped = [s for s in before.helped_by(after) if s in own]
        if helped and set(chosen.terms.sensors) >= set(own):
            narrowed = _narrowed(record, after.state, which, tuple(helped), how)
            after = trial(record, narrowed, how)
            hurt = before.hurt_by(after)
    if hurt:
        return None, f"fitted, it raises the held-out error of {', '.join(hurt)}"
    model, theta = after.state.adopted[-1], after.state.theta[-1]
    agrees = model.component.agrees
    if agrees is not None and not agrees(model.settings, theta):
        return None, "fitted, its coefficients are not what its settings assume"
    if not before.likelier(after):
        return None, "fitted together with the others, it leaves more than it takes away"
    return after, ""


def _require_channels(x: Excitation, declared: Sequence[Adopted]) -> None:
    """A declared error model needs its channels.

    Raises
    ------
    DataError: the survey lacks some.
    """
    words = [
        f"{model.name} needs {' and '.join(lacks)}" for model in declared if (lacks := missing(model.component, x))
    ]
    if words:
        raise DataError(
            f"the declared error models cannot be fitted to this survey: {'; '.join(words)}",
            hint=f"it logs {', '.join(sorted(x.logged)) or 'no channel'}; leave the model out or log what it follows",
        )


def _testable(x: Excitation, models: Sequence[Component]) -> tuple[list[Component], dict[str, tuple[str, ...]]]:
    """The models whose channels exist, and what the others miss."""
    lacking = {model.name: tuple(missing(model, x)) for model in models}
    return [m for m in models if not lacking[m.name]], {name: lacks for name, lacks in lacking.items() if lacks}


def _containing(best: Candidate, possible: Sequence[Candidate], state: State) -> Candidate:
    """The best of the models that predict more and leave `best` nothing to predict; `best` where there is none.

    Slow noise could explain such a model, but not `best`, which is a part of what it explains: a drift, say, that is
    more than a warming up.
    """
    more = [c for c in possible if c.assessment.gain.total > best.assessment.gain.total + SEPARATION]
    for other in sorted(more, key=lambda c: -c.assessment.gain.total):
        colours = other.assessment.colours
        alone = fold_gain(state, colours, other.terms)
        if fold_gain(state, colours, other.terms, best.terms).total - alone.total < SEPARATION:
            return other
    return best


def simplest(best: Candidate, possible: Sequence[Candidate], state: State) -> tuple[Candidate, tuple[str, ...]]:
    """The simplest of the models that the held-out blocks do not separate from the best, and the others' names.

    Simplest is more of what was adopted already, with another setting; then what has the fewest coefficients.
    A model that slow noise could explain is named, and not chosen before one that it could not.
    """
    colours = best.assessment.colours
    reference = fold_gain(state, colours, best.terms)
    equal: list[Candidate] = [best]
    for other in possible:
        if other is best:
            continue
        spare = max(other.assessment.estimate.rank - best.assessment.estimate.rank, 0)
        if not separated(reference, fold_gain(state, colours, other.terms), spare):
            equal.append(other)
    known = {a.name for a in state.adopted}

    def complexity(c: Candidate) -> tuple[bool, bool, int, float]:
        return generic(c.model), c.model.name not in known, c.assessment.estimate.rank, -c.assessment.gain.total

    chosen = min((c for c in equal if c is best or c.passes), key=complexity)
    return chosen, tuple(sorted({c.model.name for c in equal if c is not chosen} - {chosen.model.name}))


def adopt(record: Record, state: State, chosen: Candidate, how: Fitting) -> State:
    """Refit with the chosen model, first on all sensors, then on those that show it."""
    # what it found of the others too: begun from zero, a strong slow effect would pass for the colour of the noise
    moves = np.split(chosen.assessment.theta, np.cumsum([len(t) for t in state.theta]))
    start = [t + move for t, move in zip([*state.theta, np.zeros(chosen.terms.count)], moves, strict=True)]
    after = joint_state(record, [*state.adopted, chosen.model], how, start)
    which = len(state.adopted)
    sensors = _sensors_showing(after, which)
    if sensors is None or not _spare(after, which, sensors):
        sensors = _sufficient(after, which)
    return after if sensors is None else _narrowed(record, after, which, sensors, how)


def _narrowed(record: Record, state: State, which: int, sensors: tuple[str, ...], how: Fitting) -> State:
    """Refit with one of the models on some of its sensors only."""
    model = state.adopted[which]
    models = list(state.adopted)
    models[which] = Adopted(model.component, model.settings, sensors)
    assert state.terms is not None
    part = _slices(state)[which]
    keep = [i for i, s in enumerate(state.terms.sensors[part]) if s in sensors or s == ""]
    theta = list(state.theta)
    theta[which] = theta[which][keep]
    return joint_state(record, models, how, theta)


def _spare(state: State, which: int, sensors: tuple[str, ...]) -> bool:
    """Whether a model can do without its coefficients for all but some sensors.

    A coefficient may be insignificant because others can stand in for it, as where only differences between sensors
    are seen (a delay of all of them is a turn of the field): each could go, and not several of them.
    """
    from scipy.special import chdtri

    gone, seen, lost = _without_others(state, which, sensors)
    return seen == gone and lost < float(chdtri(gone, KEEP_ALPHA))


def _sufficient(state: State, which: int) -> tuple[str, ...] | None:
    """The one sensor whose coefficients explain all that a model does, where others can stand in for them.

    If only differences between sensors are seen, one that turned is like all others turned the other way: every
    coefficient is significant, or none is. None where no sensor suffices, or several do.
    """
    from scipy.special import chdtri

    assert state.terms is not None
    owners = state.terms.sensors[_slices(state)[which]]
    found = []
    for sensor in sorted(set(owners) - {""}):
        gone, seen, lost = _without_others(state, which, (sensor,))
        if 0 < seen < gone and lost < float(chdtri(seen, KEEP_ALPHA)):
            found.append(sensor)
    return tuple(found) if len(found) == 1 else None


def _without_others(state: State, which: int, sensors: tuple[str, ...]) -> tuple[int, int, float]:
    """Of a model's coefficients for all but some sensors: how many, how many directions of them the survey shows, and
    what is explained no longer without them."""
    assert state.terms is not None
    part = _slices(state)[which]
    kept = [i for i, s in enumerate(state.terms.sensors) if not part.start <= i < part.stop or s in sensors or s == ""]
    back = put_back(state.residual, state.terms, np.concatenate(state.theta))
    every = estimated(back, state.terms, state.colours)
    fewer = estimated(back, state.terms.only(kept), state.colours)
    return state.terms.count - len(kept), every.rank - fewer.rank, explained(every) - explained(fewer)


def _polished(record: Record, state: State, how: Fitting) -> State:
    """The settings on a range, sought once more now that everything is fitted together; a setting that is a little
    off leaves a residual that another model would be adopted for."""
    for _ in range(_SWEEPS):
        moved = False
        for number, model in enumerate(state.adopted):
            for name, grid in profiled(model.component).items():
                if not isinstance(grid, Range) or not state.adopted[number].settings[name]:
                    continue
                here = float(state.adopted[number].settings[name])
                best = _sought_anew(state, number, name)
                if best == here:
                    continue
                moved |= abs(best - here) > _RESTS * abs(here)
                now = state.adopted[number]
                changed = Adopted(now.component, {**now.settings, name: best}, now.sensors)
                models = [changed if i == number else a for i, a in enumerate(state.adopted)]
                state = joint_state(record, models, how, state.theta)
        # one setting of a kind rests at once; of two, one moves as the other does
        if not moved or len({a.name for a in state.adopted}) == len(state.adopted):
            break
    return state


def _sought_anew(state: State, number: int, name: str) -> float:
    """A setting of one of the adopted models near where it is, by what the model explains beside the others."""
    now = state.adopted[number]
    own = _slices(state)[number]
    assert state.terms is not None
    mine = state.terms.only(range(own.start, own.stop))
    others = [i for i in range(state.terms.count) if not own.start <= i < own.stop]
    back = put_back(state.residual, mine, state.theta[number])
    score = Scorer(back, state.terms.only(others) if others else None, state.colours)

    def gain(value: float) -> float:
        changed = Adopted(now.component, {**now.settings, name: value}, now.sensors)
        return score(changed.terms(state.excitation).at(state.residual.samples))

    here = float(now.settings[name])
    return golden(gain, here * (1 - POLISH), here * (1 + POLISH), here)


def with_lines(state: State, record: Record, lines: Sequence[float] | None = None) -> State:
    """The state, its excitation knowing the strongest lines in the spectrum of what is left, or those given."""
    if lines is None:
        lines = [f for f, _, _ in spectral_lines(state.residual, record.time[state.residual.samples])]
    return replace(state, excitation=replace(state.excitation, lines=tuple(lines)))


def _slices(state: State) -> list[slice]:
    edges = np.cumsum([0, *(len(t) for t in state.theta)])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]


def _significance(state: State, chosen: Sequence[int]) -> float:
    """P value of some of the adopted coefficients, the others free: of the residual with their part put back."""
    assert state.terms is not None
    return family_p(_blocks(state), state.terms.sensors, list(chosen))


def _blocks(state: State, colours: Colours | None = None) -> Grams:
    """Of the adopted terms and the residual with their part put back, in the finest blocks, in noise of its own colour
    or another."""
    from magtensor.loop.assessment import block_count
    from magtensor.loop.evidence import grams

    assert state.terms is not None
    back = put_back(state.residual, state.terms, np.concatenate(state.theta))
    noise = colours or state.colours
    return grams(back, state.terms, noise.across, noise.along, block_count(len(state.residual.affine)))


def removal(state: State, index: int) -> tuple[float, float]:
    """Held-out rms of the residual in nT, all noise alike, without and with one of the adopted models, the others in
    both."""
    assert state.terms is not None
    part, order = _slices(state)[index], np.arange(state.terms.count)
    others = (order < part.start) | (order >= part.stop)
    before, after = held_out_gain(_blocks(state, WHITE), state.residual.freedom, others).rms
    return before * state.residual.scale, after * state.residual.scale


def put_back(residual: Residual, terms: Terms, theta: Array) -> Residual:
    """The residual as it would be without the correction, to first order."""
    from magtensor.loop.residual import taken_off

    return taken_off(residual, terms, -theta)


def _sensors_showing(state: State, which: int) -> tuple[str, ...] | None:
    """Sensors whose own coefficients are significant; None where all are, or the model is not of single sensors."""
    part = _slices(state)[which]
    assert state.terms is not None
    owners = state.terms.sensors[part]
    names = [s for s in state.excitation.sensors if s in owners]
    if len(names) < 2:
        return None
    showing = [
        s
        for s in names
        if _significance(state, [part.start + i for i, o in enumerate(owners) if o == s]) < KEEP_ALPHA / len(names)
    ]
    return tuple(showing) if showing and len(showing) < len(names) else None


def _eliminate(record: Record, state: State, how: Fitting, fixed: int) -> tuple[State, tuple[str, ...]]:
    """Drop models that no longer earn their place, the weakest first: those that are not significant beside the others,
    and those without which the others predict held-out blocks as well, or much better if all noise counts alike."""
    dropped: list[str] = []
    while len(state.adopted) > max(fixed, 1):
        assert state.terms is not None
        blocks, freedom = _blocks(state), state.residual.freedom
        parts = _slices(state)[fixed:]
        values = [family_p(blocks, state.terms.sensors, list(range(p.start, p.stop))) for p in parts]
        order = np.arange(state.terms.count)
        gains = [held_out_gain(blocks, freedom, (order < p.start) | (order >= p.stop)).total for p in parts]
        rises = [after / before for before, after in (removal(state, fixed + i) for i in range(len(parts)))]
        if max(values) >= KEEP_ALPHA:
            weakest = fixed + int(np.argmax(values))
        elif min(gains) <= 0:
            weakest = fixed + int(np.argmin(gains))
        elif max(rises) > 1.0 + WORST_RISE:
            weakest = fixed + int(np.argmax(rises))
        else:
            break
        dropped.append(state.adopted[weakest].name)
        rest = [i for i in range(len(state.adopted)) if i != weakest]
        state = joint_state(record, [state.adopted[i] for i in rest], how, [state.theta[i] for i in rest])
    return state, tuple(dropped)
