"""What turns with the field faster than it was sampled: a delay, where no rate of change is known well enough to test.

A walk whose steps are as quick as the samples, a tumbling rig read too seldom: an error model that needs the field's
rate of change is not tested then, and a model that remembers the field, whose part that depends on how it turns is
computed from the same samples, would be adopted for what a delay makes. The rate is not known, but roughly: taken as it
comes out, it explains of a true delay more than such a model does, and of what remembers the field less. Nor is the way
seen that an array takes from one posture to the next: what still remembers it while the mean of a posture is taken,
a filter or an eddy current, goes with how this posture differs from the one before, as does all memory that is quicker
than the samples show.
"""

from __future__ import annotations

from collections.abc import Sequence

from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.needs import missing
from magtensor.error_models.settings import EventTimes, Range, profiled
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.assessment import estimated_in, explained
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.fitting.model import State
from magtensor.loop.fitting.separation import SEPARATION, fold_gain, separated
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.profiling import settings_grid, terms_of

NEED = "rotation"
HALF = 0.5
QUICKER = 0.25  # of the shortest time that samples show: next to nothing is remembered but the sample before


def of_the_rate(x: Excitation, models: Sequence[Component]) -> list[Component]:
    """The lasting error models that lack nothing but a known rate of change; none where it is known."""
    lacking = [] if x.turns else [m for m in models if missing(m, x) == [NEED]]
    return [m for m in lacking if not any(isinstance(grid, EventTimes) for grid in profiled(m).values())]


def rate_instead(chosen: Candidate, state: State, models: Sequence[Component]) -> str:
    """Why a candidate is no more than a part of what turns faster than the survey was sampled; "" if it is not.

    An error model that the survey is sampled too slowly for, with the rate as it comes out, explains more, and beside
    it the candidate explains less than half of its own part; or a memory that is quicker than the samples show predicts
    more, and beside it the candidate nothing.

    Parameters
    ----------
    state: without the candidate; models: those of the search.
    """
    if not (lacking := of_the_rate(state.excitation, models)):
        return ""
    seen = chosen.before or state  # at the samples of its terms
    colours = chosen.assessment.colours
    white = Whitened.of(seen.residual, colours.across, colours.along, seen.terms, over_time=False)
    own = explained(estimated_in(white, None)) if seen.terms is not None else 0.0

    def gain(terms: Terms) -> float:
        return explained(estimated_in(white, terms)) - own - terms.count

    alone = gain(chosen.terms)
    for model in lacking:
        for settings in settings_grid(model, seen.excitation):
            terms = terms_of(model, settings, seen.excitation, {})
            if terms is None:
                continue
            terms = terms.at(seen.residual.samples)
            known = gain(terms)
            if known > alone and gain(joined([terms, chosen.terms])) - known < HALF * alone:
                return f"{model.name}, for which the field turns too fast between samples, explains more"
    if name := _quicker(chosen, seen, models):
        others = ", ".join(model.name for model in lacking)
        return (
            f"{name} with a time constant shorter than the samples show predicts as much: something quicker would do, "
            f"as may {others}, which these samples cannot test"
        )
    return ""


def _quicker(chosen: Candidate, state: State, models: Sequence[Component]) -> str:
    """The model whose time constant may not be shorter than the samples show, but with a shorter one is ahead of a
    candidate, or of itself no worse, and leaves it nothing, or less than half of what that is behind by; "" if there
    is none."""
    colours, x = chosen.assessment.colours, state.excitation
    for model in models:
        shorter = {n: QUICKER * g.least(x) for n, g in profiled(model).items() if isinstance(g, Range) and g.sampled}
        terms = terms_of(model, shorter, x, {}) if shorter else None
        if terms is None:
            continue
        terms = terms.at(state.residual.samples)
        quick, own = (fold_gain(state, colours, each) for each in (terms, chosen.terms))
        spare = max(terms.count - chosen.terms.count, 0)
        same = model.name == chosen.model.name
        ahead = quick.over(own).total >= SEPARATION + spare  # in sum: a name has to stand in every fold, a doubt not
        if not (ahead or (same and not separated(own, quick))):
            continue
        beside = fold_gain(state, colours, terms, chosen.terms).over(quick).total  # in sum, too
        if beside < max(SEPARATION, HALF * quick.over(own).total):
            return model.name
    return ""
