"""An event as strong as the field: found in the lengths of the outputs before anything can be calibrated.

A magnet that lay on the platform for a while leaves no ellipsoid to all samples together. With sensors near nominal the
search would begin from a field that points elsewhere while it lay there, and everything is linear about that. So where
a survey's attitudes seem to determine no calibration, and the outputs of some sensor have another centre for a while
(`another_centre`), the fit begins with that; what it finds is asked what any other candidate is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibration.another_centre import another_centre
from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.errors import DataError
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.adopting import polished
from magtensor.loop.searching.found import Step
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.left_out import better_left_out
from magtensor.loop.searching.on_fewer_sensors import on_those_needed
from magtensor.loop.searching.own_fit import at_its_fit
from magtensor.loop.searching.refining import refined

STEP, WHILE = "offset_step", "offset_while"
MOST_LEFT = 0.25  # of the squares that one ellipsoid leaves: the misfit is more than halved
TRIED = 1800.0  # pairs of times between the blocks of `another_centre`


@dataclass(frozen=True)
class Begun:
    """Where a search begins that found such an event: the fit with it, how it was made, and the round."""

    state: State
    how: Fitting
    step: Step


def begun_with(record: Record, models: Sequence[Component], first: State, how: Fitting, alpha: float) -> Begun | None:
    """The fit with an event, without a prior if the attitudes determine one then; None where there is no such event.

    Parameters
    ----------
    first: the fit near nominal of the declared models; how: it was made.
    """
    found = _sought(record, models)
    if found is None:
        return None
    model, theta = found
    adopted, start = [*first.adopted, model], [*first.theta, theta]
    for way in (replace(how, nominal=None), how):
        try:
            after = _with_its_times(record, joint_state(record, adopted, way, start), way)
            after = on_those_needed(record, polished(record, after, way), len(first.adopted), way)
        except DataError:
            continue
        before, terms, assessment = at_its_fit(after)
        p, own_p, null_p = (TRIED * each for each in (assessment.p, assessment.own_p, assessment.null_p))
        chosen = Candidate(after.adopted[-1], TRIED, terms, assessment, p, own_p, null_p, alpha, before=before)
        chosen = chosen.among(len(models))
        if chosen.passes and not better_left_out(record, first, after, len(first.adopted), way):
            names = tuple(m.name for m in models)
            return Begun(after, way, Step(replace(before, adopted=first.adopted), (chosen,), chosen, screened=names))
    return None


def _sought(record: Record, models: Sequence[Component]) -> tuple[Adopted, Array] | None:
    """The event that the outputs' lengths show, on the sensors whose misfit it more than halves, and its coefficients;
    None where there is none, or no model of it may be adopted."""
    if record.total_field is None:
        return None
    found = another_centre(record.raw, record.total_field)
    if found is None:
        return None
    shown = np.flatnonzero(found.left < MOST_LEFT)
    elapsed = record.time - record.start
    settings = {"time_s": float(elapsed[found.first])}
    if found.end < len(elapsed):
        settings["until_s"] = float(elapsed[found.end])
    component = next((m for m in models if m.name == (WHILE if len(settings) > 1 else STEP)), None)
    if component is None or not len(shown):
        return None
    sensors = () if len(shown) == len(record.sensors) else tuple(record.sensors[i] for i in shown)
    return Adopted(component, settings, sensors), found.moved[shown].ravel()


def _with_its_times(record: Record, state: State, how: Fitting) -> State:
    """The fit with the event's times moved to where they suit the samples beside them best."""
    before, _, _ = at_its_fit(state)
    event = state.adopted[-1]
    settings = refined(event.component, dict(event.settings), before, {})
    if settings == dict(event.settings):
        return state
    return joint_state(record, [*state.adopted[:-1], replace(event, settings=settings)], how, state.theta)
