"""What turns with the field faster than it was sampled: a delay, where no rate of change is known well enough to test.

A walk whose steps are as quick as the samples, a tumbling rig read too seldom: an error model that needs the field's
rate of change is not tested then, and a model that remembers the field, whose part that depends on how it turns is
computed from the same samples, would be adopted for what a delay makes. The rate is not known, but roughly: taken as it
comes out, it explains of a true delay more than such a model does, and of what remembers the field less.
"""

from __future__ import annotations

from collections.abc import Sequence

from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.needs import missing
from magtensor.error_models.settings import EventTimes, profiled
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.assessment import estimated_in, explained
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.fitting.model import State
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.profiling import settings_grid, terms_of

NEED = "rotation"
HALF = 0.5


def of_the_rate(x: Excitation, models: Sequence[Component]) -> list[Component]:
    """The lasting error models that lack nothing but a known rate of change; none where it is known."""
    lacking = [] if x.turns else [m for m in models if missing(m, x) == [NEED]]
    return [m for m in lacking if not any(isinstance(grid, EventTimes) for grid in profiled(m).values())]


def rate_instead(chosen: Candidate, state: State, models: Sequence[Component]) -> str:
    """The error model that the survey is sampled too slowly for, but with the rate as it comes out explains more than a
    candidate, which explains less than half of its own part beside it; "" if there is none.

    Parameters
    ----------
    state: without the candidate; models: those of the search.
    """
    if not (lacking := of_the_rate(state.excitation, models)):
        return ""
    seen, colours = chosen.before or state, chosen.assessment.colours  # at the samples of its terms
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
                return model.name
    return ""
