"""The settings of an error model: which are tried, which explain most, and what they amount to as tests."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel, Beginning, Cleaned, EventTimes, Frequencies, Range, profiled
from magtensor.error_models.terms import Terms, joined
from magtensor.errors import UsageError
from magtensor.loop.evidence.assessment import WHITE, colours_of, estimated, likeliest
from magtensor.loop.evidence.columns import Made
from magtensor.loop.evidence.golden import REFINEMENTS, golden
from magtensor.loop.evidence.multiplicity import alike, effective_tests, projected
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.evidence.scoring import Scorer
from magtensor.loop.fitting.model import Adopted, State, regressors
from magtensor.loop.fitting.separation import SEPARATION
from magtensor.loop.searching.beginnings import begun

LEAST_RATIO = 2.0  # of the time constants, lags or widths of a model adopted twice
SCREENING_SAMPLES = 2000  # settings are profiled on so many samples
REFINING_SAMPLES = 6000  # and the best of them refined on so many
BATCH_ENTRIES = 130_000  # numbers in the series that are worked on together
MOST_OF_IT = 0.75  # of what a model explains, if it is to be made about other settings
BETWEEN_TIMES = 10.0  # times as many tests as the grid of an event's time amounts to, where it is refined to a sample
_OF_A_LINE = 16  # to a thousandth of its width
_GOLDEN = 0.4812  # log of what a step of a golden section divides by
_SAMPLES_ABOUT = 6  # to either side of an event's time in white noise


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
    """Whether a model is in already with the same channel, and settings on ranges so near that the two could not be
    told apart."""
    grids = profiled(model)
    channels = {n for n, g in grids.items() if isinstance(g, AnyChannel)}
    ranges = {n for n, g in grids.items() if of_ratios(g)}
    begun = {n for n, g in grids.items() if isinstance(g, Beginning)}
    same = channels or set(grids) - ranges - begun
    return any(
        all(one.settings.get(n) == settings.get(n) for n in same)
        and not any(_apart(one.settings[n], settings[n]) for n in ranges)
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


def thinned(state: State, most: int) -> tuple[Residual, Terms | None]:
    """At most so many samples of a residual, evenly chosen, and the adopted terms there."""
    count = len(state.residual.affine)
    if count <= most:
        return state.residual, state.terms
    thin = np.arange(0, count, -(-count // most))
    return state.residual.smaller(thin), None if state.terms is None else state.terms.at(thin)


def best_settings(
    model: Component, state: State, few: Thinned, failed: dict[str, str], alpha: float
) -> list[tuple[dict[str, Any], float, bool]]:
    """The settings that explain most in white noise and in noise of the residual's own colour, if they differ.

    In white noise what is slow decides, in coloured noise what is fast. Beside each the number of independent tests
    that all settings amount to, and whether they are of a short part of the survey: what lasts no longer is fast, and
    the best of it comes beside the others. Neighbouring times of an event differ by the noise of a single sample, so
    that refining them amounts to many more: on clean surveys some five to ten times as many for each time.
    """
    grid = [g for g in settings_grid(model, state.excitation) if not already(state.adopted, model, g)]
    if len(grid) == 1:
        return [(grid[0], 1.0, False)]
    long = len(grid)
    grid += short_parts(model, grid, state.excitation)
    scores: list[tuple[float, float, dict[str, Any]]] = []
    chain: list[float] = []
    last: Array | None = None
    made = ((settings, few.terms(model, settings, failed)) for settings in grid)
    for batch in _batches((settings, terms) for settings, terms in made if terms is not None and terms.count):
        several = [terms for _, terms in batch]
        columns = Made.of(few.residual, several)
        both = zip(few.white.of_each(several, columns), few.coloured.of_each(several, columns), strict=True)
        scores += [(white, coloured, settings) for (white, coloured), (settings, _) in zip(both, batch, strict=True)]
        for terms in several:
            series = projected(terms, few.freedom)
            if last is not None:
                chain.append(alike(last, series))
            last = series
    if not scores:
        return []
    times = sum(isinstance(g, EventTimes) for g in profiled(model).values())
    tried = effective_tests(chain, alpha) * BETWEEN_TIMES**times
    lasting, short = ([s for s in scores if any(s[2] is g for g in some)] for some in (grid[:long], grid[long:]))
    found = []
    if lasting:
        best = max(lasting, key=lambda s: s[0])[2], max(lasting, key=lambda s: s[1])[2]
        found = [(settings, tried, False) for settings in (best[:1] if best[0] is best[1] else best)]
    return [*found, (max(short, key=lambda s: s[1])[2], tried, True)] if short else found


def _batches(made: Iterable[tuple[dict[str, Any], Terms]]) -> Iterator[list[tuple[dict[str, Any], Terms]]]:
    """Neighbouring settings whose terms differ in their series only; so few at a time that they take little memory."""
    batch: list[tuple[dict[str, Any], Terms]] = []
    for settings, terms in made:
        if batch and (len(batch) * terms.series.size > BATCH_ENTRIES or not batch[0][1].like(terms)):
            yield batch
            batch = []
        batch.append((settings, terms))
    if batch:
        yield batch


def refined(model: Component, settings: dict[str, Any], state: State, failed: dict[str, str]) -> dict[str, Any]:
    """Settings on a range, moved between the neighbours of the best grid value by golden section; a lag of none stays
    one where the data do not separate the two, and so does a response in equilibrium at the survey's start."""
    few = thinned(state, REFINING_SAMPLES)
    settings = _without_log_noise(model, settings, state, few, failed)
    for name, grid in profiled(model).items():
        if not isinstance(grid, (Range, EventTimes, Frequencies)):
            continue
        low, high = _around(grid, settings[name], state.excitation)
        terms = terms_of(model, settings, state.excitation, failed)
        if terms is None or high <= low:
            continue
        residual, given = few
        terms = terms.at(residual.samples)
        together = terms if given is None else joined([given, terms])
        score = Scorer(residual, given, likeliest(residual, together, [colours_of(residual), WHITE]).colours)

        def at(value: float, name: str = name, rest: dict[str, Any] = settings) -> Terms | None:
            found = terms_of(model, {**rest, name: value}, state.excitation, failed)
            return None if found is None else found.at(few[0].samples)

        def gain(value: float, score: Scorer = score, at: Callable[[float], Terms | None] = at) -> float:
            found = at(value)
            return -np.inf if found is None else score(found)

        best = settings[name]
        finer = grid.between(low, high) if isinstance(grid, Range) else []
        if len(finer) > 1:
            best = max([best, *finer], key=gain)
            low, high = best - (finer[1] - finer[0]), best + (finer[1] - finer[0])
        if isinstance(grid, EventTimes):
            best = _its_time(gain, Scorer(residual, given, WHITE), at, (low, high), best, state.excitation.spacing)
        else:
            best = golden(gain, low, high, best, _OF_A_LINE if isinstance(grid, Frequencies) else REFINEMENTS)
        if low <= 0.0 <= high and of_ratios(grid) and gain(best) - gain(0.0) < SEPARATION / 2.0:
            best = 0.0
        settings = {**settings, name: best}
    settings = begun(model, settings, state, few)
    return _about_what_it_fits(model, settings, state, failed) if model.about is not None else settings


