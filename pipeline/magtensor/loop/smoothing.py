"""A slow log without its white noise: the course that is as smooth as its noise lets one tell."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.quiet import LEAST_SAMPLES, white_noise

MOST_NOISE = 0.1  # of a series' variance: one that is rougher is no slow signal with some noise
STIFFEST = 12  # decimal power of the penalty: beyond it, rounding; a course of some thousands of samples
ENOUGH = 50_000  # samples that tell how stiff a course is


def smoothed(values: Array) -> Array:
    """A series (N,), evenly sampled, without its white noise.

    Penalised second differences (Whittaker 1923), which unlike a filter have no edges: at the beginning, where what was
    switched on warms up fastest, the course goes on as it comes. The penalty is the one with the least unbiased
    estimate of the error (Mallows 1973), the noise being that of second differences. A regressor made of a noisy log is
    attenuated, the more the faster what it is asked about, and a lag that it does not have seems to suit it, because a
    lag smooths.

    A series with more noise than signal is given back as it is: what is logged may be what there is.
    """
    if len(values) < LEAST_SAMPLES:
        return values
    mean = float(values.mean())
    noise = white_noise(values[:ENOUGH])
    if noise <= 0 or noise > MOST_NOISE * float(np.var(values)):
        return values
    return _course(values - mean, _stiffness(values[:ENOUGH] - mean, noise)) + mean


def _stiffness(values: Array, noise: float) -> float:
    """The decimal power of the best penalty, to a half."""
    eigenvalues = (2.0 - 2.0 * np.cos(np.pi * np.arange(len(values)) / len(values))) ** 2

    def risk(power: float) -> float:
        kept = np.mean(1.0 / (1.0 + 10.0**power * eigenvalues))
        return float(np.mean((_course(values, power) - values) ** 2) + 2.0 * noise * kept)

    best = min(np.arange(-1.0, STIFFEST + 1.0), key=risk)
    return float(min((best - 0.5, best, best + 0.5), key=risk))


def _course(values: Array, power: float) -> Array:
    """The solution x of (1 + 10^power D'D) x = values, D the second differences."""
    from scipy.linalg import solveh_banded

    n = len(values)
    bands = np.zeros((3, n))
    for i, first in enumerate((1.0, -2.0, 1.0)):
        for j, second in list(enumerate((1.0, -2.0, 1.0)))[i:]:
            bands[2 - j + i, j : n - 2 + j] += 10.0**power * first * second
    bands[2] += 1.0
    out: Array = solveh_banded(bands, values, overwrite_ab=True, check_finite=False)
    return out
