"""What was adopted first, asked for once more when the rest is known.

While other effects have no name yet, the model with more coefficients follows a part of them, and held-out blocks bear
it out: a source near the rig explains more than a gradient of the site beside a nonlinearity that nobody has added.
Beside all that was adopted later one with fewer coefficients may do as well; then it takes its place.
"""

from __future__ import annotations

from collections.abc import Sequence

from magtensor.loop.fitting.model import State, generic
from magtensor.loop.fitting.separation import fold_gain, separated
from magtensor.loop.searching.contribution import put_back_one, slices
from magtensor.loop.searching.found import Step
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.rivals import hardly_begun
from magtensor.loop.searching.screening import candidates_of


def simpler(state: State, steps: Sequence[Step], fixed: int) -> tuple[int, Candidate] | None:
    """The place of an adopted model, not of the first ones, and one with fewer coefficients that passed in the same
    round and beside all others predicts held-out blocks as well; None where every model is the simplest."""
    names = {a.name for a in state.adopted}
    for place in range(fixed, len(state.adopted) - 1):  # beside the last nothing is new
        own = slices(state)[place]
        step = next((s for s in steps if s.adopted and s.adopted.model.name == state.adopted[place].name), None)
        if step is None:
            continue
        fewer = (c for c in step.candidates if c.passes and c.terms.count < own.stop - own.start)
        for other in sorted(fewer, key=lambda c: c.terms.count):
            # what lags by half the survey can be any drift, and is simpler than none
            known = other.model.name not in names and not hardly_begun(other.model, state.excitation)
            if known and not generic(other.model) and _as_good(state, place, other):
                return place, other
    return None


def _as_good(state: State, place: int, other: Candidate) -> bool:
    """Whether held-out blocks do not tell an adopted model from another one beside the rest of them."""
    assert state.terms is not None
    own = slices(state)[place]
    mine = state.terms.only(range(own.start, own.stop))
    without = put_back_one(state, place)
    theirs = other.model.terms(state.excitation).at(state.residual.samples)
    best, found = (fold_gain(without, state.colours, terms) for terms in (mine, theirs))
    return not separated(best, found)


def looked_at_again(state: State, other: Candidate, models: int) -> Candidate | None:
    """A candidate of an earlier round as it stands beside other models, one of so many; None where it fails now."""
    found = candidates_of(state, [other.model.component], {}, other.alpha)
    if not found:
        return None
    again = found[0].among(models)
    return again if again.passes else None
