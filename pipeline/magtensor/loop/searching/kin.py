"""What a candidate has in common with an adopted effect: the sensors, and what drives both.

The law of an effect holds to some per cent: a scale factor that follows the temperature may turn with it a little, an
axis that leans takes its share of a drift. What follows the same channel, or goes with time as well, on the same
sensors, and is that small beside it, is more of the same and no second cause. Not what turns with the field beside what
is added to the axes, nor the other way round: whatever law an offset has, it does not turn, unless the platform hardly
does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.needs import FACTS
from magtensor.error_models.terms import Terms
from magtensor.loop.evidence.assessment import NEARLY_ALL, Assessment
from magtensor.loop.fitting.model import Adopted, State, generic, of_time, turning
from magtensor.loop.fitting.separation import SECOND_ORDER
from magtensor.loop.searching.contribution import a_tone, happens_once, moments
from magtensor.loop.searching.gates import Candidate, explained_by, seen_between

MOST = 0.5  # of what a candidate explains
POWERS = 6  # of time and of a channel: more than any law of an effect that has a name
NEXT = 2  # samples: that a jump seems to be away while another part of it has no name
MISSED = 0.01  # of the squares of an event that is held by another: some samples between the two
TIME = "/time"  # no name of a channel has a slash
DEGREE = "degree"  # of a field of the site that is cut off there: what it lacks goes with the attitude


def explained_beside(state: State, model: Adopted, terms: Terms, assessment: Assessment) -> float:
    """Sum of squares that the adopted models explain whose next order may be all that a candidate shows: not of the
    reference what differs between the sensors, nor of some sensors what others show, nor of what follows the field
    alone what is added to the axes with a channel or with time, nor of an event what holds it. Where the candidate
    follows the field alone, those that follow its rate count for more, if that is known worse than a next order."""
    x = state.excitation
    between = seen_between(state.residual, terms, assessment.estimate.theta[-terms.count :])
    apart = terms.adds_to_axes and not generic(model) and bool(drivers(model, x))
    places = [
        place
        for place, other in enumerate(state.adopted)
        if not (between and other.component.effect == "reference")
        and not (apart and _of_the_field_alone(other, x))
        and not _holds(model, terms, state, place)
        and (not other.sensors or _held_by(other.sensors, state, terms, assessment) > MOST)
    ]
    whole = explained_by(state, places)
    turned = [place for place in places if turning(state.adopted[place].component)]
    if turned and _of_the_field_alone(model, x) and (worse := x.rate_error**2 / SECOND_ORDER) > 1.0:
        whole = max(whole, worse * explained_by(state, turned))
    return whole


def explained_by_kin(state: State, model: Adopted, terms: Terms, assessment: Assessment) -> float:
    """Sum of squares that adopted effects of another name explain which have the candidate's sensors and driver, or no
    law that anybody wrote where it happens once: its time was sought in all that such a response leaves; or which are a
    field of the site to some degree, where the candidate follows the field alone: what is beyond does, too."""
    return _explained(state, drivers(model, state.excitation), model, terms, assessment)


def explained_by_courses(state: State, candidate: Candidate) -> float:
    """Sum of squares that adopted effects explain which go with time all along and have the candidate's sensors: what
    something that happened once leaves is no smooth course."""
    lasting = [place for place, other in enumerate(state.adopted) if not happens_once(other)]
    return _explained(state, {TIME}, candidate.model, candidate.terms, candidate.assessment, lasting)


def _explained(
    state: State,
    by: set[str],
    model: Adopted,
    terms: Terms,
    assessment: Assessment,
    places: Sequence[int] | None = None,
) -> float:
    theta = assessment.estimate.theta[-terms.count :]
    between = seen_between(state.residual, terms, theta)  # where nothing of the reference is
    kin = [
        place
        for place, other in enumerate(state.adopted)
        if other.name != model.name
        and (places is None or place in places)
        and not _of_one_moment(model, other, state.excitation)
        and not _holds(model, terms, state, place)
        and not (between and other.component.effect == "reference")
        and (
            by & drivers(other, state.excitation)
            or (generic(other) and happens_once(model))
            or (DEGREE in other.settings and _of_the_field_alone(model, state.excitation) and not _of_a_gradient(model))
        )
        and _held_by(other.sensors or state.excitation.sensors, state, terms, assessment) > NEARLY_ALL
        and may_be_its_law(other, terms, theta, state)
    ]
    return explained_by(state, kin) if kin else 0.0


def may_be_its_law(other: Adopted, terms: Terms, theta: Array, state: State) -> bool:
    """Whether what a candidate adds to the outputs may be what the law of an adopted effect misses, whatever course of
    its channel and of time that is: only where both are added to the axes, or both turn with the field, or most of the
    one is seen as the other."""
    x, samples = state.excitation, state.residual.samples
    theirs = other.terms(x).at(samples)
    if terms.adds_to_axes == theirs.adds_to_axes:
        return True
    outputs = len(state.residual.noise)
    added = terms.contribution(theta, outputs)
    courses = _courses(other, x, samples)
    whole = left = 0.0
    for number, series in enumerate(added.T):
        own = np.ones(len(samples)) if theirs.adds_to_axes else x.output[samples].reshape(len(samples), -1)[:, number]
        free = np.column_stack([np.ones(len(samples)), x.output[samples, number // 3]])  # what C and o take
        left_of, made = (
            each - free @ np.linalg.lstsq(free, each, rcond=None)[0] for each in (series, courses * own[:, None])
        )
        whole += float(left_of @ left_of)
        left += float(np.sum((left_of - made @ np.linalg.lstsq(made, left_of, rcond=1e-9)[0]) ** 2))
    return left < (1.0 - MOST) * whole


def _courses(model: Adopted, x: Excitation, samples: NDArray[np.int_]) -> Array:
    """(n, K) smooth courses of time, and powers of the channels of a model, at some samples."""
    names = sorted(model.channels(x) | {need for need in model.component.declared({}).needs if need in x.logged})
    logged = (np.nan_to_num(x.channel(name)[samples]).reshape(len(samples), -1).T for name in names)
    series = [x.elapsed[samples], *(channel for several in logged for channel in several)]
    spans = [(s - s.min()) / max(float(np.ptp(s)), 1e-300) * 2.0 - 1.0 for s in series]
    return np.hstack([np.polynomial.legendre.legvander(s, POWERS)[:, 1:] for s in spans])


def drivers(model: Adopted, x: Excitation) -> set[str]:
    """The channels that a model follows, and `TIME` of what drifts, warms up or happens once."""
    found = model.channels(x) | {need for need in model.component.declared({}).needs if need in x.logged}
    return found | ({TIME} if of_time(model.component) else set())


def _of_one_moment(model: Adopted, other: Adopted, x: Excitation, apart: int = 0) -> bool:
    """Whether two events happened between the same samples, or so many away: a jump of C is one of its scale factors
    and one of its angles, and what one leaves there the other explains exactly."""
    mine, theirs = (np.searchsorted(x.elapsed, moments(m)) for m in (model, other))
    return mine.size > 0 and mine.shape == theirs.shape and bool(np.all(np.abs(mine - theirs) <= apart))


def _holds(model: Adopted, terms: Terms, state: State, place: int) -> bool:
    """Whether a candidate is an adopted event with more freedom, and no next order of it: its terms would explain
    nearly all that this explains."""
    if not _of_one_moment(model, state.adopted[place], state.excitation, NEXT):
        return False
    outputs = len(state.residual.noise)
    effect = state.adopted[place].terms(state.excitation).at(state.residual.samples)
    added = effect.contribution(state.theta[place], outputs).reshape(-1, outputs // 3, 3)
    left = 0.0
    for number, sensor in enumerate(state.excitation.sensors):
        own, here = [k for k, s in enumerate(terms.sensors) if s == sensor], added[:, number].ravel()
        if not own or not here.any():
            left += float(here @ here)
            continue
        units = (terms.only([k]).contribution(np.ones(1), outputs) for k in own)
        each = np.column_stack([unit[:, 3 * number : 3 * number + 3].ravel() for unit in units])
        missed = here - each @ np.linalg.lstsq(each, here, rcond=None)[0]
        left += float(missed @ missed)
    return left < MISSED * float(np.sum(added**2))


def _of_the_field_alone(model: Adopted, x: Excitation) -> bool:
    """Whether what a sensor adds follows the field that it sees, and nothing else, so that the next order of it does
    too: a curve, a delay, a conductor."""
    component = model.component
    known = all(need in FACTS for need in component.declared({}).needs)
    return component.effect == "instrument" and known and not (a_tone(model) or generic(model) or drivers(model, x))


def _of_a_gradient(model: Adopted) -> bool:
    """Whether a model acts only in a field that is not uniform: on what a field of the site is, and not beside it."""
    return "gradient" in model.component.declared({}).needs


def _held_by(sensors: Sequence[str], state: State, terms: Terms, assessment: Assessment) -> float:
    """The share of what a candidate explains that its coefficients for some of the sensors hold."""
    theta = assessment.estimate.theta[-terms.count :]
    normal = assessment.estimate.normal[-terms.count :, -terms.count :]
    every = theta @ normal @ theta
    mine = np.array([s in sensors for s in terms.sensors])
    held = np.where(mine, theta, 0.0)
    return float(held @ normal @ held / every) if every > 0 else 0.0
