"""Responses that lag and did not begin in equilibrium: with which lag and beginning they explain most."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from magtensor.components import Component
from magtensor.loop.assessment import WHITE, colours_of, estimated_in, likeliest
from magtensor.loop.evidence import Whitened
from magtensor.loop.excitation import Excitation
from magtensor.loop.golden import golden
from magtensor.loop.model import State, regressors
from magtensor.loop.residual import Residual
from magtensor.loop.scoring import Scorer
from magtensor.loop.separation import SEPARATION
from magtensor.loop.settings import AnyChannel, Beginning, Orders, profiled
from magtensor.loop.terms import Terms, joined


def beginning(model: Component, settings: Mapping[str, Any]) -> tuple[str, Beginning] | None:
    """The setting that says what a model began with; None where it has none, or the lag is given."""
    grids = profiled(model)
    found = ((n, g) for n, g in grids.items() if isinstance(g, Beginning) and g.lag in grids)
    return next(((n, g) for n, g in found if not settings.get(g.unless)), None)


def extent(model: Component, settings: Mapping[str, Any], x: Excitation) -> float:
    """The width of the channel that a model follows: what its response may be out of equilibrium by."""
    channel, grid = next((n, g) for n, g in profiled(model).items() if isinstance(g, AnyChannel))
    return float(np.ptp(x.channel(grid.pick(x, str(settings[channel]))), axis=0).max())


def begun(
    model: Component, settings: dict[str, Any], state: State, few: tuple[Residual, Terms | None]
) -> dict[str, Any]:
    """Settings of a model with the lag and the beginning that explain most together, if the data separate them from
    those given.

    For each lag the coefficients of the channel and of what dies away are fitted freely; the beginning is the part of
    the first that is in the second. Of powers of the channel the lowest alone is asked.
    """
    found = beginning(model, settings)
    if found is None:
        return settings
    name, mark = found
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
        at_rest = {**settings, **orders, mark.lag: lag, name: 0.0}
        rest, moved = terms(at_rest), terms({**at_rest, name: widest})
        dying = replace(moved, series=moved.series - rest.series)
        estimate = estimated_in(white, joined([rest, dying]))
        size = rest.count
        own, its = estimate.theta[-2 * size : -size], estimate.theta[-size:]
        weights = estimate.normal[-2 * size : -size, -2 * size : -size]
        power = float(own @ weights @ own)
        if not power > 0:
            return None
        return {**at_rest, name: widest * float(np.clip(own @ weights @ its / power, -1.0, 1.0))}

    def gain(lag: float) -> float:
        found = with_lag(lag)
        return -np.inf if found is None else score(terms(found))

    lags = sorted(v for v in {settings[mark.lag], *grids[mark.lag].values(x)} if v > 0)
    nearest = max(range(len(lags)), key=lambda i: gain(lags[i]), default=None)
    best = None if nearest is None else with_lag(lags[nearest])
    if nearest is None or best is None:
        return settings
    together = terms(best) if given is None else joined([given, terms(best)])
    fair = Scorer(residual, given, likeliest(residual, together, [colours_of(residual), WHITE]).colours)
    if fair(terms(best)) <= fair(terms(settings)) + SEPARATION:
        return settings
    low, high = lags[max(nearest - 1, 0)], lags[min(nearest + 1, len(lags) - 1)]
    return with_lag(golden(gain, low, high, lags[nearest])) or best
