"""Whether an error of the base station would look the same as an adopted model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.assessment import Colours, estimated_in, explained
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.fitting.model import Adopted, State
from magtensor.loop.searching.contribution import put_back, slices

APART_ALPHA = 1e-4  # what no station does has to be as unlikely by chance
A_PART = 0.1  # of what a model explains of |b| - F has to be none of a station's
COURSES = 20  # half waves over the survey: what a station does slowly, whatever the cause


def as_a_station_would(state: State, place: int) -> bool:
    """Whether a base station that drifts, or follows the channels of an adopted model, would look the same as it.

    It would where the model explains nothing of what differs between the sensors, and next to nothing of |b| - F beside
    courses that all sensors see alike. What a vector in their axes makes turns with the platform: no station does that.
    """
    if state.residual.across is None or state.residual.along is None:
        return False
    assert state.terms is not None
    own = slices(state)[place]
    mine, numbers = state.terms.only(range(own.start, own.stop)), range(state.terms.count)
    others = state.terms.only(i for i in numbers if not own.start <= i < own.stop)
    back, colours = put_back(state.residual, mine, state.theta[place]), state.colours
    if _beyond(replace(back, along=None), colours, mine, [others])[1] <= APART_ALPHA:
        return False
    along = replace(back, across=None)
    alike = _of_a_station(state.excitation, state.adopted[place]).at(back.samples)
    turning, by_chance = _beyond(along, colours, mine, [others, alike])
    either = turning + _beyond(along, colours, alike, [others])[0]
    return by_chance > APART_ALPHA or turning < A_PART * either


def _of_a_station(x: Excitation, model: Adopted) -> Terms:
    """Courses of the total field that all sensors see alike: slow ones, and those of a model's channels as they are
    logged and as it follows them, with their squares."""
    elapsed = (x.time - x.time[0]) / max(x.duration, 1e-9)
    slow = np.cos(np.pi * np.outer(elapsed, np.arange(1, COURSES + 1)))
    lag = float(model.settings.get("lag_s", 0.0))
    courses = [slow, *(_powers(x.channel(c, s)) for c in sorted(model.channels(x)) for s in dict.fromkeys((0.0, lag)))]
    return joined([x.on_reference(course, "nT", str(i)) for i, course in enumerate(np.hstack(courses).T)])


def _powers(channel: Array) -> Array:
    columns = channel.reshape(len(channel), -1)
    columns = columns - columns.mean(axis=0)
    columns = columns / np.maximum(np.abs(columns).max(axis=0), 1e-300)
    return np.hstack([columns, columns**2])


def _beyond(residual: Residual, colours: Colours, terms: Terms, given: list[Terms]) -> tuple[float, float]:
    """What terms explain beside the given ones, in noise of unit variance, and how likely chance explains as much."""
    from scipy.special import chdtrc

    white = Whitened.of(residual, colours.across, colours.along, joined(given), over_time=False)
    with_them, without = estimated_in(white, terms), estimated_in(white, None)
    gained, rank = max(explained(with_them) - explained(without), 0.0), with_them.rank - without.rank
    return gained, float(chdtrc(rank, gained)) if rank > 0 else 1.0
