"""A response with two time constants (or lags, or widths) where one was adopted.

A sensor follows its thermometer through its housing and through the board it sits on. Of the two lags the first to be
adopted lies between them, and beside that compromise neither explains much: what is left looks like a drift. So every
response that was found is asked for once more as two of its kind, both settings sought together in its place. The two
are then tested as what they explain beside the one that they would replace, which holds for any settings of all three.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.settings import profiled
from magtensor.error_models.terms import Terms, joined
from magtensor.golden import golden
from magtensor.loop.evidence.assessment import WHITE, Assessment, assess, colours_of, estimated, likeliest
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.evidence.scoring import Scorer
from magtensor.loop.fitting.log_noise import brought_in
from magtensor.loop.fitting.model import Adopted, State
from magtensor.loop.searching.beginnings import beginning
from magtensor.loop.searching.contribution import put_back_one
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.kin import explained_beside
from magtensor.loop.searching.profiling import (
    LEAST_RATIO,
    REFINING_SAMPLES,
    SCREENING_SAMPLES,
    Thinned,
    already,
    of_ratios,
    thinned,
)
from magtensor.loop.searching.screening import HOPELESS
from magtensor.sharing import shared_out

_SWEEPS = 2  # over both settings


def split(state: State, fixed: int, alpha: float, models: int) -> list[Candidate]:
    """Every adopted response, but the first `fixed` ones, as two of its kind, where chance explains less.

    Parameters
    ----------
    alpha, models: as of the candidates that they stand beside.
    """
    places = range(fixed, len(state.adopted))
    promising = shared_out(lambda place: _promising(state, place, models), places)
    pairs = [(place, *pair) for place, found in zip(places, promising, strict=True) for pair in found]
    found = shared_out(lambda pair: _assessed(state, *pair[:3]), pairs)
    of_each: dict[int, list[Candidate]] = {}
    for (place, name, _, tried), (here, terms, assessment) in zip(pairs, found, strict=True):
        one, other = (_with(state.adopted[place], name, value) for value in here)
        log_noise = brought_in(state, other.channels(state.excitation))
        candidate = Candidate(
            other, tried, terms, assessment, assessment.p * tried, assessment.own_p * tried, assessment.null_p * tried,
            alpha, log_noise, explained_beside(state, other, terms, assessment), moved=(place, one),
        )  # fmt: skip
        of_each.setdefault(place, []).append(candidate.among(models))
    return [max(several, key=lambda c: c.assessment.gain.total) for several in of_each.values()]


def coefficients(state: State, candidate: Candidate) -> list[Array]:
    """Of every model where a joint fit with the two of a candidate begins: of those adopted, then of the second."""
    assert candidate.moved is not None and state.terms is not None
    place, _ = candidate.moved
    without = put_back_one(state, place)
    together = candidate.terms if without.terms is None else joined([without.terms, candidate.terms])
    theta = estimated(without.residual, together, candidate.assessment.colours).theta
    rest = [t for i, t in enumerate(state.theta) if i != place]
    *moves, both = np.split(theta, np.cumsum([len(t) for t in rest])) if rest else [theta]
    one, other = np.split(both, 2)
    start = [t + move for t, move in zip(rest, moves, strict=True)]
    return [*start[:place], one, *start[place:], other]


def _promising(state: State, place: int, models: int) -> list[tuple[str, tuple[float, float], int]]:
    """The setting of an adopted response, values of it for two in its place, of so many pairs; the best pair in white
    noise and in noise of the residual's own colour, if they differ. None where it has no single setting of the kind, or
    chance explains as much."""
    model = state.adopted[place]
    names = [name for name, grid in profiled(model.component).items() if of_ratios(grid)]
    if len(names) != 1 or model.terms(state.excitation).delay is not None:
        return []
    name = names[0]
    others = [other for i, other in enumerate(state.adopted) if i != place]
    settings = {value: _with(model, name, value) for value in profiled(model.component)[name].values(state.excitation)}
    values = sorted(v for v, one in settings.items() if not already(others, model.component, one.settings))
    pairs = [(a, b) for i, a in enumerate(values) for b in values[i + 1 :] if b > LEAST_RATIO * a]
    if not pairs:
        return []
    few, (back, given) = Thinned.of(state, SCREENING_SAMPLES), thinned(put_back_one(state, place), SCREENING_SAMPLES)
    terms = {value: few.of_model(settings[value]) for value in values}
    both = [joined([terms[a], terms[b]]) for a, b in pairs]
    found: dict[tuple[float, float], None] = {}
    for beside, colours in ((few.white, WHITE), (few.coloured, colours_of(few.residual))):
        best = int(np.argmax(Scorer(back, given, colours).of_each(both)))
        if np.exp(-beside(both[best])) * len(pairs) * models < HOPELESS:
            found[pairs[best]] = None
    return [(name, pair, len(pairs)) for pair in found]


def _with(model: Adopted, name: str, value: float) -> Adopted:
    """A response with another setting, in equilibrium when the survey began."""
    began = beginning(model.component, model.settings)
    at_rest = dict.fromkeys(began[0], 0.0) if began else {}
    return replace(model, settings={**model.settings, **at_rest, name: value})


def _assessed(
    state: State, place: int, name: str, pair: tuple[float, float]
) -> tuple[tuple[float, float], Terms, Assessment]:
    """The two with their settings refined: these, their terms, and what they explain beside what is adopted."""
    model = state.adopted[place]
    grid = sorted(profiled(model.component)[name].values(state.excitation))
    few = Thinned.of(state, REFINING_SAMPLES)
    residual, given = thinned(put_back_one(state, place), REFINING_SAMPLES)
    terms = [few.of_model(_with(model, name, value)) for value in pair]
    together = joined([*terms] if given is None else [given, *terms])
    score = Scorer(residual, given, likeliest(residual, together, [colours_of(residual), WHITE]).colours)
    here = list(pair)
    for which in (1, 0) * _SWEEPS:
        low = max((v for v in grid if v < pair[which]), default=pair[which])
        high = min((v for v in grid if v > pair[which]), default=pair[which])

        def gain(value: float, which: int = which) -> float:
            moved = [*terms]
            moved[which] = few.of_model(_with(model, name, value))
            return score(joined(moved))

        here[which] = golden(gain, low, high, here[which])
        terms[which] = few.of_model(_with(model, name, here[which]))
    one, other = (_with(model, name, value) for value in here)
    both = joined([m.terms(state.excitation).at(state.residual.samples) for m in (one, other)])
    now = Whitened.of(state.residual, state.colours.across, state.colours.along, state.terms)
    return (here[0], here[1]), both, assess(now, both)
