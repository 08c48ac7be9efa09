"""The settings of an error model: which are tried, which explain most, and what they amount to as tests."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel, Beginning, Choice, EventTimes, Frequencies, Range, profiled
from magtensor.error_models.terms import Terms
from magtensor.errors import UsageError
from magtensor.loop.evidence.assessment import WHITE, colours_of
from magtensor.loop.evidence.columns import Made
from magtensor.loop.evidence.multiplicity import alike, effective_tests, projected
from magtensor.loop.evidence.quick_length import quick_length
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.evidence.scoring import Scorer
from magtensor.loop.fitting.model import Adopted, State, regressors
from magtensor.loop.searching.delayed_logs import Delays, delayed

LEAST_RATIO = 2.0  # of the time constants, lags or widths of a model adopted twice
SCREENING_SAMPLES = 2000  # settings are profiled on so many samples
REFINING_SAMPLES = 6000  # and the best of them refined on so many
BATCH_ENTRIES = 130_000  # numbers in the series that are worked on together
BETWEEN_TIMES = 10.0  # times as many tests as the grid of an event's time amounts to, where it is refined to a sample
OF_DELAYS = 10.0  # of all false alarms of a model one in so many may be of a channel that is late or early as a whole


def repeatable(model: Component) -> bool:
    """A model that can be adopted more than once, with other settings.

    One that chooses a channel, time or line may act through several; a time constant, lag or width is seldom a single
    one, and what a second leaves is better called more of the same than something else.
    """
    grids = profiled(model).values()
    return any(isinstance(g, (AnyChannel, EventTimes, Frequencies)) or of_ratios(g) for g in grids)


def of_ratios(grid: Any) -> bool:
    """A setting whose values differ by factors: a time constant, lag or width."""
    return isinstance(grid, Range) and (grid.low >= 0 or grid.spacing == "log")


def settings_grid(model: Component, x: Excitation) -> list[dict[str, Any]]:
    """Every combination of the grids of a model's settings."""
    combinations: list[dict[str, Any]] = [{}]
    for name, mark in profiled(model).items():
        combinations = [{**c, name: v} for c in combinations for v in mark.values(x)]
    return combinations


def short_parts(model: Component, grid: Sequence[dict[str, Any]], x: Excitation) -> list[dict[str, Any]]:
    """The same with parts of the survey too short for two grids of times; none of other models."""
    found: list[dict[str, Any]] = []
    for name, mark in profiled(model).items():
        if isinstance(mark, EventTimes) and mark.since:
            rest = [c for c in grid if c[name] == grid[0][name] and c[mark.since] == grid[0][mark.since]]
            found += [{**c, mark.since: begin, name: end} for begin, end in mark.short_parts(x) for c in rest]
    return found


def already(adopted: Iterable[Adopted], model: Component, settings: Mapping[str, Any]) -> bool:
    """Whether a model is in already with the same channel, acting on the same, and settings on ranges so near that the
    two could not be told apart."""
    grids = profiled(model)
    channels = {n for n, g in grids.items() if isinstance(g, AnyChannel)}
    acts_on = {n for n, g in grids.items() if type(g) is Choice and g.options == (False, True)}
    ranges = {n for n, g in grids.items() if of_ratios(g)}
    begun = {n for n, g in grids.items() if isinstance(g, Beginning)}
    same = channels | acts_on if channels else set(grids) - ranges - begun
    return any(
        all(one.settings.get(n, model.parameters[n].default) == settings.get(n) for n in same)
        and not any(_apart(one.settings.get(n, model.parameters[n].default), settings[n]) for n in ranges)
        for one in adopted
        if one.name == model.name
    )


def _apart(one: float, other: float) -> bool:
    return abs(one - other) > (LEAST_RATIO - 1.0) * min(abs(one), abs(other))


def terms_of(model: Component, settings: Mapping[str, Any], x: Excitation, failed: dict[str, str]) -> Terms | None:
    """The model's regressors; None, and why, where it cannot make them or they are not finite."""
    try:
        terms = regressors(model, x, settings)
    except (KeyError, ValueError, UsageError) as error:
        failed[model.name] = str(error)
        return None
    if not np.isfinite(terms.series).all():
        failed[model.name] = "its regressors are not finite on this survey"
        return None
    return terms


@dataclass(frozen=True)
class Thinned:
    """Some samples of a residual, on which settings are profiled, and how terms score there.

    Attributes:
        every, own: what models see of all samples, and of these.
        freedom: (n, 4) orthonormal, what the fit's own freedom follows.
        white, coloured: in white noise and in noise of the residual's own colour.
    """

    residual: Residual
    every: Excitation
    own: Excitation
    freedom: Array
    white: Scorer
    coloured: Scorer

    @classmethod
    def of(cls, state: State, most: int) -> Thinned:
        residual, given = thinned(state, most)
        colours = state.colours if residual is state.residual else colours_of(residual)
        x = state.excitation
        scorers = Scorer(residual, given, WHITE), Scorer(residual, given, colours)
        return cls(residual, x, x.at(residual.samples), np.linalg.qr(residual.affine)[0], *scorers)

    def terms(self, model: Component, settings: Mapping[str, Any], failed: dict[str, str]) -> Terms | None:
        """As `terms_of`, at the samples."""
        if model.pointwise:
            return terms_of(model, settings, self.own, failed)
        terms = terms_of(model, settings, self.every, failed)
        return None if terms is None else terms.at(self.residual.samples)

    def of_model(self, model: Adopted) -> Terms:
        """The regressors of a model with settings, at the samples."""
        if model.component.pointwise:
            return model.terms(self.own)
        return model.terms(self.every).at(self.residual.samples)


