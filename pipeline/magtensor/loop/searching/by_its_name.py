"""A response to a channel by the name of the effect that is the same thing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel, profiled
from magtensor.error_models.terms import Terms
from magtensor.loop.fitting.model import Adopted, State, generic
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.rivals import hardly_begun

ALIKE = 0.02  # of the rms: noise of a log that one of them is read with, and no law is known better


def by_its_name(chosen: Candidate, possible: Sequence[Candidate], state: State) -> Candidate:
    """A response that no model names as the first of the possible models that, with its settings, adds the same to the
    outputs but for a constant; itself where there is none. A search of the settings may have ended elsewhere for the
    one than for the other: where the fit without the effect is far off, every lag seems wrong. Not of one that lags by
    half the survey: it is the sum of its channel over time, or a drift, and not every model knows that of its lag."""
    seen = chosen.before or state
    x = seen.excitation
    if not generic(chosen.model) or chosen.moved is not None or hardly_begun(chosen.model, x):
        return chosen
    terms = chosen.model.terms(x)
    for other in possible:
        if generic(other.model):
            continue
        named = _with_its_settings(other.model, chosen.model)
        if _can_follow(named, x, chosen.model.channels(x)) and _the_same(named.terms(x), terms):
            return replace(chosen, model=named, terms=named.terms(x).at(seen.residual.samples))
    return chosen


def _with_its_settings(named: Adopted, model: Adopted) -> Adopted:
    settings = {name: model.settings.get(name, p.default) for name, p in named.component.parameters.items()}
    return replace(named, settings=settings, sensors=model.sensors)


def _can_follow(named: Adopted, x: Excitation, channels: set[str]) -> bool:
    """Whether these are the channels that a model follows, and of the kind that it may follow."""
    marks = [mark for mark in profiled(named.component).values() if isinstance(mark, AnyChannel)]
    return named.channels(x) == channels and all(channels <= set(mark.values(x)) for mark in marks)


def _the_same(one: Terms, other: Terms) -> bool:
    """Whether terms add the same series to the same outputs, each but for a constant, which C and o take."""
    if one.series.shape != other.series.shape or (one.delay is None) != (other.delay is None):
        return False
    parts = ("sensors", "part_term", "part_output", "part_series", "part_weight")
    if not all(np.array_equal(getattr(one, name), getattr(other, name)) for name in parts):
        return False
    size, apart = (float(np.sqrt(np.mean(np.var(m, axis=0)))) for m in (other.series, one.series - other.series))
    return apart <= ALIKE * size
