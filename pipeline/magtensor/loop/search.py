"""The search: screen every error model, adopt what the data want on blocks the fit has not seen, refit, repeat.

An effect is adopted only when it passes two independent gates: significance that autocorrelation cannot fake, with the
family-wise error held by Holm's rule over every model and every setting tried, and a gain on held-out contiguous folds.
Rivals that do as well on this survey are named, and the simplest of them is adopted. In the end what was adopted is
weighed against what stays unexplained.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from magtensor.components import Component
from magtensor.errors import DataError
from magtensor.loop.adopting import adopt, narrowed, on_those_that_show, polished
from magtensor.loop.changing_matrix import channel_instead
from magtensor.loop.contribution import agrees, eliminate, happens_once, of_all_alike, without_models
from magtensor.loop.exchange import looked_at_again, simpler
from magtensor.loop.excitation import Excitation
from magtensor.loop.found import Search, Step
from magtensor.loop.gates import ALPHA, Candidate
from magtensor.loop.latent import NAME, SINGLE_STRETCH, Sought, Source, renewed, sought, tried_source
from magtensor.loop.log_noise import channels_of
from magtensor.loop.model import Adopted, Fitting, Record, State, generic, joint_state, of_the_site
from magtensor.loop.needs import missing
from magtensor.loop.overshadowed import overshadowed
from magtensor.loop.own_fit import at_their_own_fit
from magtensor.loop.profiling import already, repeatable
from magtensor.loop.rivals import containing, hardly_begun, simplest
from magtensor.loop.screening import candidates_of
from magtensor.loop.spectrum import spectral_lines
from magtensor.loop.trial import Trial, on_the_folds_of, per_sample, trial

MOST_EFFECTS = 8
ROUNDING = 1e-4  # mean square of the whitened residual: far below the least noise that any sensor is believed to have


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
        sources = [d for d in declared if of_the_site(d.component)]
        _require_channels(joint_state(record, [], how).excitation, sources or declared)
        if sources:  # a gradient is known with them
            _require_channels(joint_state(record, sources, how).excitation, declared)
    state = first = joint_state(record, declared, how)
    hidden = next((m for m in models if m.name == NAME), None)
    shared: Sought | None = None
    standing = trial(record, first, how)
    steps: list[Step] = []
    failed: dict[str, str] = {}
    asked = False  # whether something simpler does as well
    for _ in range(most_effects + 2):
        state = with_lines(state, record, lines)
        testable = _testable(state.excitation, models)
        if len(state.adopted) - len(declared) >= most_effects or state.residual.square() < ROUNDING:
            break
        candidates = candidates_of(state, open_models(testable, state), failed, alpha)
        candidates = at_their_own_fit(candidates, record, state, how)
        adopted = _first_kept(record, standing, candidates, how, len(declared), say)
        steps.append(Step(state, tuple(candidates), *adopted.step))
        if adopted.standing is not None:
            record, state = renewed(record, adopted.standing.state, how)
            standing = replace(adopted.standing, state=state)
            continue
        exchanged = None if asked else _exchanged(record, state, steps, how, len(declared), len(testable))
        asked = True
        if exchanged is not None:
            after, step = exchanged
            if say is not None and step.adopted is not None:
                say(f"{step.adopted.model.name} takes the place of {', '.join(step.refused)}")
            steps[-1] = step
            record, state = renewed(record, after.state, how)
            standing = replace(after, state=state)
            continue
        shared = sought(state, record)
        if shared is None or hidden is None or NAME in {a.name for a in state.adopted}:
            break
        shared, source = tried_source(hidden, record, state, shared, how, alpha)
        instead = None
        if source is None and shared.left_by:
            instead = shared.left_by
            source = _source_instead(hidden, record, state, shared, how, len(declared), alpha)
        if source is None:
            break
        if say is not None:
            say(f"adopting {NAME}")
        record, state, shared = source.record, source.after, None
        last, dropped = eliminate(record, state, how, len(declared))
        if dropped and NAME not in dropped:  # what had taken a part of the source for its own
            record, state = renewed(record, last, how)
        gone = (*([instead] if instead else []), *(() if NAME in dropped else dropped))
        steps[-1] = replace(steps[-1], adopted=source.evidence, dropped=gone)
        standing = trial(record, state, how)
    last = _settled(record, on_those_that_show(record, state, how, len(declared)), how)
    if shared is None or shared.objection == SINGLE_STRETCH:  # it may be flagged now
        shared = sought(last, record)
    found = Search(first, last, tuple(steps), _not_tested(last.excitation, models), failed, record, shared)
    while doubted := overshadowed(found, len(declared)):
        places, why = doubted
        name = found.last.adopted[places[0]].name
        if say is not None:
            say(f"taking {name} out again")
        record, state = renewed(record, without_models(record, found.last, places, how), how)
        state = with_lines(state, record, lines)
        candidates = candidates_of(state, open_models(_testable(state.excitation, models), state), failed, alpha)
        candidates = at_their_own_fit(candidates, record, state, how)
        steps.append(Step(state, tuple(candidates), None, refused={name: why}))
        last = _settled(record, state, how)
        not_tested = _not_tested(last.excitation, models)
        found = replace(
            found, last=last, steps=tuple(steps), not_tested=not_tested, record=record, shared=sought(last, record)
        )
    return found


def _exchanged(
    record: Record, state: State, steps: Sequence[Step], how: Fitting, fixed: int, models: int
) -> tuple[Trial, Step] | None:
    """The fit with a simpler model in the place of an adopted one that it does as well as, and the round's story."""
    found = simpler(state, steps, fixed)
    if found is None:
        return None
    place, other = found
    old = state.adopted[place].name
    without = without_models(record, state, [place], how)
    chosen = looked_at_again(without, other, models)
    if chosen is None:
        return None
    after, _ = _kept(record, trial(record, without, how), chosen, how)
    if after is None:
        return None
    why = f"{chosen.model.name}, which has fewer coefficients, does as well beside the others"
    return after, Step(without, (chosen,), chosen, (old,), refused={old: why})


