"""Whether what an effect explains is any curve of a logged channel: the law of a cause is seldom a power of it.

A dead zone, a root, a square with a sign: of such a law of a channel a power explains most, and what is left of it
rises and falls as the channel does. A stretch of it looks like an event, and a slow part like the law of another cause.
Along the direction that the effect has at the sensors, straight lines between values of the channel are asked how much
they explain on blocks that lie between others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.curves import along_a_curve, bends_of
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.assessment import Colours
from magtensor.loop.evidence.gains import interleaved_gain
from magtensor.loop.evidence.grams import Whitened, grams_in
from magtensor.loop.fitting.model import Adopted, State
from magtensor.loop.fitting.separation import SEPARATION
from magtensor.loop.remainder.changing_matrix import BLOCKS, LEAST_SAMPLES

PIECES = (4, 8, 16)
HALF = 0.5
ONE_WAVEFORM = 0.9  # of the square of what an effect adds: then its outputs share one


def event_of_a_curve(state: State, terms: Terms, theta: Array, colours: Colours) -> str:
    """The channel of an adopted model any curve of which explains most of what something that happens once does: it
    explains as much, or beside it the event explains no half of what it does alone; "" where none does.

    Parameters
    ----------
    state: without it; terms: at the residual's samples; theta: (P,).
    """
    courses = [course for model in state.adopted for course in followed(model, state.excitation)]
    along = _Along.of(state, terms, theta, colours) if courses else None
    return "" if along is None else next((name for name, values in courses if along.is_of_a_curve(values)), "")


def event_of_an_axis(state: State, terms: Terms, theta: Array, colours: Colours) -> bool:
    """Whether something that happened once is on one axis of a sensor, and any curve of what this reads explains most
    of it, as above: it stayed where its transfer curve bends. Parameters as above."""
    along = _Along.of(state, terms, theta, colours)
    if along is None:
        return False
    square = (along.direction / state.residual.noise) ** 2
    axis = int(np.argmax(square))
    read = state.excitation.output.reshape(len(state.excitation.time), -1)[:, axis]
    return bool(square[axis] > HALF * square.sum()) and along.is_of_a_curve(read)


def another_curve(state: State, model: Adopted, terms: Terms, theta: Array, colours: Colours) -> str:
    """The channel any curve of which explains more than a model does that follows another one, and more than any curve
    of that one; "" where none does. Parameters as above."""
    x = state.excitation
    own = {name for name in model.channels(x) if not x.is_vector(name)}
    along = _Along.of(state, terms, theta, colours) if own else None
    if along is None:
        return ""
    gains = {n: along.best_curve(v)[0] for n, v in x.logged.items() if not x.is_vector(n) and n not in own}
    best = max(gains, key=lambda name: gains[name], default="")
    known = max([along.gain(along.waveform), *(along.best_curve(v)[0] for _, v in followed(model, x))])
    return best if best and gains[best] > known + SEPARATION else ""


def as_a_course(state: State, terms: Terms, theta: Array, colours: Colours) -> list[str]:
    """The channels any curve of which, seen once or more often, explains as much as a course of time does: they go on
    as time does, and nothing tells which of them it is. Parameters as above."""
    along = _Along.of(state, terms, theta, colours)
    return [] if along is None else along.explained_anywhere(along.waveform, state.excitation)


def of_one_curve(state: State, models: Sequence[tuple[Terms, Array]], colours: Colours, missed: float) -> str:
    """The channel any curve of which, seen once or more often, explains as much as several models with coefficients
    do, but for a part that pieces of it may miss; "" where there is none, or they have no direction in common. The
    state is without them."""
    together, theta = joined([terms for terms, _ in models]), np.concatenate([theta for _, theta in models])
    along = _Along.of(state, together, theta, colours)
    if along is None:
        return ""
    each = [terms.contribution(theta, len(along.direction)) @ along.direction for terms, theta in models]
    return next(iter(along.explained_anywhere(np.column_stack(each), state.excitation, missed)), "")


@dataclass(frozen=True)
class _Along:
    """The direction at the sensors along which an effect acts, and what series (N, K) explain along it on blocks that
    lie between others.

    Attributes:
        waveform: (N, 1) of the effect; direction: (3 S,) nT.
    """

    white: Whitened
    waveform: Array
    direction: Array

    @classmethod
    def of(cls, state: State, terms: Terms, theta: Array, colours: Colours) -> _Along | None:
        """None of a survey that is too short, or where the outputs share no waveform."""
        residual = state.residual
        if len(residual.affine) < LEAST_SAMPLES:
            return None
        waveform, size, direction = np.linalg.svd(terms.contribution(theta, len(residual.noise)), full_matrices=False)
        if size[0] ** 2 < ONE_WAVEFORM * np.sum(size**2) or size[0] == 0.0:
            return None
        white = Whitened.of(residual, colours.across, colours.along, state.terms)
        return cls(white, waveform[:, :1], direction[0] * size[0])

    def gain(self, series: Array) -> float:
        """What series explain."""
        blocks = grams_in(self.white, _series_along(self.direction, series), BLOCKS)
        given = np.arange(blocks.count) < blocks.count - series.shape[1]
        every = np.ones(blocks.count, dtype=bool)
        return float(interleaved_gain(blocks, self.white.residual.freedom, given, every).total)

    def explained_anywhere(self, series: Array, x: Excitation, missed: float = 0.0) -> list[str]:
        """The channels with one value the best curve of which, bending anywhere, explains as much as series do, but for
        a part."""
        least = (1.0 - missed) * self.gain(series) - SEPARATION
        scalars = ((name, values) for name, values in x.logged.items() if not x.is_vector(name))
        return [name for name, values in scalars if self.best_curve(values, anywhere=True)[0] >= least]

    def is_of_a_curve(self, values: Array) -> bool:
        """Whether the best curve of some values explains as much, or leaves less than half of it."""
        gain, curve = self.best_curve(values)
        if curve is None:
            return False
        alone = self.gain(self.waveform)
        beside = self.gain(np.column_stack([curve, self.waveform])) - gain
        return gain > alone - SEPARATION or beside < HALF * alone

    def best_curve(self, values: Array, *, anywhere: bool = False) -> tuple[float, Array | None]:
        """What the best curve of a channel (N,) or (N, S) of all samples explains, and its series; of a constant -inf
        and None. It bends `anywhere`, or only at values that the survey had at two times."""
        column = (values if values.ndim == 1 else values.mean(axis=1))[self.white.residual.samples]
        if np.ptp(column) == 0:
            return -np.inf, None
        low, high = float(column.min()), float(column.max())
        knots = [tuple(np.linspace(low, high, n + 1)[1:-1]) if anywhere else bends_of(column, n) for n in PIECES]
        curves = [along_a_curve(column, bends) for bends in knots]
        every = [np.column_stack([c for _, c in curve]) for curve in curves]
        return max(((self.gain(series), series) for series in every), key=lambda each: each[0])


def followed(model: Adopted, x: Excitation) -> list[tuple[str, Array]]:
    """The channels with one value, or one for each sensor, that a model follows, each with its course through the
    model's lag."""
    lag, delayed = max(float(model.settings.get("lag_s", 0.0)), 0.0), bool(model.settings.get("delayed", False))
    names = sorted(name for name in model.channels(x) if not x.is_vector(name))
    return [(name, x.channel(name, lag, delayed)) for name in names]


def _series_along(direction: Array, series: Array) -> Terms:
    """One coefficient for each of the series (N, K), which add to the outputs along a direction (3 S,)."""
    count, outputs = series.shape[1], np.arange(len(direction))
    each = np.repeat(np.arange(count), len(outputs))
    return Terms(
        tuple(f"series {k}" for k in range(count)), ("",) * count, ("nT",) * count, series, each,
        np.tile(outputs, count), each, part_weight=np.tile(direction, count),
    )  # fmt: skip
