"""What a waveform that the sensors share is like: a logged channel, or an effect that is in the model already."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.error_models.curves import along_a_curve, bends_of
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.independent import independent
from magtensor.error_models.rates import LARGEST_TURN
from magtensor.error_models.terms import Terms
from magtensor.error_models.waveform import NAME, free_directions
from magtensor.loop.evidence.folds import FOLDS
from magtensor.loop.fitting.model import Record, State
from magtensor.loop.remainder.curve_of_a_channel import PIECES
from magtensor.loop.searching.contribution import happens_once

LIKE_A_CHANNEL = 0.7  # correlation from which a logged channel is the suspect and no hidden source
MOST_LAG = 0.1  # of the survey, in which a channel is compared with the waveform
COMPARED = 400  # points at which it is
MOST_COMPARED = 20000
LEAST_POWER = 1e-9  # of a series' own, below which it is constant there
OF_THE_TURN = 1e-3  # probability that a waveform goes with the turn before by chance
LIKE_AN_EFFECT = 0.9  # cosine; of two directions off the plane of four sensors one pair in a thousand is nearer
ONE_SENSOR = 0.9  # of what something that happened once does
ONE_DIRECTION = 0.9  # of an effect's power
PARTS = 50  # of the survey, between which what follows a channel may begin or end to
MOST_OF_IT = 0.8  # of a waveform's square
MUCH_LESS = 0.5  # of what the channel leaves of it all along
WITHIN = 0.95  # of a waveform's square
FOR_A_WHILE = 0.5  # of the survey
NEARLY_ALL_OF_IT = 0.97  # the same, of one that has but some switchings in common with the channel
SOME = 2.0  # switchings: another course has none of them at the same times
FEW = 8.0  # independent values: any course with fewer is like some channel, through some power and lag
REMEMBERS = 0.3  # of its size, what other samples change of a regressor that remembers the field there


@dataclass(frozen=True)
class Likeness:
    """The channel that a waveform goes with.

    Attributes:
        lag_s: how late the waveform is, s.
        power: of the channel; 1 where it goes with its rate.
        correlation: of the two, with its sign.
        rate: whether it goes with the channel's rate of change.
    """

    channel: str
    lag_s: float
    power: int
    correlation: float
    rate: bool

    @property
    def words(self) -> str:
        """What of the channel it goes with."""
        if self.rate:
            return f"the rate of channel {self.channel}"
        return f"channel {self.channel}" + (f" to the power {self.power}" if self.power > 1 else "")

    @property
    def course(self) -> str:
        """The channel, and what of it if that is its rate."""
        return f"{self.channel} (its rate)" if self.rate else self.channel


def followed(time: Array, values: Array, record: Record) -> Likeness | None:
    """What of a channel comes nearest to a waveform, if anything comes near; of delays of its log either way the
    shortest that does. Means are compared, in which the waveform's noise is less, and samples, for what is fast."""
    best: Likeness | None = None
    for count in sorted({min(COMPARED, len(time)), min(MOST_COMPARED, len(time))}):
        points = np.linspace(time[0], time[-1], count)
        step = points[1] - points[0]
        wave = _means(time, values, points)
        between = 0.5 * (wave[1:] + wave[:-1])  # as smooth as what two neighbouring means differ by
        shifts = _shortest_first(max(1, int(MOST_LAG * count)))
        for name, channel in record.logged.items():
            for column in channel.reshape(len(channel), -1).T:
                sampled = _means(record.time, column, points)
                compared = [(wave, sampled**power, power, False) for power in (1, 2, 3)]
                if min(independent(between), independent(np.diff(sampled))) > FEW:
                    compared.append((between, np.diff(sampled), 1, True))
                for ours, series, power, rate in compared:
                    for shift, c in zip(shifts, _correlations(ours, series, shifts), strict=True):
                        if best is None or abs(c) > abs(best.correlation) + 0.01:
                            best = Likeness(name, float(shift * step), power, float(c), rate)
    return best if best is not None and abs(best.correlation) > LIKE_A_CHANNEL else None


def _shortest_first(most: int) -> NDArray[np.int_]:
    """(2 most + 1,) shifts either way."""
    shifts = np.arange(-most, most + 1)
    return shifts[np.argsort(np.abs(shifts), kind="stable")]


