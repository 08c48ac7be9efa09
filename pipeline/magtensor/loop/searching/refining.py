"""The settings of an error model between those of its grid: the best, by golden section or along its own derivative."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import Cleaned, EventTimes, Frequencies, Range, profiled
from magtensor.error_models.terms import Terms, joined
from magtensor.golden import REFINEMENTS, golden
from magtensor.loop.evidence.assessment import WHITE, colours_of, estimated, likeliest
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.evidence.scoring import Scorer
from magtensor.loop.fitting.model import State
from magtensor.loop.fitting.separation import SEPARATION
from magtensor.loop.searching.beginnings import begun
from magtensor.loop.searching.delayed_logs import as_a_whole
from magtensor.loop.searching.profiling import REFINING_SAMPLES, of_ratios, terms_of, thinned

MOST_OF_IT = 0.75  # of what a model explains, if it is to be made about other settings
_OF_A_LINE = 16  # to a thousandth of its width
_GOLDEN = 0.4812  # log of what a step of a golden section divides by
_SAMPLES_ABOUT = 6  # to either side of an event's time in white noise


def refined(model: Component, settings: dict[str, Any], state: State, failed: dict[str, str]) -> dict[str, Any]:
    """Settings on a range, moved between the neighbours of the best grid value by golden section; a lag of none stays
    one where the data do not separate the two, and so does a response in equilibrium at the survey's start."""
    few = thinned(state, REFINING_SAMPLES)
    settings = _without_log_noise(model, settings, state, few, failed)
    for name, grid in profiled(model).items():
        if not isinstance(grid, (Range, EventTimes, Frequencies)):
            continue
        low, high = _around(grid, settings[name], state.excitation)
        if name == as_a_whole(model, settings):
            low, high = settings[name] - state.excitation.spacing, settings[name] + state.excitation.spacing
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
            between = _between_samples(model, state.excitation)
            best = _its_time(gain, Scorer(residual, given, WHITE), at, (low, high), best, between)
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
    between: Array,
) -> float:
    """The time of an event between limits, s, to a sample, `between` any two of which (M,) it may have been.

    In white noise the way to it rises from afar. In noise of the colour that a large jump leaves only the very sample
    explains anything: there it is sought among the samples about the time found in white noise, which may be in a pause
    beside them.
    """
    low, high = limits

    def in_white(value: float) -> float:
        found = at(value)
        return -np.inf if found is None else white(found)

    spacing = float(np.median(np.diff(between))) if len(between) > 1 else high - low
    steps = int(np.clip(np.ceil(np.log(max((high - low) / spacing, 2.0)) / _GOLDEN), REFINEMENTS, _OF_A_LINE))
    about = golden(in_white, low, high, best, steps)
    after = int(np.searchsorted(between, about))
    near = between[max(after - _SAMPLES_ABOUT, 0) : after + _SAMPLES_ABOUT]
    from_afar = golden(gain, low, high, best)
    return max((float(v) for v in (best, from_afar, *near)), key=gain)


def _between_samples(model: Component, x: Excitation) -> Array:
    """(M,) s after the start: the middle between any two samples, or, of what happens to the base station and shows
    from a reading on, between any two of its readings during the survey."""
    at = x.elapsed
    if model.effect == "reference":
        at = x.readings.time - x.start
        at = at[max(np.searchsorted(at, 0.0) - 1, 0) : np.searchsorted(at, x.duration) + 1]
    return np.asarray((at[1:] + at[:-1]) / 2.0)


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
