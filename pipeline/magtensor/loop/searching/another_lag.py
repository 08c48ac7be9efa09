"""What follows a channel through two lags: the second one in the place of a course of time.

A sensor and its electronics warm up at different rates beside one thermometer, and heat creeps through a housing as it
does through many lags at once. While one of them is in, smooth courses of time explain more of what is left than any
second lag that is not at its best yet, and a warming up or a drift is adopted. Once nothing else is found the second
lag is sought beside all the others, and takes the place of the course if that is likelier.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

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
    """Each adopted response that lags, once more on the sensors of the course at a place, with the lag that suits what
    this explains best, and how many lags were tried; not if it has more coefficients."""
    assert state.terms is not None
    x, course, own = state.excitation, state.adopted[place], slices(state)[place]
    without = put_back_one(state, place)
    names = [model.name for model in state.adopted]
    for model in state.adopted:
        found = beginning(model.component, model.settings)
        if found is None or names.count(model.name) > 1:
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
