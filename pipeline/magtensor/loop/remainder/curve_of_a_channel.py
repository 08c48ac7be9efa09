"""Whether what an effect explains is any curve of a logged channel: the law of a cause is seldom a power of it.

A dead zone, a root, a square with a sign: of such a law of a channel a power explains most, and what is left of it
rises and falls as the channel does. A stretch of it looks like an event, and a slow part like the law of another cause.
Along the direction that the effect has at the sensors, straight lines between knots of the channel are asked how much
they explain on blocks that lie between others.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.terms import Terms
from magtensor.loop.evidence.assessment import Colours
from magtensor.loop.evidence.gains import interleaved_gain
from magtensor.loop.evidence.grams import Whitened, grams_in
from magtensor.loop.fitting.log_noise import channels_of
from magtensor.loop.fitting.model import Adopted, State
from magtensor.loop.fitting.separation import SEPARATION
from magtensor.loop.remainder.changing_matrix import BLOCKS, LEAST_SAMPLES

KNOTS = (5, 9, 17)
ONE_WAVEFORM = 0.9  # of the square of what an effect adds: then its outputs share one


def event_of_a_curve(state: State, terms: Terms, theta: Array, colours: Colours) -> str:
    """The channel of an adopted model any curve of which explains as much as something that happens once; "" where none
    does.

    Parameters
    ----------
    state: without it; terms: at the residual's samples; theta: (P,).
    """
    courses = [course for model in state.adopted for course in _followed(model, state.excitation)]
    return _best(state, terms, theta, colours, courses, ahead=-SEPARATION)


def another_curve(state: State, model: Adopted, terms: Terms, theta: Array, colours: Colours) -> str:
    """The channel any curve of which explains more than a model does that follows another one, and more than any curve
    of that one; "" where none does. Parameters as above."""
    x = state.excitation
    own = {name for name in channels_of(model, x) if not x.is_vector(name)}
    if not own:
        return ""
    others = [(n, v) for n, v in x.logged.items() if not x.is_vector(n)]
    return _best(state, terms, theta, colours, [*others, *_followed(model, x)], ahead=SEPARATION, but=own)


def _best(
    state: State,
    terms: Terms,
    theta: Array,
    colours: Colours,
    courses: list[tuple[str, Array]],
    *,
    ahead: float,
    but: frozenset[str] | set[str] = frozenset(),
) -> str:
    """The channel, other than those of `but`, whose curve is ahead of terms by so much, and of those of `but`."""
    residual = state.residual
    if len(residual.affine) < LEAST_SAMPLES or not courses:
        return ""
    waveform, size, direction = np.linalg.svd(terms.contribution(theta, len(residual.noise)), full_matrices=False)
    if size[0] ** 2 < ONE_WAVEFORM * np.sum(size**2) or size[0] == 0.0:
        return ""
    white = Whitened.of(residual, colours.across, colours.along, state.terms)

    def gain(series: Array) -> float:
        blocks = grams_in(white, _along(direction[0] * size[0], series), BLOCKS)
        given = np.arange(blocks.count) < blocks.count - series.shape[1]
        return interleaved_gain(blocks, residual.freedom, given, np.ones(blocks.count, dtype=bool)).total

    known, found = gain(waveform[:, :1]), {name: -np.inf for name, _ in courses}
    for name, values in courses:
        column = (values if values.ndim == 1 else values.mean(axis=1))[residual.samples]
        if np.ptp(column) > 0:
            found[name] = max([found[name], *(gain(hats(column, knots)) for knots in KNOTS)])
    known = max([known, *(found[name] for name in but)])
    best = max(found.keys() - but, key=lambda name: found[name], default="")
    return best if best and found[best] > known + ahead else ""


def hats(values: Array, knots: int) -> Array:
    """(N, K - 1) what is 1 at one of K knots, evenly over the values (N,), and falls straight to 0 at the next ones;
    that of the lowest knot is left out, for a constant is an offset."""
    at = (values - values.min()) / np.ptp(values) * (knots - 1)
    return np.column_stack([np.maximum(1.0 - np.abs(at - knot), 0.0) for knot in range(1, knots)])


def _followed(model: Adopted, x: Excitation) -> Iterator[tuple[str, Array]]:
    """The channels that a model follows, each with its course through the model's lag."""
    for name in sorted(channels_of(model, x)):
        if not x.is_vector(name):
            lag = max(float(model.settings.get("lag_s", 0.0)), 0.0)
            yield name, x.channel(name, lag, bool(model.settings.get("delayed", False)))


def _along(direction: Array, series: Array) -> Terms:
    """One coefficient for each of the series (N, K), which add to the outputs along a direction (3 S,)."""
    count, outputs = series.shape[1], np.arange(len(direction))
    each = np.repeat(np.arange(count), len(outputs))
    return Terms(
        tuple(f"knot {k}" for k in range(count)), ("",) * count, ("nT",) * count, series, each,
        np.tile(outputs, count), each, part_weight=np.tile(direction, count),
    )  # fmt: skip
