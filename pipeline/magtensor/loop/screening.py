"""Screening: every error model with every setting, quickly; then the most promising ones, closely."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from magtensor.components import Component
from magtensor.loop.assessment import Assessment, Colours, assess, estimated, explained
from magtensor.loop.colour import Colour
from magtensor.loop.excitation import Excitation
from magtensor.loop.log_noise import brought_in
from magtensor.loop.model import Adopted, State
from magtensor.loop.residual import Residual
from magtensor.loop.settings import EventTimes, Range
from magtensor.loop.terms import Terms, joined

ALPHA = 0.005  # family-wise probability that a clean survey gets an adoption, before the second gate
LEAST_REDUCTION = 1e-4  # of the held-out sum of squares: smaller is significant only in very long surveys
LOG_MARGIN = 1.5  # the noise of a log is known to some per cent, and a dozen coefficients gain a little by chance
SCREENED = 8  # models looked at closely in each round
SCREENING_SAMPLES = 4000  # settings are profiled on so many samples
_REFINEMENTS = 8

WHITE = Colours(Colour(None, 1.0), Colour(None, 1.0))


@dataclass(frozen=True)
class Candidate:
    """An error model with settings, looked at closely.

    Attributes:
        model: component and settings.
        tried: settings tried for it, for the correction of its p value.
        terms: at the residual's samples.
        assessment: of the terms, given the models adopted before.
        adjusted_p: after the correction for settings and for the number of models.
        alpha: what the adjusted p has to stay below.
        log_noise: what noise in the log of its channel, brought in by a model adopted before, lets it gain.
    """

    model: Adopted
    tried: int
    terms: Terms
    assessment: Assessment
    adjusted_p: float
    alpha: float = ALPHA
    log_noise: float = 0.0

    @property
    def of_the_log(self) -> bool:
        """Whether noise in the log of a channel explains what it gains."""
        return self.assessment.gain.total <= LOG_MARGIN * self.log_noise

    @property
    def passes(self) -> bool:
        """Both gates."""
        if self.of_the_log:
            return False
        gain, null = self.assessment.gain, self.assessment.null_gain
        reduction = gain.total / max(float(gain.before.sum()), 1e-300)
        return self.adjusted_p < self.alpha and null.total > 0 and gain.consistent and reduction > LEAST_REDUCTION


def repeatable(model: Component) -> bool:
    """A model that can be adopted more than once, with other settings: one that chooses a channel, time or line."""
    from magtensor.loop.settings import AnyChannel, Frequencies

    return any(isinstance(g, (AnyChannel, EventTimes, Frequencies)) for g in profiled(model).values())


def profiled(model: Component) -> dict[str, Any]:
    """The settings of a model that are searched over, with their grids."""
    found = {}
    for name, parameter in model.parameters.items():
        for mark in getattr(parameter.annotation, "__metadata__", ()):
            if hasattr(mark, "values") and callable(mark.values):
                found[name] = mark
    return found


def settings_grid(model: Component, x: Excitation) -> list[dict[str, Any]]:
    """Every combination of the grids of a model's settings."""
    grids = {name: mark.values(x) for name, mark in profiled(model).items()}
    combinations: list[dict[str, Any]] = [{}]
    for name, values in grids.items():
        combinations = [{**c, name: v} for c in combinations for v in values]
    return combinations


