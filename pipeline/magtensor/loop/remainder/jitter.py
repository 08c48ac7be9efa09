"""Stamps that scatter: a sensor whose noise grows with how fast the field turns in it.

A sample taken early or late by chance is off by that much of the rate of change, differently each time. No regressor
follows that, but its square does (METHODS A3, effect 36).
"""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.by_blocks import BLOCKS, least_t, t_of
from magtensor.loop.fitting.model import State

ALPHA = 0.001  # for all sensors together
LEAST_PER_BLOCK = 30
LEAST_OF_ALL = 0.01  # of the power of all that is left in it: slow noise that is far stronger turns, too
ALIKE = 0.4  # of the power in the sensor that has most, in each other: of three, one alone makes a quarter of it
LEAST_SHARE = 0.25  # of the power of the sensor's noise: less is made by what turns, too, and is not white


def jitter_words(state: State) -> list[str]:
    """The sensor whose stamps scatter most, by how much, and what that adds to its noise; all of them where those of
    the others scatter about as much; nothing where none do."""
    residual, x = state.residual, state.excitation
    if residual.across is None or len(x.sensors) < 3 or len(residual.across) < BLOCKS * LEAST_PER_BLOCK or not x.turns:
        return []
    rough = residual.across[1:-1] - (residual.across[:-2] + residual.across[2:]) / 2.0
    square = (rough**2 / 1.5).reshape(len(rough), -1, 3).sum(axis=2)
    slope = x.sensed(x.rate)[residual.samples][1:-1] / residual.noise.reshape(-1, 3)
    turning = np.sum(slope**2 * np.diagonal(residual.projector).reshape(-1, 3), axis=2)  # 1/s2
    found = np.array([_by_blocks(s, t) for s, t in zip(square.T, turning.T, strict=True)])  # (S, B) s2
    mean, t = found.mean(axis=1), t_of(found)
    worst = int(np.argmax(mean * turning.mean(axis=0)))
    share = mean[worst] * turning[:, worst].mean() / square[:, worst].mean()
    if t[worst] < least_t(ALPHA / len(t)) or share < LEAST_SHARE:
        return []
    whole = (residual.across**2).reshape(len(residual.across), -1, 3).sum(axis=2)[:, worst].mean()
    if mean[worst] * turning[:, worst].mean() < LEAST_OF_ALL * whole:
        return []
    scatter = float(np.sqrt(mean[worst]))
    amount = scatter * float(np.sqrt(np.mean((slope[:, worst] * residual.noise.reshape(-1, 3)[worst]) ** 2)))
    if np.all(mean > ALIKE * mean[worst]):
        return [
            f"the noise of all sensors grows with how fast the field turns in them, of {x.sensors[worst]} by "
            f"{amount:.3g} nT rms, as if samples were taken early or late by {1e3 * scatter:.3g} ms at random, of each "
            "sensor by itself: what trembles more where the platform turns faster would look the same"
        ]
    return [
        f"the noise of {x.sensors[worst]} grows with how fast the field turns in it, by {amount:.3g} nT rms, as if its "
        f"samples were taken early or late by {1e3 * scatter:.3g} ms at random"
    ]


def _by_blocks(square: Array, turning: Array) -> Array:
    """(B,) s2: in each block the slope of the square over the square of the rate, larger noise weighted less."""
    out = []
    for y, z in zip(np.array_split(square, BLOCKS), np.array_split(turning, BLOCKS), strict=True):
        columns = np.column_stack([np.ones_like(z), z])
        level = np.full_like(y, y.mean())
        for _ in range(3):
            weight = 1.0 / level
            (constant, slope), *_ = np.linalg.lstsq(columns * weight[:, None], y * weight, rcond=None)
            level = np.maximum(constant + slope * z, 0.1 * y.mean())
        out.append(slope)
    return np.array(out)
