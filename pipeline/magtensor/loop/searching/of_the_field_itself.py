"""What the field itself does where nobody recorded it.

Beside a constant in the place of a base station the diurnal variation is in |b| - F, alike in all sensors. So is a
scale factor that all axes of all sensors have in common, whether it drifts or follows a temperature that does; nothing
tells these from the field.
"""

from __future__ import annotations

from magtensor.error_models.needs import measured
from magtensor.error_models.terms import joined
from magtensor.loop.evidence.assessment import WHITE, colours_of, estimated, explained
from magtensor.loop.evidence.residual import taken_off
from magtensor.loop.fitting.model import State
from magtensor.loop.searching.course_of_time import FIRST_LEFT, SEEN, chance_of, smooth_courses
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.profiling import REFINING_SAMPLES, thinned


def of_the_field_itself(candidate: Candidate, state: State) -> str:
    """Why a candidate may be the field: the reference is a constant, and beside smooth courses of the total field the
    candidate explains nothing. "" where it does, or where a total field was measured."""
    before = candidate.before or state
    x = before.excitation
    if x.total_field is None or measured(x.total_field):
        return ""
    residual, given = thinned(before, REFINING_SAMPLES)
    own = candidate.model.terms(x).at(residual.samples)
    held = [] if given is None else [given]
    courses = [*held, *(x.on_reference(c, "nT", "") for c in smooth_courses(x)[residual.samples].T)]
    without, beside = joined(courses), joined([*courses, own])
    left = taken_off(residual, beside, estimated(residual, beside, WHITE).theta)
    colours = colours_of(left, stiff=True, above=FIRST_LEFT)
    gained = explained(estimated(residual, beside, colours)) - explained(estimated(residual, without, colours))
    if chance_of(gained, own.count) < SEEN:
        return ""
    return "the reference is a constant, and a total field that drifts leaves it nothing to explain"