def _correlations(late: Array, early: Array, shifts: NDArray[np.int_]) -> Array:
    """Of two series (n,), the first moved back by each of some shifts, where both are; 0 where one is constant."""
    from scipy.fft import irfft, next_fast_len, rfft

    n = len(late)
    padded = next_fast_len(2 * n - 1, real=True)
    late, early = late - late.mean(), early - early.mean()
    a, b = np.maximum(shifts, 0), np.maximum(-shifts, 0)

    def sums(series: Array, first: NDArray[np.int_], last: NDArray[np.int_]) -> Array:
        total = np.concatenate([[0.0], np.cumsum(series)])
        out: Array = total[last] - total[first]
        return out

    of_late, of_early = sums(late, a, n - b), sums(early, b, n - a)
    overlap = n - np.abs(shifts)
    products = irfft(rfft(late, padded) * rfft(early, padded).conj(), padded)
    both = products[shifts] - of_late * of_early / overlap
    late_power = sums(late**2, a, n - b) - of_late**2 / overlap
    early_power = sums(early**2, b, n - a) - of_early**2 / overlap
    moves = (late_power > LEAST_POWER * late.dot(late)) & (early_power > LEAST_POWER * early.dot(early))
    out: Array = np.where(moves, both / np.sqrt(np.where(moves, late_power * early_power, 1.0)), 0.0)
    return out


def followed_by_a_curve(time: Array, values: Array, record: Record) -> str:
    """The channel with one value, or one for each sensor, any curve of which predicts a waveform best in stretches that
    it was not fitted to; "" where none predicts half of its square."""
    edges = np.linspace(0, len(values), FOLDS + 1).round().astype(int)
    whole = float(held_out_losses(values, np.ones((len(values), 1)), edges).sum())
    shares = {}
    for name, channel in record.logged.items():
        if channel.ndim == 2 and channel.shape[1] == 3 and len(record.sensors) != 3:
            continue
        course = np.interp(time, record.time, channel if channel.ndim == 1 else channel.mean(axis=1))
        curve = along_a_curve(course, bends_of(course, PIECES[-1]))
        columns = np.column_stack([np.ones(len(course)), *(column for _, column in curve)])
        shares[name] = 1.0 - float(held_out_losses(values, columns, edges).sum()) / whole
    best = max(shares, key=lambda name: shares[name], default="")
    return best if best and shares[best] > LIKE_A_CHANNEL**2 else ""


