"""Whose matrix C is not constant: products of the field with slow functions of time and with logged channels.

A mount that turns with temperature, axes whose angles creep, a neighbour's excitation that is heard while a pump runs:
each adds (waveform in time) x (field) to a sensor's outputs, through a matrix of its own. Slow noise of the sensors is
no such product, it does not turn with the platform; and in blocks that lie between others, noise of the residual's own
colour makes such a model worse than none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.acting import AXES
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.assessment import WHITE, Colours
from magtensor.loop.evidence.by_blocks import least_t
from magtensor.loop.evidence.gains import Gain, interleaved_gain
from magtensor.loop.evidence.grams import Whitened, grams_in
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.fitting.model import State
from magtensor.loop.fitting.separation import SEPARATION
from magtensor.sharing import shared_out

COSINES = 4  # over the survey: slower than any block is long
BLOCKS = 40  # longer than what noise can be expected to remember beyond its fitted colour
LEAST_SAMPLES = 120  # three in a block
SLOW = "/cosines"  # no name of a channel has a slash


@dataclass(frozen=True)
class ChangingMatrix:
    """A sensor whose matrix is not constant.

    Attributes:
        sensors: its name, first; after it those that the data do not tell from it.
        waveform: the logged channel that its matrix follows; `SLOW` where none does better.
        gain: on held-out blocks, in noise of the residual's own colour.
        rms: nT over all outputs, of what is explained.
    """

    sensors: tuple[str, ...]
    waveform: str
    gain: Gain
    rms: float

    @property
    def whose(self) -> str:
        """The sensor, or those that it may be."""
        return " or ".join(self.sensors)

    @property
    def amount(self) -> str:
        """What is explained, in words."""
        return f"{self.rms:.3g} nT rms" if self.rms > 0 else "a part"  # seen in noise made white alone


def changing_words(found: Sequence[ChangingMatrix]) -> list[str]:
    """For the verdict: one sentence for all that change with the same."""
    words = []
    for waveform in dict.fromkeys(one.waveform for one in found):
        those = [one for one in found if one.waveform == waveform]
        how = "with time" if waveform == SLOW else f"with {waveform}"
        others = [f"{one.whose} ({one.amount})" for one in those[1:]]
        too = f", nor is that of {' and '.join(others)}" if others else ""
        words.append(
            f"{those[0].amount} of it goes with the field in a way that changes {how}: "
            f"C of {those[0].whose} is not constant{too}"
        )
    return words


def changing_matrices(state: State, alpha: float) -> list[ChangingMatrix]:
    """The sensors whose matrices are not constant, the one that explains most first; all tests together at `alpha`."""
    residual, x = state.residual, state.excitation
    if len(residual.affine) < LEAST_SAMPLES:
        return []
    waveforms = waveforms_of(x)
    found: list[ChangingMatrix] = []
    given = [] if state.terms is None else [state.terms]
    if residual.along is not None:
        given.append(_reference_drift(x, waveforms[SLOW]).at(residual.samples))
    while len(found) < len(x.sensors):
        one = _strongest(residual, x, waveforms, given, state.colours, alpha)
        if one is None:
            break
        found.append(one)
        number = x.sensors.index(one.sensors[0])
        given = [*given, _products(x, number, waveforms[one.waveform]).at(residual.samples)]
    return found


def channel_instead(state: State, terms: Terms, colours: Colours, since_s: float) -> str:
    """The logged channel whose product with the field, in matrices of the same sensors, explains far more than terms
    (at the residual's samples) of something that happened do, and than matrices that jumped then; "" where none does.

    A mount that turns with temperature looks like one that jumped. Blocks that lie between others tell the two apart.
    Of a jump of the whole matrix a model knows a part; anything that rises steadily, a counter of the samples, follows
    more of it.

    Args:
        since_s: s after the survey's start, when it happened.
    """
    residual, x = state.residual, state.excitation
    numbers = [i for i, s in enumerate(x.sensors) if s in terms.sensors]
    channels = {name: w for name, w in waveforms_of(x).items() if name != SLOW}
    if len(residual.affine) < LEAST_SAMPLES or not numbers or not channels:
        return ""
    white = Whitened.of(residual, colours.across, colours.along, state.terms)

    def gain(more: Terms) -> float:
        blocks = grams_in(white, more, BLOCKS)
        given = np.arange(blocks.count) < blocks.count - more.count
        return interleaved_gain(blocks, residual.freedom, given, np.ones(blocks.count, dtype=bool)).total

    def of_products(waveform: Array) -> float:
        more = joined([_products(x, i, waveform) for i in numbers]).at(residual.samples)
        return gain(more) - more.count

    jumped = max(of_products((x.elapsed >= since_s).astype(float)[:, None, None]), gain(terms))
    gains = {name: of_products(waveform) for name, waveform in channels.items()}
    best = max(gains, key=lambda name: gains[name])
    return best if gains[best] > jumped + SEPARATION else ""


def waveforms_of(x: Excitation) -> dict[str, Array]:
    """Name -> (N, 1, K) cosines over the survey; (N, 1, 1) or, one for each sensor, (N, S, 1) a logged channel.

    Each of mean 0 and rms 1.
    """
    phase = np.pi * (x.time - x.time[0]) / max(x.duration, 1e-300)
    out = {SLOW: np.cos(phase[:, None, None] * np.arange(1, COSINES + 1))}
    out |= {n: v.reshape(len(v), -1, 1) for n, v in x.logged.items() if not x.is_vector(n)}
    centred = {name: v - v.mean(axis=0) for name, v in out.items()}
    return {name: v / v.std(axis=0) for name, v in centred.items() if (v.std(axis=0) > 0).all()}


def _strongest(
    residual: Residual,
    x: Excitation,
    waveforms: Mapping[str, Array],
    given: Sequence[Terms],
    colours: Colours,
    alpha: float,
) -> ChangingMatrix | None:
    """The sensor, with the waveform, that explains most of what the given terms leave; None if none is significant."""
    held = joined(list(given)) if given else None
    white = Whitened.of(residual, colours.across, colours.along, held)
    of_each = shared_out(lambda number: _gains(white, x, number, waveforms), range(len(x.sensors)))
    gains = {(number, name): gain for number, own in enumerate(of_each) for name, gain in own.items()}
    each = alpha / len(gains)
    passing = {key: gain for key, gain in gains.items() if gain.t > least_t(each, len(gain.before))}
    if not passing:
        return None
    best = max(passing, key=lambda key: passing[key].total)
    number, name = best
    near = [s for (s, n), gain in gains.items() if n == name and s != number]
    near = [s for s in near if gains[best].total - gains[s, name].total < SEPARATION]
    plain = Whitened.of(residual, WHITE.across, WHITE.along, held)
    before, after = _gains(plain, x, number, {name: waveforms[name]})[name].rms
    amount = float(np.sqrt(max(before**2 - after**2, 0.0)) * residual.scale)
    return ChangingMatrix(tuple(x.sensors[s] for s in (number, *near)), name, gains[best], amount)


def _gains(white: Whitened, x: Excitation, number: int, waveforms: Mapping[str, Array]) -> dict[str, Gain]:
    """What each waveform gains on held-out blocks, by name, in the matrix of one sensor."""
    samples = white.residual.samples
    parts = {name: _products(x, number, waveform).at(samples) for name, waveform in waveforms.items()}
    blocks = grams_in(white, joined(list(parts.values())), BLOCKS)
    given = blocks.count - sum(p.count for p in parts.values())
    owner = np.repeat(np.arange(len(parts) + 1), [given, *(p.count for p in parts.values())])
    return {
        name: interleaved_gain(blocks, white.residual.freedom, owner == 0, (owner == 0) | (owner == i))
        for i, name in enumerate(parts, start=1)
    }


def _products(x: Excitation, number: int, waveform: Array) -> Terms:
    """Waveforms (N, S or 1, K), the sensor's own, times the field's direction through a matrix: 9 K coefficients."""
    field = x.field[:, number]
    own = waveform[:, number if waveform.shape[1] > 1 else 0]
    u = field / np.linalg.norm(field, axis=1, keepdims=True)
    series = np.einsum("nk,ni->nki", own, u).reshape(len(u), -1)
    outputs, k = np.arange(3 * number, 3 * number + 3), series.shape[1]
    part_output, part_series = np.repeat(outputs, k), np.tile(np.arange(k), 3)
    return Terms(
        tuple(f"{AXES[o % 3]}{AXES[s % 3]}" for o, s in zip(part_output, part_series, strict=True)),
        (x.sensors[number],) * (3 * k),
        ("nT",) * (3 * k),
        series,
        np.arange(3 * k),
        part_output,
        part_series,
    )


def _reference_drift(x: Excitation, waveforms: Array) -> Terms:
    """Waveforms (N, 1, K) in the reference: a base station that drifts is no change of every sensor's scale."""
    return joined([x.on_reference(w, "nT", "drift") for w in waveforms[:, 0].T])
