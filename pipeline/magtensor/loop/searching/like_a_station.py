"""Whether an error of the base station would look the same as an adopted model, or as what is left of |b| - F.

What a vector in the sensors' axes makes of it turns with the platform, and no error of a station does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.needs import measured
from magtensor.error_models.settings import EventTimes, profiled
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.assessment import WHITE, Colours, assess, estimated, estimated_in, explained
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.fitting.model import Adopted, State, of_time
from magtensor.loop.searching.contribution import a_tone, moments, put_back, slices, tones_of
from magtensor.loop.searching.kin import TIME, drivers

APART_ALPHA = 1e-4  # what no station does has to be as unlikely by chance
HARDLY = 1e-3  # of the squares of |b| - F: a thirtieth of its size, to which the law of a drift is hardly known
A_PART = 0.1  # of what a model explains of |b| - F has to be none of a station's
COURSES = 20  # half waves over the survey: what a station does slowly, whatever the cause
MORE_COURSES = 40  # the same of what is left, of which nobody knows how fast it is
EACH = 20  # samples at least for each of them
MOST_CHANNELS = 3
CLEARLY = 2.0  # times what a station explains beside it: what neither is, both explain alike
MOSTLY = 0.5  # of what is left, beside white noise, is slow: of the platform or of a station


def as_a_station_would(state: State, place: int) -> bool:
    """Whether a base station that drifts, jumps when an adopted model does, or follows its channels, would look the
    same as it; or the field itself, where a constant stands for a station.

    It would where the model explains nothing of what differs between the sensors, or a thousandth of what it explains
    of |b| - F, and next to nothing of this beside courses that all sensors see alike. What a vector in their axes makes
    turns with the platform: no station does that.
    """
    single = len(state.excitation.sensors) == 1
    if state.residual.along is None or (single and not a_tone(state.adopted[place])):
        return False
    assert state.terms is not None
    own = slices(state)[place]
    mine, numbers = state.terms.only(range(own.start, own.stop)), range(state.terms.count)
    others = state.terms.only(i for i in numbers if not own.start <= i < own.stop)
    back, colours = put_back(state.residual, mine, state.theta[place]), state.colours
    along = replace(back, across=None)
    if state.residual.across is not None:
        apart, by_chance = _beyond(replace(back, along=None), colours, mine, [others])
        if by_chance <= APART_ALPHA and apart > HARDLY * _beyond(along, colours, mine, [others])[0]:
            return False
    alike = _of_a_station(state.excitation, state.adopted[place], back.samples)
    turning, by_chance = _beyond(along, colours, mine, [others, alike])
    either = turning + _beyond(along, colours, alike, [others])[0]
    return by_chance > APART_ALPHA or turning < A_PART * either


def stations_like(state: State, models: Sequence[Component]) -> set[str]:
    """Names of the models of a base station that would look the same as the last adopted model, if that is of a course
    of time or an event and all sensors show it alike: a drift of all their scale factors, or a jump."""
    last = state.adopted[-1]
    if last.component.effect != "instrument" or drivers(last, state.excitation) != {TIME}:
        return set()
    if not as_a_station_would(state, len(state.adopted) - 1):
        return set()
    times = len(moments(last))
    like = (m for m in models if m.effect == "reference" and of_time(m))
    return {m.name for m in like if times == sum(isinstance(g, EventTimes) for g in profiled(m).values())}


def only_a_constant(x: Excitation) -> bool:
    """Whether a constant stands for a base station: what the field does meanwhile nobody recorded."""
    return x.total_field is not None and not measured(x.total_field)


def turns_with_the_platform(state: State) -> bool:
    """Whether most of what is left of |b| - F is what a field fixed to the platform would make, whatever its course,
    rather than courses of all sensors alike; and more of it than chance and the sensors' own slow noise, as they differ
    by it, would make."""
    residual, x = state.residual, state.excitation
    count = min(MORE_COURSES, len(residual.samples) // EACH)
    if residual.along is None or not count:
        return False
    slow = _half_waves(x, count)[residual.samples]
    fixed = _on_the_platform(x, slow)
    as_many = _half_waves(x, 3 * count)[residual.samples]  # what turns is faster, and follows what is faster
    station = joined([x.on_reference(course, "nT", "") for course in as_many.T])
    given, along = [] if state.terms is None else [state.terms], replace(residual, across=None)
    together = _beyond(along, WHITE, joined([fixed, station]), given)[0]
    if together <= MOSTLY * (float(np.sum(residual.along**2)) - len(residual.along)):
        return False
    turning, steady = (
        _beyond(along, WHITE, fixed, [*given, station])[0],
        _beyond(along, WHITE, station, [*given, fixed])[0],
    )
    return turning > CLEARLY * steady and _beyond(along, state.colours, fixed, [*given, station])[1] <= APART_ALPHA


def channels_of_the_total_field(state: State, alpha: float) -> list[str]:
    """Logged channels that what is left of |b| - F follows, alike in all sensors, in the order of what they explain
    beside each other; at most so many as tell what it is.

    Parameters
    ----------
    alpha: probability that noise alone makes any follow it.
    """
    x, residual = state.excitation, replace(state.residual, across=None)
    open_ = {name: c for name, c in x.logged.items() if np.ndim(c) == 1 and np.isfinite(c).all() and np.ptp(c) > 0}
    found: list[str] = []
    given = [] if state.terms is None else [state.terms]
    while residual.along is not None and open_ and len(found) < MOST_CHANNELS:
        white = Whitened.of(residual, state.colours.across, state.colours.along, joined(given) if given else None)
        terms = {name: x.on_reference(c / np.std(c), "nT", name).at(residual.samples) for name, c in open_.items()}
        each = {name: assess(white, own) for name, own in terms.items()}
        best = max(each, key=lambda name: each[name].gain.total)
        if not (each[best].p * len(x.logged) < alpha and each[best].gain.consistent):
            break
        found.append(best)
        given.append(terms[best])
        del open_[best]
    return found


def _on_the_platform(x: Excitation, courses: Array) -> Terms:
    """Fields along the three axes of the platform, each with each of the courses (N, K), as all sensors see them."""
    outputs, count = 3 * len(x.sensors), courses.shape[1]
    term, output = np.divmod(np.arange(3 * count * outputs), outputs)
    axis, course = np.divmod(term, count)
    names = tuple(f"{a}{k}" for a in "xyz" for k in range(count))
    weight = x.matrix.reshape(outputs, 3)[output, axis]
    return Terms(names, ("",) * len(names), ("nT",) * len(names), courses, term, output, course, part_weight=weight)


def _half_waves(x: Excitation, count: int) -> Array:
    elapsed = (x.time - x.time[0]) / max(x.duration, 1e-9)
    return np.asarray(np.cos(np.pi * np.outer(elapsed, np.arange(1, count + 1))))


def _of_a_station(x: Excitation, model: Adopted, samples: NDArray[np.int_]) -> Terms:
    """Courses of the total field that all sensors see alike, at some samples: slow ones, the tone of a model, jumps at
    its times, and those of a channel of it as it is logged and as the model follows it, with their squares."""
    lag = float(model.settings.get("lag_s", 0.0))
    followed = [_powers(x.channel(c, s)) for c in sorted(model.channels(x)) for s in dict.fromkeys((0.0, lag))]
    turns = 2.0 * np.pi * np.outer(x.elapsed, tones_of(model))
    jumps = (x.elapsed[:, None] >= moments(model)).astype(float)
    courses = np.hstack([_half_waves(x, COURSES), np.cos(turns), np.sin(turns), jumps, *followed])[samples]
    return joined([x.on_reference(course, "nT", "") for course in courses.T])


def _powers(channel: Array) -> Array:
    columns = channel.reshape(len(channel), -1)
    columns = columns - columns.mean(axis=0)
    columns = columns / np.maximum(np.abs(columns).max(axis=0), 1e-300)
    return np.hstack([columns, columns**2])


def _beyond(residual: Residual, colours: Colours, terms: Terms, given: list[Terms]) -> tuple[float, float]:
    """What terms explain beside the given ones, in noise of unit variance, and how likely chance explains as much."""
    from scipy.special import chdtrc

    if not given:
        alone = estimated(residual, terms, colours)
        return explained(alone), float(chdtrc(max(alone.rank, 1), explained(alone)))
    white = Whitened.of(residual, colours.across, colours.along, joined(given), over_time=False)
    with_them, without = estimated_in(white, terms), estimated_in(white, None)
    gained, rank = max(explained(with_them) - explained(without), 0.0), with_them.rank - without.rank
    return gained, float(chdtrc(rank, gained)) if rank > 0 else 1.0