def _without_log_noise(
    model: Component, settings: dict[str, Any], state: State, few: tuple[Residual, Terms | None], failed: dict[str, str]
) -> dict[str, Any]:
    """Settings with the channel as it was logged or without the noise of its log, whichever the data tell from the
    other: what is slower than the channel has less of that noise, and a lag would be found that there is none of."""
    grids = profiled(model)
    forms = {name: grid.options for name, grid in grids.items() if isinstance(grid, Cleaned)}
    none = {name: 0.0 for name, grid in grids.items() if isinstance(grid, Range) and of_ratios(grid) and grid.low <= 0}
    residual, given = few
    here = terms_of(model, settings, state.excitation, failed) if forms else None
    if here is None:
        return settings
    here = here.at(residual.samples)
    together = here if given is None else joined([given, here])
    score = Scorer(residual, given, likeliest(residual, together, [colours_of(residual), WHITE]).colours)
    best, known = settings, score(here) + SEPARATION / 2.0
    for name, options in forms.items():
        others = [{**settings, name: option} for option in options if option != settings[name]]
        for other in [changed for one in others for changed in ({**one, **none}, one)]:
            terms = terms_of(model, other, state.excitation, failed)
            if terms is not None and (gain := score(terms.at(residual.samples))) > known:
                best, known = other, gain
    return best


def _its_time(
    gain: Callable[[float], float],
    white: Scorer,
    at: Callable[[float], Terms | None],
    limits: tuple[float, float],
    best: float,
    spacing: float,
) -> float:
    """The time of an event between limits, s, to a sample.

    In white noise the way to it rises from afar. In noise of the colour that a large jump leaves only the very sample
    explains anything: there it is sought among the samples about the time found in white noise.
    """
    low, high = limits

    def in_white(value: float) -> float:
        found = at(value)
        return -np.inf if found is None else white(found)

    steps = int(np.clip(np.ceil(np.log(max((high - low) / spacing, 2.0)) / _GOLDEN), REFINEMENTS, _OF_A_LINE))
    about = golden(in_white, low, high, best, steps)
    near = about + spacing * np.arange(-_SAMPLES_ABOUT, _SAMPLES_ABOUT + 1)
    from_afar = golden(gain, low, high, best)
    return max((float(v) for v in (best, from_afar, *near)), key=gain)


def _around(grid: Range | EventTimes | Frequencies, value: float, x: Excitation) -> tuple[float, float]:
    """Between which limits the best of a grid is refined: its neighbours, or the width of a line."""
    if isinstance(grid, Frequencies):
        return value - 1.0 / x.duration, value + 1.0 / x.duration
    values = sorted(grid.values(x))
    place = int(np.argmin(np.abs(np.array(values) - value)))
    return values[max(place - 1, 0)], values[min(place + 1, len(values) - 1)]


def _about_what_it_fits(
    model: Component, settings: dict[str, Any], state: State, failed: dict[str, str]
) -> dict[str, Any]:
    """Settings about which a model is linear, moved to where its coefficients are, unless that leads away from where
    they agree, or the model explains far less there.

    In white noise: what is slow determines such coefficients, and the noise of the regressors themselves is fast. Of a
    delay, the lag that it is sought about hardly matters; if it matters, it is noise of the regressor.
    """
    residual, given = thinned(state, REFINING_SAMPLES)
    score = Scorer(residual, given, WHITE)

    def at(settings: Mapping[str, Any]) -> Terms | None:
        terms = terms_of(model, settings, state.excitation, failed)
        return None if terms is None else terms.at(residual.samples)

    first = terms = at(settings)
    assert model.about is not None
    moved = settings
    last = np.inf
    for _ in range(REFINEMENTS):
        if terms is None:
            return settings
        together = terms if given is None else joined([given, terms])
        theta = estimated(residual, together, WHITE).theta[together.count - terms.count :]
        before, moved = moved, dict(model.about(moved, theta))
        step = max((abs(moved[name] - before[name]) for name in moved if moved[name] != before[name]), default=0.0)
        if step == 0:
            break
        if step >= last:
            return settings
        last = step
        terms = at(moved)
    return moved if first is not None and terms is not None and score(terms) >= MOST_OF_IT * score(first) else settings