def followed_in_part(time: Array, values: Array, record: Record) -> str:
    """The channel with one value that a waveform follows from some time on, or until then, and rests otherwise, in
    words; "" where none makes most of its square so, and by far more than all along."""
    best, words, whole = 0.0, "", float(np.sum((values - values.mean()) ** 2))
    if whole == 0.0:
        return words
    for name, channel in record.logged.items():
        if channel.ndim > 1:
            continue
        course = np.interp(time, record.time, channel)
        always = _left_by(course, values)
        for edge in np.linspace(0.0, len(time), PARTS + 1).round().astype(int)[PARTS // 10 : -(PARTS // 10)]:
            early, late = slice(None, edge), slice(edge, None)
            for acts, rests, when in ((late, early, "from {:.4g} s on"), (early, late, "until {:.4g} s")):
                left = _left_by(course[acts], values[acts]) + float(np.sum((values[rests] - values[rests].mean()) ** 2))
                share = 1.0 - left / whole
                if share <= max(best, MOST_OF_IT) or left >= MUCH_LESS * always:
                    continue
                least = FEW if share < NEARLY_ALL_OF_IT else SOME
                if _comes_and_goes(course[acts], least) and _comes_and_goes(values[acts], least):
                    best, words = share, f"{name} {when.format(time[edge] - record.time[0])}"
    return words


def followed_by_a_product(time: Array, values: Array, record: Record) -> str:
    """The two channels with one value whose product predicts most of a waveform in stretches that it was not fitted to,
    and far more than the first two powers of each do without it, in words; "" where there are none."""
    if independent(values) <= FEW:
        return ""
    edges = np.linspace(0, len(values), FOLDS + 1).round().astype(int)
    ones = np.ones(len(values))
    least, words = (1.0 - MOST_OF_IT) * float(held_out_losses(values, ones[:, None], edges).sum()), ""
    courses = [(n, np.interp(time, record.time, c)) for n, c in record.logged.items() if c.ndim == 1]
    for (one, a), (other, b) in itertools.combinations(courses, 2):
        both = np.column_stack([ones, a, b, a**2, b**2])  # whose laws may be in the model already
        left = float(held_out_losses(values, np.column_stack([both, a * b]), edges).sum())
        if left < least and left < MUCH_LESS * float(held_out_losses(values, both, edges).sum()):
            least, words = left, f"{one} times {other}"
    return words


def course_words(elapsed: Array, values: Array) -> str:
    """When a waveform does what it does, in words: its switchings, or the part of a survey that it acts in; "" of what
    acts all along.

    Parameters
    ----------
    elapsed: (N,) s after the start; values: (N,).
    """
    switched = np.flatnonzero(np.diff(values))
    if len(np.unique(values)) == 2:
        first, last = elapsed[switched[0] + 1], elapsed[switched[-1] + 1]
        if len(switched) == 1:
            return f"switches at {first:.4g} s"
        return f"switches {len(switched)} times, first at {first:.4g} s and last at {last:.4g} s"
    power = np.cumsum((values - np.median(values)) ** 2)
    if not len(power) or power[-1] <= 0.0:
        return ""
    begins, ends = np.searchsorted(power, np.array([0.5 - WITHIN / 2.0, 0.5 + WITHIN / 2.0]) * power[-1])
    lasts = elapsed[min(ends, len(elapsed) - 1)] - elapsed[begins]
    if lasts > FOR_A_WHILE * (elapsed[-1] - elapsed[0]):
        return ""
    return f"acts from {elapsed[begins]:.4g} to {elapsed[min(ends, len(elapsed) - 1)]:.4g} s"


def _comes_and_goes(course: Array, least: float) -> bool:
    """Whether a course crosses its mean so often that another one hardly does so at the same times."""
    above = course > course.mean()
    return independent(course) > least and int(np.count_nonzero(above[1:] != above[:-1])) > least


def _left_by(course: Array, values: Array) -> float:
    """The square of values (n,) that a straight line of a course (n,) leaves."""
    course, values = course - course.mean(), values - values.mean()
    power = float(course @ course)
    return float(values @ values) - (float(course @ values) ** 2 / power if power > 0.0 else 0.0)


def held_out_losses(series: Array, columns: Array, edges: Array) -> Array:
    """(F,) squares of a series (n,) in folds that columns (n, K) predict from the others."""
    losses = []
    for a, b in itertools.pairwise(edges):
        train = np.r_[0:a, b : len(series)]
        theta = np.linalg.lstsq(columns[train], series[train], rcond=1e-9)[0]
        losses.append(np.sum((series[a:b] - columns[a:b] @ theta) ** 2))
    return np.array(losses)


def _means(time: Array, values: Array, points: Array) -> Array:
    """Means of a series about points in time, those between samples from their neighbours."""
    half = 0.5 * (points[1] - points[0])
    total = np.concatenate([[0.0], np.cumsum(values)])
    first, last = np.searchsorted(time, points - half), np.searchsorted(time, points + half)
    count = last - first
    mean = (total[last] - total[first]) / np.maximum(count, 1)
    out: Array = np.where(count > 0, mean, np.interp(points, time, values))
    return out


def effect_along(state: State, basis: Array, direction: Array) -> str:
    """The adopted error model whose own vector at the sensors is that of a waveform; "" where none is.

    What a strong effect leaves, because its channel was smoothed or lags otherwise than modelled, moves the sensors as
    the effect does, and looks like a source of its own.

    Parameters
    ----------
    basis: (3 S, m) orthonormal, of what lies off the plane that the sensors share, whitened.
    direction: (m,) of the waveform in it.
    """
    size = float(np.linalg.norm(direction))
    for model, theta in zip(state.adopted, state.theta, strict=True):
        terms = model.terms(state.excitation).at(state.residual.samples)
        moved = terms.contribution(theta, len(state.residual.noise)) / state.residual.noise @ basis
        moved = moved - moved.mean(axis=0)
        powers, vectors = np.linalg.eigh(moved.T @ moved)
        if powers[-1] > ONE_DIRECTION * powers.sum() > 0 and abs(vectors[:, -1] @ direction) > LIKE_AN_EFFECT * size:
            return model.name
    return ""


def event_along(state: State, terms: Terms, theta: Array) -> str:
    """The adopted error model that follows a channel, or the source nobody logged, whose own vector at the sensors is
    that of something that happened once; "" where there is none. A law of a channel that no model has, a play or a
    delay that changes, leaves that where it is furthest off, and so does a waveform that was smoothed. Not asked of
    what one sensor makes alone: the three numbers of two such vectors agree by chance one time in ten.

    Parameters
    ----------
    state: without it; terms: at the residual's samples; theta: (P,).
    """
    if state.residual.across is None:
        return ""
    basis = free_directions(np.eye(len(state.residual.noise)) - state.residual.projector)
    moved = terms.contribution(theta, len(state.residual.noise)) / state.residual.noise
    each = np.sum((moved - moved.mean(axis=0)) ** 2, axis=0).reshape(-1, 3).sum(axis=1)
    if each.max() >= ONE_SENSOR * each.sum():  # or what is of the reference, and moves none
        return ""
    direction = np.linalg.svd((moved - moved.mean(axis=0)) @ basis, full_matrices=False)[2][0]
    following = [i for i, a in enumerate(state.adopted) if a.channels(state.excitation) or a.name == NAME]
    some = replace(state, adopted=tuple(state.adopted[i] for i in following))
    return effect_along(replace(some, theta=tuple(state.theta[i] for i in following)), basis, direction)


def part_of_the_source(state: State, place: int) -> bool:
    """Whether an adopted model of something that happened once moves its sensors as the source nobody logged does, that
    was adopted after it: a part of that source's course. Of one sensor the three numbers of two vectors agree by
    chance."""
    event, source = state.adopted[place], next((i for i, a in enumerate(state.adopted) if a.name == NAME), None)
    if source is None or not happens_once(event):
        return False
    outputs = len(state.residual.noise)
    moved = event.terms(state.excitation).contribution(state.theta[place], outputs) / state.residual.noise
    power = np.sum(moved**2, axis=0)
    own = np.repeat(power.reshape(-1, 3).sum(axis=1) > 0, 3)
    if own.sum() <= 3:
        return False
    vector = np.linalg.svd((moved - moved.mean(axis=0))[:, own], full_matrices=False)[2][0]
    other = (state.theta[source] / state.residual.noise)[own]
    return bool(abs(vector @ other) > LIKE_AN_EFFECT * float(np.linalg.norm(other)))


def of_an_unseen_path(state: State) -> list[int]:
    """The places of the adopted models that remember the field where it turns too far from one sample to the next for
    the path between them to be known: static postures. What a turn back and forth on the way does, no sample shows."""
    x = state.excitation
    if x.turns:
        return []
    some = np.arange(0, len(x.time), 2)
    places = []
    for place, model in enumerate(state.adopted):
        if model.name == NAME:
            continue
        whole, part = model.terms(x).series[some], model.terms(x.at(some)).series
        whole, part = whole - whole.mean(axis=0), part - part.mean(axis=0)
        if np.linalg.norm(whole - part) > REMEMBERS * np.linalg.norm(whole):
            places.append(place)
    return places


def with_the_turn_before(x: Excitation, samples: NDArray[np.int_], values: Array) -> bool:
    """Whether a waveform (n,) at some samples goes with how far the field turned since the sample before, where nobody
    saw it turn: what remembers the way to a posture, an eddy current, a filter or a play, makes such a one. On a
    platform that hardly moves meanwhile the source itself turns the field that is seen."""
    from scipy.special import fdtrc

    if x.turns:
        return False
    b = x.field[:, 0] / np.linalg.norm(x.field[:, 0], axis=1, keepdims=True)
    turned = np.diff(b, axis=0, prepend=b[:1])
    if np.mean(np.sum(turned**2, axis=1)) < LARGEST_TURN**2:
        return False
    given = np.column_stack([np.ones(len(samples)), b[samples]])
    without = _left(values, given)
    left = _left(values, np.column_stack([given, turned[samples]]))
    freedom = len(values) - given.shape[1] - 3
    if freedom <= 0 or left <= 0.0:
        return False
    return bool(fdtrc(3, freedom, (without - left) / 3.0 / (left / freedom)) < OF_THE_TURN)


def _left(values: Array, regressors: Array) -> float:
    """Sum of squares of values (n,) that regressors (n, K) leave."""
    return float(np.sum((values - regressors @ np.linalg.lstsq(regressors, values, rcond=None)[0]) ** 2))
