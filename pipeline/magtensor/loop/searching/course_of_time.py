"""Whether a response follows its channel, or any smooth course of time would do.

A thermometer that settles is a smooth course of time, and so is a drift. Seen through a lag, from a beginning that is
fitted, such a channel comes near to many drifts and follows none of them quite. Two questions tell: does the channel
explain anything beside smooth courses of time in its place, and do these explain anything beside the channel. Where it
does not and they do, the data know a course of time that is not the channel's; nor is it where both do, and the channel
by no more, once it is fitted: what goes up once resembles whatever warms up meanwhile, but for a corner that neither
has. And where a far larger one is adopted already, whose law nobody knows, what the channel would explain beside it may
as well be that law's. What lags the field by as much as the survey is long is asked the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import Beginning, Choice, Orders, Range, profiled
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.assessment import WHITE, colours_of, estimated, explained
from magtensor.loop.evidence.residual import Residual, taken_off
from magtensor.loop.fitting.model import Adopted, State, generic
from magtensor.loop.remainder.curve_of_a_channel import as_a_course, of_one_curve
from magtensor.loop.searching.beginnings import beginning, one_pattern
from magtensor.loop.searching.contribution import happens_once, put_back_one
from magtensor.loop.searching.gates import OF_THE_LAW, Candidate
from magtensor.loop.searching.kin import TIME, drivers, explained_by_courses
from magtensor.loop.searching.profiling import REFINING_SAMPLES, thinned
from magtensor.loop.searching.rivals import hardly_begun, overlaps

COURSES = 8  # polynomials of the root of time, which is steep at the start: a thirtieth of the survey is resolved there
FIRST_LEFT = 2 * COURSES  # the lowest cosine frequency at which they leave the slow noise that there is
SEEN = 1e-3  # probability that noise makes a channel explain as much beside them
MORE = 1e-5  # the same of them beside a channel: slow noise is not known to better than that
MORE_OF_ITS_OWN = 2.0  # times what they explain beside a channel that it explains beside them, if both do
OF_ITS_OWN = 0.05  # of what a channel explains, that they do not: less than a quarter of its size
MISSED = 0.1  # of the sum of squares, by the law of a drift: a third of its size, as a line misses of what slows down
THE_FIELD = "/the field"  # no name of a channel has a slash
STEP = 0.01  # of a setting, over which the change of what it explains is taken


@dataclass(frozen=True)
class BesideTime:
    """What smooth courses of time say of a response.

    Attributes:
        seen: whether its channel explains anything beside them.
        refused: why it is no more than one of them; "" where it may be.
    """

    seen: bool
    refused: str = ""


def beside_time(candidate: Candidate, state: State) -> BesideTime:
    """What smooth courses of time in the place of its channel say of a candidate, or of the field if it lags that; of
    one without either nothing."""
    before, model = candidate.before or state, candidate.model
    theta = candidate.assessment.theta[-candidate.terms.count :]
    compared = None if candidate.moved is not None else _compared(model, theta, before)
    if compared is None or compared.seen:
        return BesideTime(True)
    x, name = before.excitation, compared.name
    if candidate.assessment.gain.total <= MISSED * explained_by_courses(state, candidate):
        return BesideTime(
            False, f"{compared.said} explains nothing beside smooth courses of time, and a drift is adopted"
        )
    if compared.of_time:
        return BesideTime(False, f"smooth courses of time explain more than {compared.said}, and leave it nothing")
    if name != THE_FIELD and hardly_begun(model, x):
        return BesideTime(
            False, f"{compared.said}, seen through a lag of more than half of the survey, is a drift like any other"
        )
    return BesideTime(False)


def outweighed(state: State, which: int) -> str:
    """Why an adopted response is one of those courses after all, now that its form and settings are at their best: they
    explain about as much beside it as it does beside them; "" where they do not, and where much of what it explains is
    its own: then they are of another effect. Of a model that names its effect they may be a second time constant, or a
    drift beside it, that is found next."""
    if not generic(state.adopted[which]):
        return ""
    compared = _compared(state.adopted[which], state.theta[which], put_back_one(state, which))
    if compared is None or not compared.of_time or compared.channel > OF_ITS_OWN * compared.whole:
        return ""
    if compared.channel > MORE_OF_ITS_OWN * compared.time:
        return ""
    return f"fitted, smooth courses of time explain as much beside {compared.said} as it does beside them"


@dataclass(frozen=True)
class _Compared:
    """What a response and smooth courses of time explain beside each other.

    Attributes:
        name: what it follows.
        channel, time: squares that it explains beside them, and they beside it, more than noise would.
        whole: that it explains without them.
        seen, of_time: whether noise would not; and, for them, whether these courses with the coefficients of the
            channel would not be noise either.
    """

    name: str
    channel: float
    time: float
    whole: float
    seen: bool
    of_time: bool

    @property
    def said(self) -> str:
        """The name in words."""
        return self.name.removeprefix("/")


def _compared(model: Adopted, theta: Array, before: State) -> _Compared | None:
    """A response with coefficients, and courses in the place of its channel, each beside the other and what is given;
    None of what follows neither one channel nor the field."""
    x = before.excitation
    name = _followed(model, x)
    if not name:
        return None
    residual, given = thinned(before, REFINING_SAMPLES)
    held = [] if given is None else [given]
    own = _with_slopes(model, theta, x).at(residual.samples)
    apart = [made.at(residual.samples) for made in _of_time(model, x, name)]
    courses = joined(apart)
    alike = courses if name == THE_FIELD else _of_its_pattern(apart, theta, x)
    station = joined([x.on_reference(course, "nT", "") for course in _courses(x)[residual.samples].T])
    every = joined([*held, own, courses])
    left = taken_off(residual, every, estimated(residual, every, WHITE).theta)
    colours = colours_of(left, stiff=True, above=FIRST_LEFT)
    # what of the reference is slow, and has no name yet, is in |b| - F alone, and courses would explain it
    between = residual if residual.across is None else replace(residual, along=None)

    def explains(seen: Residual, *terms: Terms) -> float:
        return explained(estimated(seen, joined([*held, *terms]), colours))

    channel = explains(residual, own, courses) - explains(residual, courses)
    time = explains(between, own, courses) - explains(between, own)
    pattern = explains(residual, own, station, alike) - explains(residual, own, station)
    return _Compared(
        name,
        channel - own.count,
        time - courses.count,
        explains(residual, own) - (explains(residual) if held else 0.0),
        _chance(channel, own.count) < SEEN,
        _chance(time, courses.count) < MORE and _chance(pattern, alike.count) < SEEN,
    )


def is_a_course(model: Adopted, x: Excitation) -> bool:
    """Whether a model is of what drifts or settles, all along."""
    return TIME in drivers(model, x) and not happens_once(model)


def rivals_in_time(candidate: Candidate, possible: Sequence[Candidate], state: State) -> set[str]:
    """The models of what drifts or settles most of which a candidate predicts as well."""
    of_time = (c for c in possible if is_a_course(c.model, state.excitation))
    return {c.model.name for c in of_time if c is not candidate and overlaps(c, candidate, state)}


def responses_like(drift: Candidate, courses: Sequence[Candidate], state: State) -> set[str]:
    """The models of responses that are refused for smooth courses of time and predict most of what a drift does: it is
    one of those courses, and nothing tells which of them there is."""
    if not courses or not is_a_course(drift.model, state.excitation):
        return set()
    return {c.model.name for c in courses if overlaps(drift, c, state)}


def channels_in_time(drift: Candidate, state: State) -> list[str]:
    """The channels any curve of which explains as much as a drift does, for they went on as time did; none of what is
    no drift."""
    if not is_a_course(drift.model, state.excitation):
        return []
    theta = drift.assessment.theta[-drift.terms.count :]
    return as_a_course(drift.before or state, drift.terms, theta, drift.assessment.colours)


def one_curve(event: Candidate, state: State) -> str:
    """The channel any curve of which explains as much as an adopted drift and an event beside it, in words; "" where
    there is none."""
    seen = event.before or state
    theta, colours = event.assessment.theta[-event.terms.count :], event.assessment.colours
    for place, model in enumerate(seen.adopted):
        if is_a_course(model, seen.excitation):
            own = model.terms(seen.excitation).at(seen.residual.samples)
            both = [(own, seen.theta[place]), (event.terms, theta)]
            if channel := of_one_curve(put_back_one(seen, place), both, colours, OF_THE_LAW):
                return f"a curve of {channel} explains as much as {model.name} and it together"
    return ""


def _followed(model: Adopted, x: Excitation) -> str:
    """What a response follows: its one channel, or the field if it lags that; "" for neither, and for several."""
    channels = model.channels(x)
    if not channels:
        return "" if beginning(model.component, model.settings) is None else THE_FIELD
    (name, *others) = channels
    return "" if others else name


def _with_slopes(model: Adopted, theta: Array, x: Excitation) -> Terms:
    """A model's terms, and how what they explain changes with its settings on a range, which are not at their best
    yet: a thousandth of them is more than noise beside a large effect."""
    outputs = 3 * len(x.sensors)
    here = model.terms(x)
    slopes = []
    for name, grid in profiled(model.component).items():
        if isinstance(grid, (Range, Beginning)) and model.settings[name]:
            moved = replace(model, settings={**model.settings, name: (1.0 + STEP) * model.settings[name]})
            change = moved.terms(x).contribution(theta, outputs) - here.contribution(theta, outputs)
            slopes.append(one_pattern(change / STEP, name))
    return joined([here, *slopes])


def _courses(x: Excitation) -> Array:
    """(N, K) smooth courses of time."""
    part = (x.time - x.time[0]) / max(x.duration, 1e-300)
    return np.asarray(np.polynomial.legendre.legvander(2.0 * np.sqrt(part) - 1.0, COURSES)[:, 1:])


def _of_time(model: Adopted, x: Excitation, name: str) -> list[Terms]:
    """What a model makes of each smooth course of time in the place of its channel; of the field, offsets."""
    courses = _courses(x)
    if name == THE_FIELD:
        return [x.offsets(course, "nT") for course in courses.T]
    settings = _plain(model)
    shape = x.logged[name].shape
    made = []
    for course in courses.T:
        logged = np.broadcast_to(course.reshape(-1, *(1,) * (len(shape) - 1)), shape)
        seen = replace(x, logged={**x.logged, name: logged}, courses={})
        made.append(replace(model, settings=settings).terms(seen))
    return made


def _of_its_pattern(courses: Sequence[Terms], theta: Array, x: Excitation) -> Terms:
    """The same with the coefficients that the channel has: one cause that follows another course of time would have
    these, and slow noise, each output's own, has not."""
    outputs = 3 * len(x.sensors)
    if courses[0].count > len(theta):
        return joined(list(courses))
    made = (terms.contribution(theta[: terms.count], outputs) for terms in courses)
    return joined([one_pattern(series, f"course {k}") for k, series in enumerate(made)])


def _plain(model: Adopted) -> Mapping[str, Any]:
    """Its settings with the first power of the channel, without a lag where there may be none."""
    found = dict(model.settings)
    for setting, grid in profiled(model.component).items():
        if isinstance(grid, Beginning) or (isinstance(grid, Range) and grid.low <= 0.0):
            found[setting] = 0.0
        elif isinstance(grid, Orders) or (isinstance(grid, Choice) and not isinstance(grid.options[0], bool)):
            found[setting] = grid.options[0]
    return found


def _chance(explained: float, coefficients: int) -> float:
    """Probability that so many coefficients explain as much of noise of unit variance."""
    from scipy.special import chdtrc

    return float(chdtrc(max(coefficients, 1), max(explained, 0.0)))
