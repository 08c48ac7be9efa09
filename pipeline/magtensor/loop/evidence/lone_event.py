"""Whether a model of what happened once, and was over soon, explains what there was at its time.

A sensor that wanders for a while, or a base station, has a place that looks like a step or a vehicle, and parts of that
predict each other, for neighbours are alike. But wandering has no shape: a law of three coefficients follows its
largest swing and leaves the others.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.folds import Blocks
from magtensor.loop.evidence.residual import Residual

MOST_LEFT = 0.1  # of the square of what there was, when something happened once: a third of its size
ACTS = 0.1  # of what a model explains: a sensor with less hardly shows it
CHANCE = 3.0  # standard deviations of a sum of squares of noise
CORE = 0.05  # of what is known of it lies before the core, and as much after


class Whitening(Protocol):
    """The colour of one part of a residual."""

    def whiten(self, series: Array, *, back: bool = True) -> Array:
        """Series in noise made white."""


def elsewhere(after: Residual, blocks: Blocks) -> Residual:
    """A residual with nothing in it where something happened: what noise there is else."""
    there = _span(blocks)

    def blanked(series: Array | None) -> Array | None:
        if series is None:
            return None
        out = np.array(series)
        out[there] = 0.0
        return out

    return replace(after, across=blanked(after.across), along=blanked(after.along))


def left_of(
    before: Residual, after: Residual, known: Array, across: Whitening, along: Whitening, blocks: Blocks
) -> float:
    """The part of what stands above noise at its time that a model leaves, where it acts; 0 if chance leaves as much.

    Parameters
    ----------
    before, after: of N samples, without and with the model, whatever else is adopted taken off in both.
    known: (N + 1,) part of what is known of it that so many samples know.
    across, along: the colours of the two parts of the noise elsewhere.
    blocks: that are divided where it happened.
    """
    there = _span(blocks)
    within = known[there.start] + (known[there.stop] - known[there.start]) * np.array([CORE, 1.0 - CORE])
    core = slice(*np.searchsorted(known, within).tolist())
    blank = 1.0 - (there.stop - there.start) / (len(known) - 1)  # those samples count as quiet ones in the colours
    parts: list[tuple[Array, Array, Array]] = []
    if before.across is not None and after.across is not None:
        variance = np.diagonal(before.projector) / blank
        parts.append((across.whiten(before.across), across.whiten(after.across), variance))
    if before.along is not None and after.along is not None:
        both = along.whiten(np.column_stack([before.along, after.along]))
        parts.append((both[:, :1], both[:, 1:], np.ones(1) / blank))
    return max(_left(parts, there), _left(parts, core))


def _span(blocks: Blocks) -> slice:
    """The samples of the folds that were divided."""
    start, end = blocks.edges[blocks.folds[list(blocks.divided)]].tolist()
    return slice(start, end)


def _left(parts: list[tuple[Array, Array, Array]], there: slice) -> float:
    """That of the sensors, and of |b| - F, that show the model, in some of the samples.

    Parameters
    ----------
    parts: outputs (N, K) before and after, and the variance of each that noise has: of a sensor three, or one.
    """
    shown, left, found, noise = [], [], [], []
    for before, after, variance in parts:
        size = min(3, len(variance))
        for k in range(0, len(variance), size):
            own = slice(k, k + size)
            shown.append(float(np.sum((before[there, own] - after[there, own]) ** 2)))
            left.append(float(np.sum(after[there, own] ** 2)))
            found.append(float(np.sum(before[there, own] ** 2)))
            noise.append(float(np.sum(variance[own])) * len(before[there]))
    acts = np.array(shown) > ACTS * sum(shown)
    expected = float(np.sum(np.array(noise)[acts]))
    rest = float(np.sum(np.array(left)[acts])) - expected
    if rest <= CHANCE * np.sqrt(2.0 * expected):
        return 0.0
    return rest / max(float(np.sum(np.array(found)[acts])) - expected, rest)
