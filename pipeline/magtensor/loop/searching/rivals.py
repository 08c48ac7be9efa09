"""Which of the models that a survey does not tell apart is adopted, and which are named as its rivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel, Duration, EventTimes, Range, profiled
from magtensor.error_models.terms import joined
from magtensor.loop.evidence.assessment import estimated, explained
from magtensor.loop.fitting.model import Adopted, State, generic
from magtensor.loop.fitting.separation import SECOND_ORDER, SEPARATION, fold_gain, separated
from magtensor.loop.searching.beginnings import beginning
from magtensor.loop.searching.contribution import happens_once
from magtensor.loop.searching.gates import OF_THE_LAW, Candidate, explained_by
from magtensor.loop.searching.several_logs import worse_log

SMALL_PART = 0.5  # less than half is no rival: something else is the cause of most of it
SLOW = 0.5  # of the survey: a longer lag is no better known than a drift


def simplest(best: Candidate, possible: Sequence[Candidate], state: State) -> tuple[Candidate, tuple[str, ...]]:
    """The simplest of the models that the held-out blocks do not separate from the best, and the others' names.

    Nor are two told apart by less than the next order of what both explain, a channel that nobody wrote a model for
    from the model that names its effect by less than that one's law may miss, and two logs of one cause by the noise of
    the worse one. What a response began with was fitted to all blocks, of which none was held out for it: from a model
    that needs none it is told apart by the likelihood of all of them.

    Simplest is more of what was adopted already, with another setting; then what has the fewest coefficients, what it
    began with among them, and of those what lasts. A response that no model names comes after these, and one that lags
    by half the survey or longer after all: a channel seen through such a lag is whatever it should be, and what settles
    as slowly is a drift, but would begin anew with every survey. A model that slow noise could explain is named, and
    not chosen before one that it could not.
    """
    colours = best.assessment.colours
    parts = best.assessment.parts
    reference = fold_gain(best.before or state, colours, best.terms, parts=parts)
    equal: list[Candidate] = [best]
    for other in possible:
        if other is best:
            continue
        spare = max(other.assessment.estimate.rank - best.assessment.estimate.rank, 0)
        found = fold_gain(other.before or state, colours, other.terms, parts=parts)
        named = generic(best.model) and not generic(other.model) and _channel(best) == _channel(other)
        behind = reference.over(found).total
        alike = behind <= (OF_THE_LAW if named else SECOND_ORDER) * reference.total
        alike = alike or (begun(best) > begun(other) and _as_likely(best, other, state))
        if alike or not separated(reference, found, spare) or worse_log(best, other, behind, state):
            equal.append(other)
    known = {a.name for a in state.adopted}

    def complexity(c: Candidate) -> tuple[bool, bool, bool, int, bool, float]:
        slow = hardly_begun(c.model, state.excitation) or still_settling(c.model, state.excitation)
        new, once = c.model.name not in known, happens_once(c.model)
        return slow, generic(c.model), new, c.assessment.estimate.rank + begun(c), once, -c.assessment.gain.total

    chosen = min((c for c in equal if c is best or c.passes), key=complexity)
    chosen = lasting_instead(chosen, possible)
    rivals = {c.model.name for c in equal if c is not chosen}
    return chosen, tuple(sorted(rivals - {chosen.model.name}))


def by_a_worse_log(chosen: Candidate, others: Sequence[Candidate], state: State) -> set[str]:
    """Names of the models that have the vectors of the chosen one, and are behind it by the noise of their logs."""
    others = [c for c in others if c.model.name != chosen.model.name]
    if not others:
        return set()
    colours, parts = chosen.assessment.colours, chosen.assessment.parts
    reference = fold_gain(chosen.before or state, colours, chosen.terms, parts=parts)

    def behind(other: Candidate) -> float:
        return reference.over(fold_gain(other.before or state, colours, other.terms, parts=parts)).total

    return {c.model.name for c in others if worse_log(chosen, c, behind(c), state)}


def hardly_less(chosen: Candidate, dropped: Sequence[str], state: State) -> set[str]:
    """Names of the adopted models in whose place a candidate was kept for no more than the next order of what each of
    them explains: the law of any of these may miss as much."""
    gain, seen = chosen.assessment.gain.total, chosen.before or state
    names = [a.name for a in seen.adopted]
    gone = {names.index(name): name for name in dropped if name in names}
    return {name for place, name in gone.items() if gain <= SECOND_ORDER * explained_by(seen, [place])}


def containing(best: Candidate, possible: Sequence[Candidate], state: State) -> Candidate:
    """The best of the models that predict more and leave `best` nothing to predict; `best` where there is none.

    Slow noise could explain such a model, but not `best`, which is a part of what it explains: a drift, say, that is
    more than a warming up.
    """
    more = [c for c in possible if c.assessment.gain.total > best.assessment.gain.total + SEPARATION]
    for other in sorted(more, key=lambda c: -c.assessment.gain.total):
        colours = other.assessment.colours
        before, parts = other.before or state, best.assessment.parts
        alone = fold_gain(before, colours, other.terms, parts=parts)
        if fold_gain(before, colours, other.terms, best.terms, parts=parts).total - alone.total < SEPARATION:
            return other
    return best


def as_predictive(chosen: Candidate, candidates: Sequence[Candidate], state: State) -> set[str]:
    """Names of the models that predict held-out blocks as well as the chosen one and leave it next to nothing, though
    they are not significant for all that was tried of them.

    What has few settings needs less correction for them, and is significant first, whatever the cause: a base station's
    variation that is larger than the site's before a jump of it, which may have been at any time; a supply's voltage
    before a temperature that may act late.
    """

    def does_as_well(other: Candidate) -> bool:
        if other.significant or not other.assessment.gain.consistent:
            return False
        whole, own, both = _beside(chosen, other, state)
        return own - whole < SEPARATION and both - whole < SMALL_PART * own

    return {c.model.name for c in candidates if c.model.name != chosen.model.name and does_as_well(c)}


def hindered_by_another(best: Candidate | None, candidates: Sequence[Candidate], state: State) -> Candidate | None:
    """Of the candidates that another effect, which has no name yet, may keep from passing, the best; None where the
    best of those that pass predicts more, or something else."""
    hindered = max((c for c in candidates if c.may_be_hindered), key=lambda c: c.assessment.gain.total, default=None)
    if hindered is None or best is None:
        return hindered
    more = hindered.assessment.gain.total > best.assessment.gain.total + SEPARATION
    return hindered if more and overlaps(best, hindered, state) else None


def part_of(candidate: Candidate, other: Candidate, state: State) -> bool:
    """Whether a candidate predicts a small part of what another one does, and next to nothing beside it."""
    whole, own, both = _beside(candidate, other, state)
    return own < SMALL_PART * whole and both - whole < SMALL_PART * own


def overlaps(candidate: Candidate, other: Candidate, state: State) -> bool:
    """Whether most of what a candidate predicts another one does."""
    whole, own, both = _beside(candidate, other, state)
    return both - whole < SMALL_PART * own


def stands_for_less(candidate: Candidate, other: Candidate, state: State) -> bool:
    """Whether most of what a candidate predicts another one does, which predicts more: it is not what acts."""
    whole, own, both = _beside(candidate, other, state)
    return own < whole - SEPARATION and both - whole < SMALL_PART * own


def part_of_a_drift(candidate: Candidate, candidates: Sequence[Candidate], state: State) -> Candidate | None:
    """A model of what lasts that predicts as much as a candidate of what happened once, and leaves it next to nothing;
    None where there is none.

    A drift is judged by the scatter of long blocks, which tells little of it, and something that happened once is not.
    Where a drift predicts more on blocks that neither has seen, the event is the place where it is steepest. So a drift
    that predicts unevenly counts as well, if slow noise does not explain it.
    """
    if not happens_once(candidate.model):
        return None
    for other in candidates:
        gain = other.assessment.gain
        if happens_once(other.model) or generic(other.model):
            continue
        if not gain.consistent and other.adjusted_null_p >= other.alpha:
            continue
        whole, own, both = _beside(candidate, other, state)
        if own > whole and not worse_log(candidate, other, _ahead(candidate, other, state), state):
            continue
        if both - whole < SMALL_PART * own:
            return _judged_by_its_part(other, candidate, state)
    return None


def events_like(lasting: Candidate, events: Sequence[Candidate], state: State) -> set[str]:
    """Names of those events, each a part of what lasts, that the data do not tell from it."""

    def predicts_as_much(event: Candidate) -> bool:
        whole, own, _ = _beside(event, lasting, state)
        return own > whole - SEPARATION

    return {event.model.name for event in events if predicts_as_much(event)}


def _judged_by_its_part(lasting: Candidate, event: Candidate, state: State) -> Candidate:
    """What lasts and follows a channel, as it stands beside an event that passes and is a part of it: judged on the
    event's own folds. Of a drift the event says no more than that something moved."""
    if not lasting.model.channels(state.excitation):
        return lasting
    found, parts, before = lasting.assessment, event.assessment.parts, lasting.before or state
    gain, null_gain = (fold_gain(before, c, lasting.terms, parts=parts) for c in (found.colours, before.colours))
    return replace(lasting, of_an_event=True, assessment=replace(found, parts=parts, gain=gain, null_gain=null_gain))


