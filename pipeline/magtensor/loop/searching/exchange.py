"""What was adopted first, asked for once more when the rest is known.

While other effects have no name yet, the model with more coefficients follows a part of them, and held-out blocks bear
it out: a source near the rig explains more than a gradient of the site beside a nonlinearity that nobody has added.
Beside all that was adopted later one with fewer coefficients may do as well, and one that was refused for it may be
seen to do better; then it takes its place. A course of time that only made up for settings of the others, not
found yet then, goes too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from magtensor.error_models.settings import Range, profiled
from magtensor.errors import DataError
from magtensor.loop.fitting.model import Fitting, Record, State, generic
from magtensor.loop.fitting.separation import fold_gain, separated
from magtensor.loop.fitting.trial import Trial, on_the_folds_of, per_sample, trial
from magtensor.loop.searching.adopting import polished
from magtensor.loop.searching.beginnings import lags
from magtensor.loop.searching.contribution import (
    KEEP_ALPHA,
    happens_once,
    possible_without,
    put_back_one,
    slices,
    without_models,
)
from magtensor.loop.searching.course_of_time import beside_time
from magtensor.loop.searching.found import Step
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.keeping import fitted
from magtensor.loop.searching.kin import TIME, drivers
from magtensor.loop.searching.rivals import hardly_begun
from magtensor.loop.searching.screening import candidates_of


@dataclass(frozen=True)
class Exchange:
    """A model to take the place of an adopted one.

    Attributes:
        place: of the adopted one; other: the model, as it was looked at in the round of that one.
        better: whether it predicts better; it does as well with fewer coefficients if not.
        fewer: whether it has fewer coefficients.
    """

    place: int
    other: Candidate
    better: bool
    fewer: bool

    @property
    def why(self) -> str:
        """Why the adopted one has to go."""
        name = self.other.model.name
        if self.better:
            return f"{name}, which passed too, predicts held-out blocks better beside the others"
        return f"{name}, which has fewer coefficients, does as well beside the others"


def exchange(state: State, steps: Sequence[Step], fixed: int) -> Exchange | None:
    """One for an adopted model, not of the first ones, by what passed in the same round, has no more coefficients, and
    beside all others predicts held-out blocks as well with fewer of them, or better; None where every model is the one
    to have."""
    names = {a.name for a in state.adopted}
    for place in range(fixed, len(state.adopted) - 1):  # beside the last nothing is new
        own = slices(state)[place]
        size = own.stop - own.start
        step = next((s for s in steps if s.adopted and s.adopted.model.name == state.adopted[place].name), None)
        if step is None:
            continue
        # what lags by half the survey can be any drift, and is simpler than none
        others = [
            c for c in step.candidates
            if c.passes and c.terms.count <= size and c.model.name not in names and not generic(c.model)
            and not hardly_begun(c.model, state.excitation)
        ]  # fmt: skip
        if not others:
            continue
        assert state.terms is not None
        without = put_back_one(state, place)
        mine = fold_gain(without, state.colours, state.terms.only(range(own.start, own.stop)))
        for other in sorted(others, key=lambda c: c.terms.count):
            theirs = fold_gain(without, state.colours, other.model.terms(state.excitation).at(state.residual.samples))
            fewer = other.terms.count < size
            if separated(theirs, mine):
                return Exchange(place, other, True, fewer)
            if fewer and not separated(mine, theirs):
                return Exchange(place, other, False, fewer)
    return None


def exchanged(
    record: Record, state: State, steps: Sequence[Step], how: Fitting, fixed: int, models: int
) -> tuple[Trial, Step] | None:
    """The fit with another model in the place of an adopted one that it does as well as, or better, or with none in the
    place of one that is not needed any more; and the round's story."""
    found = exchange(state, steps, fixed)
    if found is None:
        return _without_a_course(record, state, steps, how, fixed)
    old = state.adopted[found.place].name
    without = possible_without(record, state, [found.place], how)
    if without is None:
        return None
    chosen = looked_at_again(without, found.other, models)
    if chosen is None or (found.better and beside_time(chosen, without).refused):
        return None
    before = trial(record, without, how)
    tried = fitted(record, before, chosen, how)
    if tried.after is None or tried.why:
        return None
    if not found.fewer and per_sample(tried.after.state) <= per_sample(state):  # with fewer it fits all a little less
        return None
    rivals = () if found.better else (old,)
    return tried.after, Step(without, (chosen,), chosen, rivals, refused={old: found.why})


def looked_at_again(state: State, other: Candidate, models: int) -> Candidate | None:
    """A candidate of an earlier round as it stands beside other models, one of so many; None where it fails now."""
    found = candidates_of(state, [other.model.component], {}, other.alpha)
    if not found:
        return None
    again = found[0].among(models)
    return again if again.passes else None


def _without_a_course(
    record: Record, state: State, steps: Sequence[Step], how: Fitting, fixed: int
) -> tuple[Trial, Step] | None:
    """The fit without an adopted course of time, the settings of the others sought once more, if it does as well; and
    the round's story.

    What lags a channel is adopted before its lag, and what it began with, are well known, and a warming up then makes
    up for them. Of what it explains beside the others as they are nobody sees that it is theirs.
    """
    from scipy.special import chdtrc

    x = state.excitation
    if not any(lags(model) for model in state.adopted):
        return None
    before = trial(record, state, how)
    for place in range(fixed, len(state.adopted)):
        model = state.adopted[place]
        if drivers(model, x) != {TIME} or happens_once(model):
            continue
        try:
            others = polished(record, without_models(record, state, [place], how), how)
            after = trial(record, others, how)
        except DataError:  # without it the others leave nothing to calibrate
            continue
        lost = 2.0 * (per_sample(state) - per_sample(others)) * len(state.residual.affine)
        freedom = len(state.theta[place]) + sum(isinstance(g, Range) for g in profiled(model.component).values())
        if float(chdtrc(freedom, max(lost, 0.0))) < KEEP_ALPHA:
            continue
        if not on_the_folds_of(after, record, before, how).hurt_by(after):
            return after, replace(steps[-1], dropped=(*steps[-1].dropped, model.name))
    return None
