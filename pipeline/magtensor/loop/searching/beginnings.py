"""Responses that lag and did not begin in equilibrium: with which lag and beginning they explain most."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel, Beginning, Orders, profiled
from magtensor.error_models.terms import Terms, joined
from magtensor.golden import golden
from magtensor.loop.evidence.assessment import WHITE, assess, colours_of, estimated_in, left_there, likeliest
from magtensor.loop.evidence.folds import Blocks
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.evidence.lone_event import MOST_LEFT
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.evidence.scoring import Scorer
from magtensor.loop.fitting.model import Adopted, State, generic, regressors
from magtensor.loop.fitting.separation import SEPARATION

WIDEST = 10.0  # a body brought out of a warm car, over the width of what the thermometer tells during the survey
_ALONE = 1e-3  # probability that a channel is taken for seen beside what dies away, in a single test by blocks
_SLOPE = 1e-3  # of the widest beginning, over which the regressors' change is taken


def beginning(model: Component, settings: Mapping[str, Any]) -> tuple[list[str], Beginning] | None:
    """The settings that say what a model began with, a number or the components of a vector; None where it has none, or
    the lag is given."""
    grids = profiled(model)
    found = [(n, g) for n, g in grids.items() if isinstance(g, Beginning) and g.lag in grids]
    names = [n for n, g in found if not settings.get(g.unless)]
    return (names, found[0][1]) if names else None


def lags(model: Adopted) -> float:
    """s, through which a model follows something, from a beginning that is found; 0 of one that does not."""
    found = beginning(model.component, model.settings)
    return 0.0 if found is None else float(model.settings.get(found[1].lag, 0.0))


def extent(model: Component, settings: Mapping[str, Any], x: Excitation) -> float:
    """What a response may be out of equilibrium by: ten times the width of the channel that it follows, or twice the
    field."""
    channel = next(((n, g) for n, g in profiled(model).items() if isinstance(g, AnyChannel)), None)
    if channel is None:
        return 2.0 * float(np.linalg.norm(x.field_or_fields, axis=-1).max())
    name, grid = channel
    return WIDEST * float(np.ptp(x.channel(grid.pick(x, str(settings[name]))), axis=0).max())


def began_with_a_vector(model: Adopted) -> bool:
    """Whether a response that has no channel began with a vector of its own, as iron does: where it lags by as much as
    the survey lasts, that vector with its coefficients is a C that drifts, by any law."""
    found = beginning(model.component, model.settings)
    return found is not None and len(found[0]) > 1 and any(model.settings[name] for name in found[0])


def at_its_limit(model: Component, settings: Mapping[str, Any], x: Excitation) -> bool:
    """Whether a response began as far out of equilibrium as it may at most: then something else dies away."""
    found = beginning(model, settings)
    if found is None:
        return False
    most = (1.0 - _SLOPE) * extent(model, settings, x)
    return any(abs(settings[name]) >= most for name in found[0])


def with_beginning(
    white: Whitened,
    terms: Callable[[Mapping[str, Any]], Terms],
    settings: Mapping[str, Any],
    names: Sequence[str],
    widest: float,
    steps: int = 1,
) -> dict[str, Any] | None:
    """Settings with the beginning that explains most, within limits; None where nothing is explained.

    At first the coefficients and what dies away are fitted freely, then the beginning with the coefficients: they are
    a product, and each step is one of Gauss and Newton.

    Parameters
    ----------
    white: the residual, what is given already in it.
    terms: the regressors of settings, at the residual's samples.
    names: of the settings that say what the response began with, each +-widest at most.
    """
    here = {**settings, **dict.fromkeys(names, 0.0)}
    value = np.zeros(len(names))
    theta = None
    for step in range(steps):
        now = terms(here)
        slopes = _slopes(terms, here, now, names, widest)
        if theta is None:
            dying = slopes[0].only(_moving(slopes[0]))
            free = estimated_in(white, joined([now, dying])).theta
            theta = free[len(free) - dying.count - now.count : len(free) - dying.count]
        outputs = len(white.residual.noise)
        courses = [one_pattern(slope.contribution(theta, outputs), n) for slope, n in zip(slopes, names, strict=True)]
        estimate = estimated_in(white, joined([now, *courses]))
        own = estimate.theta[-now.count - len(names) :]
        theta, moved = own[: now.count], own[now.count :]
        if not np.any(theta):
            return None
        value = np.clip(value + moved, -widest, widest)
        here.update(zip(names, map(float, value), strict=True))
        if np.all(np.abs(moved) < _SLOPE * widest) and step:
            break
    return here


def what_dies_away(
    terms: Callable[[Mapping[str, Any]], Terms], settings: Mapping[str, Any], names: Sequence[str], widest: float
) -> Terms:
    """What a response was out of equilibrium by, with free coefficients and nothing beside it."""
    slope = _slopes(terms, settings, terms(settings), names[:1], widest)[0]
    return slope.only(_moving(slope))  # a vector's components die away in the same outputs


def _slopes(
    terms: Callable[[Mapping[str, Any]], Terms],
    settings: Mapping[str, Any],
    now: Terms,
    names: Sequence[str],
    widest: float,
) -> list[Terms]:
    """The changes of the regressors with what the response began with."""
    step = _SLOPE * widest
    moved = (terms({**settings, name: settings[name] + step}) for name in names)
    return [replace(now, series=(each.series - now.series) / step) for each in moved]


def _moving(slope: Terms) -> list[int]:
    """The numbers of the terms that change."""
    changing = np.any(slope.series != 0.0, axis=0)
    return sorted({int(t) for t, s in zip(slope.part_term, slope.part_series, strict=True) if changing[s]})


def one_pattern(course: np.ndarray[Any, Any], name: str) -> Terms:
    """One coefficient for a pattern (N, 3 S)."""
    outputs = np.arange(course.shape[1])
    return Terms((name,), ("",), ("",), course, np.zeros_like(outputs), outputs, outputs)


def begun(
    model: Component, settings: dict[str, Any], state: State, few: tuple[Residual, Terms | None]
) -> dict[str, Any]:
    """Settings of a model with the lag and the beginning that explain most together, if the data separate them from
    those given. Of powers of a channel the lowest alone is asked.

    What dies away says nothing of the channel. One that nobody wrote a model for is believed for its own course: it has
    to be seen beside what dies away, or it stays in equilibrium.
    """
    found = beginning(model, settings)
    if found is None:
        return settings
    names, mark = found
    residual, given = few
    x = state.excitation
    widest = extent(model, settings, x)

    def terms(changed: Mapping[str, Any]) -> Terms:
        return regressors(model, x, changed).at(residual.samples)

    white = Whitened.of(residual, WHITE.across, WHITE.along, given, over_time=False)
    score = Scorer(residual, given, WHITE)
    grids = profiled(model)
    orders = {n: min(g.options) for n, g in grids.items() if isinstance(g, Orders)}  # squares imitate what dies away

    def with_lag(lag: float) -> dict[str, Any] | None:
        return with_beginning(white, terms, {**settings, **orders, mark.lag: lag}, names, widest)

    def gain(lag: float) -> float:
        found = with_lag(lag)
        return -np.inf if found is None else score(terms(found))

    lags = sorted(v for v in {settings[mark.lag], *grids[mark.lag].values(x)} if v > 0)
    best = with_lag(_refined(gain, lags)) if lags else None
    if best is None:
        return settings
    together = terms(best) if given is None else joined([given, terms(best)])
    fair = Scorer(residual, given, likeliest(residual, together, [colours_of(residual), WHITE]).colours)

    def alone(lag: float) -> Terms:  # warming up, say, and no response to the channel
        return what_dies_away(terms, {**best, mark.lag: lag}, names, widest)

    dying = alone(_refined(lambda lag: fair(alone(lag)), lags))
    if fair(terms(best)) <= max(fair(terms(settings)), fair(dying)) + least_gain(names):
        return settings
    settled = terms({**best, **dict.fromkeys(names, 0.0)})
    if _seen_beside(dying, settled, few):
        return best
    here = what_dies_away(terms, best, names, widest)
    if generic(Adopted(model, best)) or _left_at_the_start(terms(best), here, few) > MOST_LEFT:
        return settings
    return best


def _refined(gain: Callable[[float], float], lags: Sequence[float]) -> float:
    """The lag of the largest gain, between the neighbours of the best of those given."""
    place = max(range(len(lags)), key=lambda i: gain(lags[i]))
    return golden(gain, lags[max(place - 1, 0)], lags[min(place + 1, len(lags) - 1)], lags[place])


def _seen_beside(alone: Terms, settled: Terms, few: tuple[Residual, Terms | None]) -> bool:
    """Whether a response in equilibrium shows and predicts held-out blocks beside what dies away, those in which that
    does so among them."""
    residual, given = few
    beside = alone if given is None else joined([given, alone])
    colours = likeliest(residual, beside, [colours_of(residual), WHITE]).colours
    found = assess(Whitened.of(residual, colours.across, colours.along, beside), settled, everywhere=True)
    return found.p < _ALONE and found.gain.consistent


def _left_at_the_start(began: Terms, dying: Terms, few: tuple[Residual, Terms | None]) -> float:
    """The part that a response leaves of what there is while that dies away which it began with; 0 where that lasts."""
    residual, given = few
    together = began if given is None else joined([given, began])
    theta = likeliest(residual, together, [colours_of(residual), WHITE]).theta
    return left_there(residual, together, theta, together.count - began.count, Blocks.of_an_event(dying))


def least_gain(names: Sequence[str]) -> float:
    """The log likelihood ratio that separates a beginning from equilibrium, the lag having been free as well."""
    return (1 + len(names)) * SEPARATION / 2.0