def _beside(candidate: Candidate, other: Candidate, state: State) -> tuple[float, float, float]:
    """What another model, a candidate and both together predict, in noise of the colour that the other leaves."""
    each = ([other.terms], [candidate.terms], [other.terms, candidate.terms])
    colours, parts = other.assessment.colours, candidate.assessment.parts
    whole, own, both = (fold_gain(state, colours, *terms, parts=parts).total for terms in each)
    return whole, own, both


def _ahead(candidate: Candidate, other: Candidate, state: State) -> float:
    """By how much a candidate predicts more than another model, in noise of the colour that the candidate leaves: what
    the other leaves may be far louder, and then the candidate seems hardly ahead."""
    colours, parts = candidate.assessment.colours, candidate.assessment.parts
    own, its = (fold_gain(state, colours, terms, parts=parts).total for terms in (candidate.terms, other.terms))
    return own - its


def begun(candidate: Candidate) -> int:
    """With how many values a response began out of equilibrium."""
    found = beginning(candidate.model.component, candidate.model.settings)
    return sum(bool(candidate.model.settings[name]) for name in found[0]) if found else 0


def _as_likely(best: Candidate, other: Candidate, state: State) -> bool:
    """Whether another model explains as much as the best one, on all blocks together."""

    def whole(c: Candidate) -> float:
        before = c.before or state
        together = c.terms if before.terms is None else joined([before.terms, c.terms])
        return explained(estimated(before.residual, together, best.assessment.colours.among(before.residual)))

    return whole(best) - whole(other) < SEPARATION