def thinned(state: State, most: int) -> tuple[Residual, Terms | None]:
    """At most so many samples of a residual, evenly chosen, and the adopted terms there."""
    count = len(state.residual.affine)
    if count <= most:
        return state.residual, state.terms
    thin = np.arange(0, count, -(-count // most))
    thin = thin[: quick_length(len(thin))]
    return state.residual.smaller(thin), None if state.terms is None else state.terms.at(thin)


@dataclass(frozen=True)
class Proposed:
    """Settings of a model that explain most of those of a kind.

    Attributes:
        tried: the number of independent tests that all settings amount to.
        kind: "" for those of the model's grid, "short" for a part of the survey too short for the grid, "delayed" for a
            logged channel that is late or early as a whole.
    """

    settings: dict[str, Any]
    tried: float
    kind: str = ""


def best_settings(
    model: Component, state: State, few: Thinned, delays: Delays, failed: dict[str, str], alpha: float
) -> list[Proposed]:
    """The settings that explain most in white noise and in noise of the residual's own colour, if they differ.

    In white noise what is slow decides, in coloured noise what is fast. What lasts for a short part of a survey is
    fast, and the best of it comes beside the others. Neighbouring times of an event differ by the noise of a single
    sample, so that refining them amounts to many more tests: on clean surveys some five to ten times as many for each
    time. Delays of a channel's log come beside the others where they are less likely by chance, and of all false alarms
    they may make a tenth: what is not delayed is found as easily as if none had been tried.
    """
    grid = [g for g in settings_grid(model, state.excitation) if not already(state.adopted, model, g)]
    if len(grid) == 1:
        return [Proposed(grid[0], 1.0)]
    every = [*grid, *short_parts(model, grid, state.excitation)]
    scores, chain = _scores(model, every, few, failed)
    if not scores:
        return []
    times = sum(isinstance(g, EventTimes) for g in profiled(model).values())
    tried = effective_tests(chain, alpha) * BETWEEN_TIMES**times
    of_the_grid = {id(settings) for settings in grid}
    lasting, short = ([s for s in scores if (id(s[2]) in of_the_grid) is inside] for inside in (True, False))
    found = [Proposed(settings, tried) for settings in _best(lasting)]
    if short:
        found.append(Proposed(max(short, key=lambda s: s[1])[2], tried, "short"))
    late, tests = delayed(model, grid, delays, alpha)
    late = [g for g in late if not already(state.adopted, model, g)]
    white, coloured = (
        max(column) + log(OF_DELAYS * tests) for column in ([s[0] for s in scores], [s[1] for s in scores])
    )
    better = [s for s in _scores(model, late, few, failed)[0] if s[0] > white or s[1] > coloured]
    return found + [Proposed(settings, OF_DELAYS * (tried + tests), "delayed") for settings in _best(better)]


def _scores(
    model: Component, grid: Sequence[dict[str, Any]], few: Thinned, failed: dict[str, str]
) -> tuple[list[tuple[float, float, dict[str, Any]]], list[float]]:
    """How unlikely chance explains as much in white noise and in the residual's own, for settings whose terms can be
    made; and how alike each is to the one before of its kind."""
    found: dict[int, tuple[float, float]] = {}
    chain: list[float] = []
    last: dict[Hashable, Array] = {}
    made = ((number, few.terms(model, settings, failed)) for number, settings in enumerate(grid))
    for kind, batch in _batches((number, terms) for number, terms in made if terms is not None and terms.count):
        several = [terms for _, terms in batch]
        columns = Made.of(few.residual, several)
        both = zip(few.white.of_each(several, columns), few.coloured.of_each(several, columns), strict=True)
        found |= {number: each for (number, _), each in zip(batch, both, strict=True)}
        for terms in several:
            series = projected(terms, few.freedom)
            if kind in last:
                chain.append(alike(last[kind], series))
            last[kind] = series
    chain += [0.0] * (len(last) - 1)  # of different kinds nothing is known
    return [(*found[number], grid[number]) for number in sorted(found)], chain


def _best(scores: Sequence[tuple[float, float, dict[str, Any]]]) -> list[dict[str, Any]]:
    """The settings with the best score in white and in coloured noise, if they differ; none of none."""
    if not scores:
        return []
    white, coloured = (max(scores, key=lambda s, k=k: s[k])[2] for k in (0, 1))  # type: ignore[misc]
    return [white] if white is coloured else [white, coloured]


def _batches(made: Iterable[tuple[int, Terms]]) -> Iterator[tuple[Hashable, list[tuple[int, Terms]]]]:
    """Numbered terms of one kind each, in their order; so few at a time that they take little memory."""
    waiting: dict[Hashable, list[tuple[int, Terms]]] = {}
    for number, terms in made:
        batch = waiting.setdefault(terms.kind, [])
        if len(batch) * terms.series.size > BATCH_ENTRIES:
            yield terms.kind, batch
            batch = waiting[terms.kind] = []
        batch.append((number, terms))
    yield from waiting.items()