def _source_instead(
    component: Component, record: Record, state: State, left: Sought, how: Fitting, fixed: int, alpha: float
) -> Source | None:
    """A source nobody logged in the place of the adopted effect that has the same vectors at the sensors: of something
    that switches now and then a single step is a part, and so is what channels show that feel it late. None where it
    does not do better.

    Parameters
    ----------
    left: what the effect leaves.
    """
    places = [i for i, a in enumerate(state.adopted) if a.name == left.left_by and i >= fixed]
    if not places:
        return None
    less = without_models(record, state, places, how)
    tried = left.significant and all(generic(state.adopted[i]) for i in places)
    shared = sought(less, record, may_follow=tried)
    source = None if shared is None else tried_source(component, record, less, shared, how, alpha)[1]
    if source is None or source.after.fit.keep.sum() < state.fit.keep.sum():
        return None
    return source if per_sample(source.after) > per_sample(state) else None


def _settled(record: Record, state: State, how: Fitting) -> State:
    """The fit at the end: what nothing explains is a disturbance after all, and no part of the calibration."""
    return joint_state(record, state.adopted, replace(how, searching=False), state.theta, state.lines)


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
        best = containing(best, possible, before.state)
        chosen, rivals = simplest(best, possible, before.state)
        if say is not None:
            say(f"adopting {chosen.model.name}")
        after, why = _kept(record, before, chosen, how)
        if after is None:
            refused[chosen.model.name] = why
            continue
        last, dropped = eliminate(record, after.state, how, fixed)
        if dropped:
            after = trial(record, last, how)
        if chosen.model.name in dropped and len(last.adopted) <= len(before.state.adopted):
            refused[chosen.model.name] = "fitted, it does not earn its place on held-out blocks"
            continue
        return _Kept(after, chosen, rivals, dropped, refused)
    return _Kept(None, refused=refused)


def _kept(record: Record, before: Trial, chosen: Candidate, how: Fitting) -> tuple[Trial | None, str]:
    """The fit with a model, on fewer sensors where it hurts one that it does not help; None, and why, if it fails."""
    try:
        after = trial(record, polished(record, adopt(record, before.state, chosen, how), how), how)
    except DataError as error:  # with coefficients that run away nothing is left to calibrate
        return None, f"it cannot be fitted: {error.what.split(':')[0]}"
    before = on_the_folds_of(after, record, before, how)
    hurt, which = before.hurt_by(after), len(before.state.adopted)
    if hurt:
        own = after.state.adopted[which].sensors or tuple(record.sensors)
        helped = [s for s in before.helped_by(after) if s in own]
        if helped and set(chosen.terms.sensors) >= set(own):
            after = trial(record, narrowed(record, after.state, which, tuple(helped), how), how)
            before = on_the_folds_of(after, record, before, how)
            hurt = before.hurt_by(after)
    if hurt:
        return None, f"fitted, it raises the held-out error of {', '.join(hurt)}"
    model = after.state.adopted[which]
    acts_on = model.sensors or tuple(record.sensors)
    same = [a for a in after.state.adopted[:which] if set(a.sensors or record.sensors) & set(acts_on)]
    if not channels_of(model, after.state.excitation) and already(same, model.component, model.settings):
        return None, "fitted, its settings are those of what is adopted already"
    slow, channels = hardly_begun(chosen, after.state.excitation), sorted(channels_of(model, after.state.excitation))
    if (slow or channels) and of_all_alike(after.state, which):
        drift = "drifts" if slow else f"follows {' and '.join(channels)}"
        return None, f"fitted, all sensors show it alike: an error of the base station that {drift} would look the same"
    if not agrees(after.state, which):
        return None, "fitted, its coefficients are not what its settings assume"
    if not before.likelier(after):
        return None, "fitted together with the others, it leaves more than it takes away"
    if happens_once(model):
        terms = chosen.terms.only(i for i, s in enumerate(chosen.terms.sensors) if s in acts_on)
        if channel := channel_instead(before.state, terms, chosen.assessment.colours):
            why = f"C of {', '.join(acts_on)} follows {channel}, which explains more than something that happens once"
            return None, why
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


def _testable(x: Excitation, models: Sequence[Component]) -> list[Component]:
    """The models that have what they need, beside what is adopted."""
    return [m for m in models if not missing(m, x)]


def _not_tested(x: Excitation, models: Sequence[Component]) -> dict[str, tuple[str, ...]]:
    """What each of the other models lacks; of a source that nobody logged the loop asks in its own way."""
    lacking = {model.name: tuple(missing(model, x)) for model in models if model.name != NAME}
    return {name: lacks for name, lacks in lacking.items() if lacks}


def open_models(testable: Sequence[Component], state: State) -> list[Component]:
    """Those that are not in already, or can be in more than once."""
    taken = {a.name for a in state.adopted}
    return [m for m in testable if m.name not in taken or repeatable(m)]


def with_lines(state: State, record: Record, lines: Sequence[float] | None = None) -> State:
    """The state, its excitation knowing the strongest lines in the spectrum of what is left, or those given."""
    if lines is None:
        lines = [f for f, _, _ in spectral_lines(state.residual, record.time[state.residual.samples])]
    return replace(state, excitation=replace(state.excitation, lines=tuple(lines)))