def lasting_instead(chosen: Candidate, possible: Sequence[Candidate]) -> Candidate:
    """What lasts in the place of something that happens once, if it predicts more with no more coefficients.

    A slip soon after the start is a delay for all but the first samples: the few blocks that it misses scatter what it
    is behind by, so that it seems no worse than the best, from which the delay itself is told apart.
    """
    if not happens_once(chosen.model):
        return chosen
    better = [
        c
        for c in possible
        if c.passes
        and not happens_once(c.model)
        and not generic(c.model)
        and c.assessment.estimate.rank <= chosen.assessment.estimate.rank
        and c.assessment.gain.total > chosen.assessment.gain.total
    ]
    return max(better, key=lambda c: c.assessment.gain.total, default=chosen)


def hardly_begun(model: Adopted, x: Excitation, share: float = SLOW) -> bool:
    """Whether a response lags by a share of the survey or more: from a half on what it followed was over before it
    began, and a channel seen through such a lag can be any drift."""
    found = beginning(model.component, model.settings)
    return found is not None and float(model.settings[found[1].lag]) > share * x.duration


def still_settling(model: Adopted, x: Excitation) -> bool:
    """Whether what began with the survey settles with half of it or longer: it is a drift as much."""
    marks = profiled(model.component)
    if any(isinstance(mark, (Duration, EventTimes)) for mark in marks.values()):
        return False
    of_time = [name for name, mark in marks.items() if isinstance(mark, Range) and mark.of_duration]
    return any(float(model.settings[name]) > SLOW * x.duration for name in of_time)


def _channel(candidate: Candidate) -> str:
    """The channel that a model follows; "" where it follows none."""
    settings, marks = candidate.model.settings, profiled(candidate.model.component).items()
    return next((str(settings[name]) for name, mark in marks if isinstance(mark, AnyChannel)), "")
