"""The noise of a logged channel, and what it leaves behind once an effect that follows the channel is adopted.

A log is not what it logs. An effect of theta times the true channel is corrected with theta times the log, which adds
theta times the log's noise to the data. Other functions of the same log have that noise with other weights (the cube
of a current that is on or off has none while it is off), so one of them predicts what the first brought in, on
held-out data too, and is yet no effect.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.noise import MAD_TO_SIGMA
from magtensor.calibration.types import Array
from magtensor.error_models.held_logs import by_single_steps
from magtensor.loop.fitting.model import Adopted, State

TWICE = 2.0  # on average


def white_noise(values: Array, run: NDArray[np.int_]) -> Array:
    """White noise of a channel (N,) or (N, K), one figure for each column.

    From second differences within runs, by their median, so that jumps count as signal; less where values two apart
    differ by more than neighbours do, as those of a channel that wanders: white noise is the part that does not grow.
    At least the noise of the resolution where the values are rounded, and so change by one step of it at a time; what
    jumps over levels, and comes to each of them twice or more, was set to them, and is exact, as what is zero or one
    other value, on or off.
    """
    columns = values.reshape(len(values), -1)
    out = np.zeros(columns.shape[1])
    if len(columns) < 8:
        return out
    within = run[2:] == run[:-2]
    if within.any():
        second = np.abs(np.diff(columns, n=2, axis=0)[within]) / np.sqrt(6.0)
        out = np.minimum(MAD_TO_SIGMA * np.median(second, axis=0), _that_does_not_grow(columns, run))
    for j, column in enumerate(columns.T):
        if out[j] > 0 or _on_or_off(column):
            continue
        changed = np.abs(np.diff(column)) > 1e-9 * max(float(np.ptp(column)), 1e-300)
        readings = column[np.flatnonzero(np.append(changed, True))]
        came_back = len(readings) >= TWICE * len(np.unique(readings))
        if len(readings) > 1 and (by_single_steps(readings) or not came_back):
            out[j] = np.abs(np.diff(readings)).min() / np.sqrt(12.0)
    return out


def _on_or_off(column: Array) -> bool:
    levels = np.unique(column)
    return len(levels) == 2 and bool(np.any(levels == 0.0))


def _that_does_not_grow(columns: Array, run: NDArray[np.int_]) -> Array:
    """(K,) white noise from how values one and two apart differ: s^2 from 2 s^2 + a and 2 s^2 + 2 a."""
    squares = []
    for apart in (1, 2):
        within = run[apart:] == run[:-apart]
        steps = np.abs(columns[apart:] - columns[:-apart])[within]
        squares.append((MAD_TO_SIGMA * np.median(steps, axis=0)) ** 2)
    out: Array = np.sqrt(np.maximum(2.0 * squares[0] - squares[1], 0.0) / 2.0)
    return out


def brought_in(state: State, channels: Collection[str] | None = None) -> float:
    """Sum of squares that the noise of the logs of some channels, or of all, puts into the whitened residual through
    what is adopted."""
    return sum(
        would_bring_in(state, model, theta, channels) for model, theta in zip(state.adopted, state.theta, strict=True)
    )


def would_bring_in(state: State, model: Adopted, theta: Array, channels: Collection[str] | None = None) -> float:
    """The same through one model, adopted or not, with coefficients (P,)."""
    follows = model.channels(state.excitation)
    chosen = follows if channels is None else follows & set(channels)
    return sum(_of_a_log(state, model, theta, name) for name in sorted(chosen))


def _of_a_log(state: State, model: Adopted, theta: Array, name: str) -> float:
    x, residual = state.excitation, state.residual
    values = x.logged[name]
    rng = np.random.default_rng(2017)
    noise = rng.standard_normal(values.shape) * white_noise(values, x.run).reshape(values.shape[1:])
    noisy = replace(x, logged={**x.logged, name: values + noise}, courses={})
    added = model.terms(noisy).contribution(theta, len(residual.noise))
    added = (added - model.terms(x).contribution(theta, len(residual.noise)))[residual.samples] / residual.noise
    total = 0.0
    if residual.across is not None:
        total += float(np.sum((added @ residual.projector) ** 2))
    if residual.along is not None:
        total += float(np.sum(np.einsum("no,no->n", residual.gain, added) ** 2))
    return total
