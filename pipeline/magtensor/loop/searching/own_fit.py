"""Candidates that are not small: judged where a fit of everything with them stands.

Where an effect is small, what it explains is read off the residual without it, to first order. A delay of 10 ms in a
field that turns at 0.7 rad/s is 350 nT and, to second order, 1 nT; and a direction of the field that is off by that
shortens the mean of the sensors. What that leaves would speak against the true cause, for whatever bends as it does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from magtensor.error_models.settings import Range, profiled
from magtensor.error_models.terms import Terms
from magtensor.errors import DataError
from magtensor.loop.evidence.assessment import Assessment, assess, colours_of
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.fitting.model import Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.separation import SEPARATION, fold_gain, plainer, separated
from magtensor.loop.searching.contribution import happens_once, put_back, slices
from magtensor.loop.searching.gates import Candidate
from magtensor.sharing import shared_out

AS_MUCH = 0.5  # of what the best one explains
SMALL = 0.1  # of the noise: what an effect across the field adds to its length, to second order


def at_their_own_fit(candidates: Sequence[Candidate], record: Record, state: State, how: Fitting) -> list[Candidate]:
    """The candidates, best first; those that are significant and not small judged anew, and beside these what explains
    as much: it is compared with them, and without it the outputs are thought to have more noise, each another.

    Each is fitted together with all that is adopted, on the samples that the fit without it believes. What it explains
    is put back into the residual of that fit, to first order, and assessed there; so are its plainer forms.
    """
    large = [c for c in candidates if c.significant and _large(c, state)]
    if large:
        least = AS_MUCH * max(c.assessment.gain.total for c in candidates)
        large = [c for c in candidates if c in large or (c.significant and c.assessment.gain.total > least)]
    best = max(large, key=lambda c: c.assessment.gain.total, default=None)
    each_with = [([c, *as_set_in(best, c, state)], plainer_forms(c, state)) for c in large if best is not None]
    tried = [c for itself, below in each_with for c in (*itself, *below)]
    judged = iter(shared_out(lambda c: _judged(c, record, state, how), tried))
    again = {}
    for several in each_with:
        itself, below = ([_there(c, found, state) for c in forms if (found := next(judged))] for forms in several)
        if itself:
            own = max(itself, key=lambda c: c.assessment.gain.total)
            again[id(several[0][0])] = _lowest(own, below, state)
    return sorted((again.get(id(c), c) for c in candidates), key=lambda c: -c.assessment.gain.total)


def as_set_in(best: Candidate, candidate: Candidate, state: State) -> list[Candidate]:
    """The same model with a setting of the best one that it shares, a time constant say: the search for its own, where
    the fit without either is far off, may have ended elsewhere."""
    grids, theirs = profiled(candidate.model.component), profiled(best.model.component)
    shared = {
        name: best.model.settings[name]
        for name, grid in grids.items()
        if isinstance(grid, Range) and isinstance(theirs.get(name), Range)
        and grid.low <= best.model.settings[name] <= grid.high
        and best.model.settings[name] != candidate.model.settings[name]
    }  # fmt: skip
    return [_with_settings(candidate, shared, state)] if shared else []


def plainer_forms(candidate: Candidate, state: State) -> list[Candidate]:
    """The same model in every plainer form that explains something before it is fitted: a delay of all axes alike may
    be nothing that the lengths of one sensor's field show, and a fit of it would go anywhere."""
    forms = (
        _with_settings(candidate, settings, state)
        for settings in plainer(candidate.model.settings, profiled(candidate.model.component))
    )
    return [
        form for form in forms
        if form.assessment.estimate.explained_beside(len(form.assessment.theta) - form.terms.count) > SEPARATION
    ]  # fmt: skip


def _with_settings(candidate: Candidate, settings: Mapping[str, Any], state: State) -> Candidate:
    """A candidate with other settings, assessed where nothing is fitted yet."""
    model = replace(candidate.model, settings={**candidate.model.settings, **settings})
    terms = model.terms(state.excitation).at(state.residual.samples)
    now = Whitened.of(state.residual, state.colours.across, state.colours.along, state.terms)
    return replace(candidate, model=model, terms=terms, assessment=assess(now, terms, once=happens_once(model)))


def _there(candidate: Candidate, found: tuple[State, Terms, Assessment], state: State) -> Candidate:
    before, terms, assessment = found
    return replace(candidate, terms=terms, assessment=assessment, before=replace(before, adopted=state.adopted))


def _lowest(best: Candidate, below: Sequence[Candidate], state: State) -> Candidate:
    """The plainest form that held-out blocks do not separate from the best, each judged at its own fit."""
    colours = best.assessment.colours
    reference = fold_gain(best.before or state, colours, best.terms)
    kept = (c for c in below if not separated(reference, fold_gain(c.before or state, colours, c.terms)))
    return min(kept, key=lambda c: c.assessment.estimate.rank, default=best)


def _large(candidate: Candidate, state: State) -> bool:
    """Whether its second order matters: of a delay, of whatever length, it may."""
    if candidate.terms.delay is not None:
        return True
    own = candidate.assessment.theta[-candidate.terms.count :]
    added = candidate.terms.contribution(own, len(state.residual.noise))
    return float(np.mean(added**2)) / (2.0 * state.residual.unit) > SMALL * state.residual.scale


def _judged(candidate: Candidate, record: Record, state: State, how: Fitting) -> tuple[State, Terms, Assessment] | None:
    """What a candidate is judged against, its models left out, which no other process could send back; its terms there,
    and what the data say of them. None where it cannot be fitted: it is judged by the residual without it then."""
    moves = np.split(candidate.assessment.theta, np.cumsum([len(t) for t in state.theta]))
    start = [t + move for t, move in zip([*state.theta, np.zeros(candidate.terms.count)], moves, strict=True)]
    try:
        after = joint_state(record, [*state.adopted, candidate.model], how, start, state.lines, state.fit.keep)
    except DataError:
        return None
    before, terms, found = at_its_fit(after)
    moved = [t - s for t, s in zip(after.theta, state.theta, strict=False)]
    theta = found.theta + np.concatenate([*moved, np.zeros(terms.count)])
    return before, terms, replace(found, theta=theta)


def at_its_fit(after: State) -> tuple[State, Terms, Assessment]:
    """What the last of the models is judged against at the fit with it, all models left out, which no other process
    could send back; its terms there, and what the data say of them."""
    assert after.terms is not None
    own = slices(after)[-1]
    terms = after.terms.only(range(own.start, own.stop))
    given = after.terms.only(range(own.start)) if own.start else None
    residual = put_back(after.residual, terms, after.theta[-1])
    before = replace(after, adopted=(), theta=after.theta[:-1], residual=residual, terms=given)
    colours = colours_of(residual)
    once = happens_once(after.adopted[-1])
    return before, terms, assess(Whitened.of(residual, colours.across, colours.along, given), terms, once=once)