def candidates_of(state: State, models: Sequence[Component], failed: dict[str, str], alpha: float) -> list[Candidate]:
    """The most promising models with their best settings, assessed; their p values corrected for all that was tried."""
    residual = state.residual
    step = -(-len(residual.affine) // SCREENING_SAMPLES)
    thin = np.arange(0, len(residual.affine), step)
    few = Scorer(residual.smaller(thin), None if state.terms is None else state.terms.at(thin), WHITE)
    white = Scorer(residual, state.terms, WHITE)
    coloured = Scorer(residual, state.terms, state.colours)
    scored: list[tuple[float, float, Component, dict[str, Any], int]] = []
    for model in models:
        grid = [g for g in settings_grid(model, state.excitation) if not _already(state, model, g)]
        best: tuple[float, dict[str, Any]] | None = None
        for settings in grid:
            terms = _terms(model, settings, state.excitation, failed)
            if terms is None or not terms.count:
                continue
            score = few(terms.at(residual.samples[thin])) if len(grid) > 1 else 0.0
            if best is None or score > best[0]:
                best = (score, settings)
        if best is None:
            continue
        terms = _terms(model, best[1], state.excitation, failed)
        assert terms is not None
        terms = terms.at(residual.samples)
        scored.append((white(terms), coloured(terms), model, best[1], len(grid)))
    white_first = sorted(scored, key=lambda s: -s[0])[: SCREENED // 2]
    coloured_first = sorted(scored, key=lambda s: -s[1])[: SCREENED - SCREENED // 2]
    looked_at = list({id(s): s for s in (*white_first, *coloured_first)}.values())
    found = []
    for _, _, model, settings, tried in looked_at:
        settings, refined = _refined(residual, model, settings, state, failed)
        terms = _terms(model, settings, state.excitation, failed)
        assert terms is not None
        terms = terms.at(residual.samples)
        assessment = assess(residual, terms, state.colours, state.terms)
        found.append((Adopted(model, settings), tried + refined, terms, assessment))
    order = sorted(range(len(found)), key=lambda i: min(1.0, found[i][3].p * found[i][1]))
    adjusted = np.ones(len(found))
    running = 0.0
    for rank, i in enumerate(order):  # Holm: the models not looked at closely count as less significant ones
        running = max(running, min(1.0, found[i][3].p * found[i][1] * max(len(scored) - rank, 1)))
        adjusted[i] = running
    candidates = [
        Candidate(model, tried, terms, assessment, float(p), alpha, _log_noise(state, model))
        for (model, tried, terms, assessment), p in zip(found, adjusted, strict=True)
    ]
    return sorted(candidates, key=lambda c: -c.assessment.gain.total)


def _log_noise(state: State, model: Adopted) -> float:
    return brought_in(state, model.settings) if generic(model) else 0.0


def generic(model: Adopted) -> bool:
    """A model of anything that follows a channel says less than one that names a cause."""
    return model.name in ("channel_response", "latent_source")


def _already(state: State, model: Component, settings: Mapping[str, Any]) -> bool:
    from magtensor.loop.settings import AnyChannel

    channels = {n for n, g in profiled(model).items() if isinstance(g, AnyChannel)}
    for adopted in state.adopted:
        if (
            adopted.name == model.name
            and all(adopted.settings.get(c) == settings.get(c) for c in channels)
            and channels
        ):
            return True
    return False


def _terms(model: Component, settings: Mapping[str, Any], x: Excitation, failed: dict[str, str]) -> Terms | None:
    """The model's regressors; None, and why, where it cannot make them or they are not finite."""
    try:
        terms: Terms = model.function(x, **settings)
    except (KeyError, ValueError) as error:
        failed[model.name] = str(error)
        return None
    if not np.isfinite(terms.series).all():
        failed[model.name] = "its regressors are not finite on this survey"
        return None
    return terms


class Scorer:
    """What terms explain beyond the adopted ones, less what as many random regressors would, in units of chance."""

    def __init__(self, residual: Residual, adopted: Terms | None, colours: Colours) -> None:
        self.residual, self.adopted, self.colours = residual, adopted, colours
        self.own = 0.0 if adopted is None else explained(estimated(residual, adopted, colours))

    def __call__(self, terms: Terms) -> float:
        together = terms if self.adopted is None else joined([self.adopted, terms])
        estimate = estimated(self.residual, together, self.colours)
        rank = max(min(estimate.rank, terms.count), 1)
        return (explained(estimate) - self.own - rank) / float(np.sqrt(2.0 * rank))


def _refined(
    residual: Residual, model: Component, settings: dict[str, Any], state: State, failed: dict[str, str]
) -> tuple[dict[str, Any], int]:
    """Settings on a range, moved between the neighbours of the best grid value by golden section."""
    tried = 0
    for name, grid in profiled(model).items():
        if not isinstance(grid, (Range, EventTimes)):
            continue
        values = sorted(grid.values(state.excitation))
        place = int(np.argmin(np.abs(np.array(values) - settings[name])))
        low, high = values[max(place - 1, 0)], values[min(place + 1, len(values) - 1)]
        terms = _terms(model, settings, state.excitation, failed)
        if terms is None or high <= low:
            continue
        colours = assess(residual, terms.at(residual.samples), state.colours, state.terms).colours
        score = Scorer(residual, state.terms, colours)

        def gain(value: float, name: str = name, score: Scorer = score, rest: dict[str, Any] = settings) -> float:
            found = _terms(model, {**rest, name: value}, state.excitation, failed)
            return -np.inf if found is None else score(found.at(residual.samples))

        best, count = golden(gain, low, high, settings[name])
        settings = {**settings, name: best}
        tried += count
    return settings, tried


def golden(f: Callable[[float], float], low: float, high: float, best: float) -> tuple[float, int]:
    ratio = (np.sqrt(5.0) - 1) / 2
    a, b = low, high
    c, d = b - ratio * (b - a), a + ratio * (b - a)
    fc, fd, known = f(c), f(d), f(best)
    for _ in range(_REFINEMENTS):
        if fc > fd:
            b, d, fd = d, c, fc
            c = b - ratio * (b - a)
            fc = f(c)
        else:
            a, c, fc = c, d, fd
            d = a + ratio * (b - a)
            fd = f(d)
    value, top = (c, fc) if fc > fd else (d, fd)
    return (float(value), _REFINEMENTS) if top > known else (best, _REFINEMENTS)
