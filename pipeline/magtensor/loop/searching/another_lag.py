"""What follows a channel through two lags: the second one in the place of a course of time.

A sensor and its electronics warm up at different rates beside one thermometer, and heat creeps through a housing as it
does through many lags at once. While one of them is in, smooth courses of time explain more of what is left than any
second lag that is not at its best yet, and a warming up or a drift is adopted. Once nothing else is found the second
lag is sought beside all the others, and takes the place of the course if that is likelier. Only of a course with the
same vectors at the sensors: a drift of its own is no such thing, though a lag may follow it better than a law of time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.settings import Range, profiled
from magtensor.errors import DataError
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.separation import SEPARATION, fold_gain
from magtensor.loop.fitting.trial import Trial, per_sample, trial
from magtensor.loop.searching.adopting import polished
from magtensor.loop.searching.beginnings import beginning
from magtensor.loop.searching.contribution import happens_once, possible_without, put_back_one, slices
from magtensor.loop.searching.found import Step
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.keeping import why_not
from magtensor.loop.searching.kin import TIME, drivers
from magtensor.loop.searching.likeness import LIKE_AN_EFFECT, ONE_DIRECTION
from magtensor.loop.searching.own_fit import at_its_fit
from magtensor.loop.searching.rivals import hardly_begun


def with_another_lag(
    record: Record, state: State, how: Fitting, fixed: int, models: int, alpha: float
) -> tuple[Trial, Step] | None:
    """The fit with a second response of a kind that is adopted, of another lag, in the place of a course of time that
    was adopted too, and the round's story; None where none is likelier.

    Parameters
    ----------
    fixed: how many of the adopted models are not asked; models: how many were tried; alpha: of the first gate.
    """
    for place in range(fixed, len(state.adopted)):
        course = state.adopted[place]
        if drivers(course, state.excitation) != {TIME} or happens_once(course):
            continue
        for second, tried in _seconds(state, place):
            rest = [i for i in range(len(state.adopted)) if i != place]
            adopted = [*(state.adopted[i] for i in rest), second]
            begun = [*(state.theta[i] for i in rest), np.zeros(second.terms(state.excitation).count)]
            try:
                after = polished(record, joint_state(record, adopted, how, begun), how)
            except DataError:
                continue
            if 2.0 * (per_sample(after) - per_sample(state)) * len(after.residual.affine) < SEPARATION:
                continue
            without = possible_without(record, state, [place], how)
            if without is None:
                continue
            beside, terms, assessment = at_its_fit(after)
            p, own_p, null_p = (tried * each for each in (assessment.p, assessment.own_p, assessment.null_p))
            chosen = Candidate(after.adopted[-1], tried, terms, assessment, p, own_p, null_p, alpha, before=beside)
            chosen = chosen.among(models)
            before, fitted = trial(record, without, how), trial(record, after, how)
            if not chosen.passes or why_not(record, before, fitted, chosen, how):
                continue
            why = f"{second.name} with a second lag is likelier beside the others"
            return fitted, Step(without, (chosen,), chosen, refused={course.name: why})
    return None


def _seconds(state: State, place: int) -> Iterator[tuple[Adopted, float]]:
    """Each adopted response that lags and has the vectors of the course at a place, once more on the sensors of that,
    with the lag that suits what it explains best, and how many lags were tried; not if it has more coefficients."""
    assert state.terms is not None
    x, course, own = state.excitation, state.adopted[place], slices(state)[place]
    without = put_back_one(state, place)
    names = [model.name for model in state.adopted]
    for number, model in enumerate(state.adopted):
        found = beginning(model.component, model.settings)
        if found is None or names.count(model.name) > 1 or not _along(state, place, number):
            continue
        starts, mark = found
        grid = profiled(model.component)[mark.lag]
        assert isinstance(grid, Range)
        begun = {**model.settings, **dict.fromkeys(starts, 0.0)}
        lags = [float(v) for v in grid.values(x) if v > 0]
        each = [replace(model, settings={**begun, mark.lag: lag}, sensors=course.sensors) for lag in lags]
        possible = [m for m in each if not hardly_begun(m, x) and m.terms(x).count <= own.stop - own.start]
        if possible:
            gains = [fold_gain(without, state.colours, m.terms(x).at(state.residual.samples)).total for m in possible]
            yield possible[int(np.argmax(gains))], float(len(lags))


def _along(state: State, place: int, other: int) -> bool:
    """Whether two adopted models add to the outputs along the same vectors at the sensors, nearly all of the one; not
    asked of what one sensor makes alone: the three numbers of two such vectors agree by chance one time in ten."""
    noise = state.residual.noise

    def direction(number: int) -> tuple[Array, float]:
        added = state.adopted[number].terms(state.excitation).contribution(state.theta[number], len(noise))
        added = (added - added.mean(axis=0)) / noise
        _, sizes, directions = np.linalg.svd(added, full_matrices=False)
        return directions[0], float(sizes[0] ** 2 / max(float(np.sum(sizes**2)), 1e-300))

    (mine, share), (theirs, _) = direction(place), direction(other)
    several = int(np.count_nonzero(mine)) > 3
    return several and share > ONE_DIRECTION and bool(abs(mine @ theirs) > LIKE_AN_EFFECT)
