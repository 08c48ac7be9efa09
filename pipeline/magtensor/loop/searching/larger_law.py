"""Candidates that are a small part of a law of the attitude which has no name, or of a gradient that cannot be told.

Every law of the attitude resembles any other one a little: of a kink in the transfer curve of each axis a polynomial
takes the most, a gradient of the site some of the rest, an error of the positions a little of that. What each of them
leaves follows the attitude as well, and is larger than what it explains. In the end they would be taken out again, one
after the other (`overshadowed`); until then every one makes all fits larger.
"""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.assessment import estimated
from magtensor.loop.evidence.residual import Residual, taken_off
from magtensor.loop.fitting.model import Adopted, State
from magtensor.loop.remainder.gradient_shape import MODEL as GRADIENT
from magtensor.loop.remainder.gradient_shape import only_of_a_gradient
from magtensor.loop.remainder.predictable import attitude_square
from magtensor.loop.searching.any_law import by_a_curve
from magtensor.loop.searching.contribution import a_tone
from magtensor.loop.searching.gates import Candidate, seen_between
from magtensor.loop.searching.kin import TIME, drivers

SMALL = 1.0 / 9.0  # a third of the amplitude: what is found comes first, so nine more as large would have to be there
MOST = 1.0  # of a curve of many pieces, which takes a part of any law of the attitude


def part_of_a_larger_law(candidate: Candidate, state: State) -> str:
    """Why a candidate is not adopted that follows the attitude and leaves far more that does; "" where it does not."""
    before, terms = candidate.before or state, candidate.terms
    if before.residual.across is None or terms.delay is not None or not follows_the_attitude(candidate.model, state):
        return ""
    residual, together = before.residual, terms if before.terms is None else joined([before.terms, terms])
    estimate = estimated(residual, together, candidate.assessment.colours)
    if not _differs_between_sensors(residual, terms, np.diag(estimate.normal)[-terms.count :]):
        return ""
    left = taken_off(residual, together, estimate.theta)
    assert residual.across is not None and left.across is not None
    explained = float(np.sum(residual.across**2) - np.sum(left.across**2))
    stays = attitude_square(before, left)
    least = MOST if by_a_curve(candidate.model) else SMALL
    if stays <= 0.0 or explained >= least * stays:
        return ""
    ratio = np.sqrt(max(explained, 0.0) / stays)
    return f"it follows the attitude, and so does what it leaves, of which it is {ratio:.0%}"


def part_of_a_gradient(candidate: Candidate, state: State) -> str:
    """Why a candidate is not adopted that explains only what has the shape of a uniform gradient, of which far more is
    left and which no attitude lets anyone follow; "" where it is not so."""
    before, terms = candidate.before or state, candidate.terms
    x = before.excitation
    if before.residual.across is None or terms.delay is not None or x.attitude is not None:
        return ""
    together = terms if before.terms is None else joined([before.terms, terms])
    estimate = estimated(before.residual, together, candidate.assessment.colours)
    if not seen_between(before.residual, terms, estimate.theta[-terms.count :]):
        return ""
    left = taken_off(before.residual, together, estimate.theta)
    if not only_of_a_gradient(before, x.position, left, terms.count):
        return ""
    return f"what it explains has the shape of a uniform gradient of the field: {GRADIENT} lacks the attitude"


def _differs_between_sensors(residual: Residual, terms: Terms, known: Array) -> bool:
    """Whether most of what terms can do differs between the sensors: with coefficients of either sign that show as much
    of their own, of which so much (P,) is known."""
    signs = np.where(np.random.default_rng(0).random(len(known)) < 0.5, -1.0, 1.0)
    return seen_between(residual, terms, np.where(known > 0, signs / np.sqrt(np.maximum(known, 1e-300)), 0.0))


def follows_the_attitude(model: Adopted, state: State) -> bool:
    """Whether a model of the sensors or the site has no course of its own but for the attitude: no channel, no time."""
    x = state.excitation
    of_its_own = any(name == TIME or not x.is_vector(name) for name in drivers(model, x))
    return not (of_its_own or a_tone(model) or model.component.effect == "reference")
