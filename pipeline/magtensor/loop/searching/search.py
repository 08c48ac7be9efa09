"""The search: screen every error model, adopt what the data want on blocks the fit has not seen, refit, repeat.

An effect is adopted only when it passes two independent gates: significance that autocorrelation cannot fake, with the
family-wise error held by Holm's rule over every model and every setting tried, and a gain on held-out contiguous folds.
Rivals that do as well on this survey are named, and the simplest of them is adopted. In the end what was adopted is
weighed against what stays unexplained.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from magtensor.calibration.joint_together import ABOUT, among_their_like
from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.needs import in_words, missing
from magtensor.errors import DataError
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State, of_the_site
from magtensor.loop.fitting.refit import joint_state, loud_stretches, require_more_than_a_constant, settled
from magtensor.loop.fitting.trial import on_the_folds_of, trial
from magtensor.loop.fitting.wandering import all_noise, narrowed_to, of_sensors, quieter, unweighed
from magtensor.loop.remainder.flagged import lasting
from magtensor.loop.searching.contribution import borne_out, eliminate, over_at_once, possible_without
from magtensor.loop.searching.found import Ended, Search, Step
from magtensor.loop.searching.gates import ALPHA
from magtensor.loop.searching.latent import NAME, of_every_sensor, renewed, sought
from magtensor.loop.searching.on_fewer_sensors import on_those_that_show
from magtensor.loop.searching.on_more_sensors import in_the_place_of_others
from magtensor.loop.searching.overshadowed import overshadowed
from magtensor.loop.searching.rounds import Rounds, with_lines
from magtensor.loop.searching.strong_event import begun_with

MOST_EFFECTS = 8


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
    first = joint_state(record, declared, how)
    rounds = Rounds(models, len(declared), most_effects, alpha, lines, say)
    strong = how.nominal is not None and most_effects > 0
    begun = begun_with(record, models, first, how, alpha) if strong else None
    if begun is None:
        require_more_than_a_constant(record, how)
        ended = rounds.run(record, first, how)
    else:
        ended = rounds.run(record, begun.state, begun.how)
        ended = replace(ended, steps=(begun.step, *ended.steps))
    ended = _without_what_is_loud(ended, rounds)
    if len(ended.state.adopted) - len(declared) < most_effects:
        ended = _without_what_is_wrong(ended, rounds)
        if ended.how.nominal is None:
            ended = _without_those_that_wander(ended, rounds)
    record, state, how, steps = ended.record, ended.state, ended.how, ended.steps
    shown = on_those_that_show(record, state, how, len(declared))
    if shown is not state:  # of a law that came later the others may have hidden a part
        standing = trial(record, shown, how)
        standing, gone = in_the_place_of_others(record, standing, how, range(len(declared), len(shown.adopted)))
        shown, steps = standing.state, _with_dropped(steps, gone)
    last = ended.settled if shown is state else settled(record, shown, how)
    over = any(over_at_once(last, place) for place in range(len(declared), len(last.adopted)))
    fewer = bool((state.fit.keep & ~last.fit.keep).any())
    if over or fewer:  # what only these samples asked for goes with them
        last, steps = _weighed_once_more(record, last, steps, how, len(declared))
    shared = ended.shared
    if shared is None or fewer or last is not ended.settled:
        shared = sought(last, record)
    evenly = unweighed(record, last, how)
    not_tested = _not_tested(last.excitation, models)
    found = Search(first, last, steps, not_tested, rounds.failed, record, shared, how, evenly)
    while doubted := overshadowed(found, len(declared)):
        rest = _taken_out(found, rounds, *doubted)
        if rest is None:
            break
        found = rest
    return found


def _taken_out(found: Search, rounds: Rounds, places: Sequence[int], why: str) -> Search | None:
    """The search without the models at some places, for a reason; None where no fit without them is possible."""
    how, fixed, name = found.how, rounds.fixed, found.last.adopted[places[0]].name
    bare = replace(found.record, waveform=None) if name == NAME else found.record
    rest = possible_without(bare, found.last, places, how)
    if rest is None:
        return None
    rounds.tell(f"taking {name} out again")
    record, state = renewed(bare, rest, how)
    state, steps = _weighed_once_more(record, state, found.steps, how, fixed)
    state, dropped = borne_out(record, state, how, fixed)
    state = with_lines(state, record, rounds.lines)
    step = Step(state, tuple(rounds.candidates(state, record, how)), None, refused={name: why}, dropped=dropped)
    source = None if name == NAME else rounds.with_source(record, state, how, step, sought(state, record))[1]
    if source is not None:  # which the model that is gone was a part of
        record, state, step = source
    last = settled(record, state, how)
    return replace(
        found, last=last, steps=(*steps, step), not_tested=_not_tested(last.excitation, rounds.models), record=record,
        shared=sought(last, record), evenly=unweighed(record, last, how),
    )  # fmt: skip


def _without_what_is_loud(ended: Ended, rounds: Rounds) -> Ended:
    """The search gone on without the samples whose noise is so much louder than that of the others that these are
    better off alone; as it ended where there are none, or where what was adopted is shown there only."""
    if ended.how.nominal is not None:
        return ended
    loud = loud_stretches(ended.record, ended.settled, ended.how)  # what nothing explains spoils what is left elsewhere
    if not loud:
        return ended
    how = replace(ended.how, without=loud)
    try:
        state = joint_state(ended.record, ended.state.adopted, how, ended.state.theta, ended.state.lines)
    except DataError:  # the others do not determine a calibration by themselves
        return ended
    again = replace(rounds, whole=ended.state).run(ended.record, state, how)
    return replace(again, steps=(*ended.steps, *again.steps))


def _without_what_is_wrong(ended: Ended, rounds: Rounds) -> Ended:
    """The search gone on without the stretches that it believed and nothing has explained, where more than `ABOUT`
    samples are of such: a sensor that is wrong by far hides what all show. As it ended where nothing more is found."""
    wrong = lasting(among_their_like(~np.asarray(ended.settled.fit.keep)), longest=ABOUT)
    if np.count_nonzero(wrong & ended.state.fit.keep) <= ABOUT:
        return ended
    again = replace(rounds, whole=ended.state).run(ended.record, ended.settled, replace(ended.how, searching=False))
    return replace(again, steps=(*ended.steps, *again.steps)) if again.adopts else ended


def _without_those_that_wander(ended: Ended, rounds: Rounds) -> Ended:
    """The search gone on among the quiet sensors alone; what they show is then fitted on all sensors, each weighed by
    all of its noise, and the search goes on there. Where they show nothing more, C and o are fitted with these weights
    all the same: they would have a share of what is not theirs."""
    wandering = False
    for names in quieter(ended.settled):  # what is flagged is no wandering
        wandering = True
        try:
            gone_on = _among(names, ended, rounds)
        except DataError:  # they do not determine a calibration by themselves
            continue
        if gone_on is not None:
            return gone_on
    if not wandering:
        return ended
    how = replace(ended.how, noise=all_noise(ended.settled))
    again = joint_state(ended.record, ended.state.adopted, how, ended.state.theta, ended.state.lines)
    return replace(ended, state=again, how=how, shared=None)


def _among(names: tuple[str, ...], ended: Ended, rounds: Rounds) -> Ended | None:
    """The search gone on with what some of the sensors show by themselves; None where that is nothing, or where it does
    not help when all are fitted.

    What nothing has explained so far is no longer believed to be an effect.
    """
    how, lines = replace(ended.how, searching=False), ended.state.lines
    some = of_sensors(ended.record, names)
    models, theta = narrowed_to(ended.state.adopted, ended.state.theta, ended.state, names)
    among = replace(rounds, fixed=len(models), most_effects=rounds.most_effects - len(models) + rounds.fixed)
    found = among.run(some, joint_state(some, models, how, theta, lines), how)
    if not found.adopts:
        return None
    new = slice(len(models), None)
    more, values = narrowed_to(found.state.adopted[new], found.state.theta[new], found.state, names)
    for i, model in enumerate(more):
        if model.name == NAME:
            more[i], values[i] = of_every_sensor(model, values[i], ended.state)
    every, start = [*ended.state.adopted, *more], [*ended.state.theta, *values]
    record = replace(ended.record, waveform=found.record.waveform)
    how = replace(ended.how, noise=all_noise(joint_state(record, every, how, start, lines)))
    before = trial(record, joint_state(record, ended.state.adopted, how, ended.state.theta, lines), how)
    after = trial(record, joint_state(record, every, how, start, lines), how)
    if on_the_folds_of(after, record, before, how).hurt_by(after) or not before.likelier(after):
        return None
    again = rounds.run(record, after.state, how)
    steps = tuple(replace(step, among=names) for step in found.steps)
    return replace(again, steps=(*ended.steps, *steps, *again.steps))


def _weighed_once_more(
    record: Record, state: State, steps: tuple[Step, ...], how: Fitting, fixed: int
) -> tuple[State, tuple[Step, ...]]:
    """A fit in which samples or models are missing that were there when the others were adopted, without those that no
    longer earn their place; and the rounds, which say so."""
    left, dropped = eliminate(record, state, how, fixed)
    return (settled(record, left, how), _with_dropped(steps, dropped)) if dropped else (state, steps)


def _with_dropped(steps: tuple[Step, ...], names: tuple[str, ...]) -> tuple[Step, ...]:
    """The rounds, the last of which says that models were dropped."""
    return (*steps[:-1], replace(steps[-1], dropped=(*steps[-1].dropped, *names))) if names else steps


def _require_channels(x: Excitation, declared: Sequence[Adopted]) -> None:
    """A declared error model needs its channels.

    Raises
    ------
    DataError: the survey lacks some.
    """
    words = [
        f"{model.name} needs {' and '.join(map(in_words, lacks))}"
        for model in declared
        if (lacks := missing(model.component, x))
    ]
    if words:
        logs = ", ".join(sorted(x.logged)) or "no channel"
        raise DataError(
            f"the declared error models cannot be fitted to this survey: {'; '.join(words)}",
            hint=f"the survey logs {logs}; leave the model out or log what it follows",
        )


def _not_tested(x: Excitation, models: Sequence[Component]) -> dict[str, tuple[str, ...]]:
    """What each of the other models lacks; of a source that nobody logged the loop asks in its own way."""
    lacking = {model.name: tuple(missing(model, x)) for model in models if model.name != NAME}
    return {name: lacks for name, lacks in lacking.items() if lacks}
