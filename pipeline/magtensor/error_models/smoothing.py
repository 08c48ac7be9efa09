"""A slow log without its white noise: the course that is as smooth as its noise lets one tell."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.quiet import LEAST_SAMPLES, white_variance

MOST_NOISE = 0.1  # of a series' variance: one that is rougher is no slow signal with some noise
STIFFEST = 12  # decimal power of the penalty: beyond it, rounding; a course of some thousands of samples
SHORTEST = 0.01  # of the usual step: a time stamp may be wrong
ENOUGH = 50_000  # samples that tell how stiff a course is


def smoothed(time: Array, values: Array) -> Array:
    """A series (N,) at rising times (N,) without its white noise.

    Penalised second differences (Whittaker 1923), which unlike a filter have no edges: at the beginning, where what was
    switched on warms up fastest, the course goes on as it comes, and over a pause it may go where it likes. The penalty
    is the one that predicts left-out values best (generalised cross-validation, Craven and Wahba 1979), so that a log
    that is read too seldom to show its noise is hardly smoothed. A regressor made of a noisy log is attenuated, the
    more the faster what it is asked about, and a lag that it does not have seems to suit it, because a lag smooths.

    A series with much noise for its signal is given back as it is: what is logged may be what there is.
    """
    if len(values) < LEAST_SAMPLES:
        return values
    mean = float(values.mean())
    noise = white_variance(values[:ENOUGH])
    if noise <= 0 or noise > MOST_NOISE * float(np.var(values)):
        return values
    step = np.diff(time)
    step = np.maximum(step / np.median(step), SHORTEST)
    best = _stiffness(step[: ENOUGH - 1], values[:ENOUGH] - mean)
    return _course(step, values - mean, best) + mean


def _stiffness(step: Array, values: Array) -> float:
    """The decimal power of the best penalty, to a half."""
    eigenvalues = (2.0 - 2.0 * np.cos(np.pi * np.arange(len(values)) / len(values))) ** 2

    def risk(power: float) -> float:
        kept = np.mean(1.0 / (1.0 + 10.0**power * eigenvalues))  # of the values' freedom
        return float(np.mean((_course(step, values, power) - values) ** 2) / (1.0 - kept) ** 2)

    best = min(np.arange(-1.0, STIFFEST + 1.0), key=risk)
    return float(min((best - 0.5, best, best + 0.5), key=risk))


def _course(step: Array, values: Array, power: float) -> Array:
    """The solution x of (1 + 10^power D'D) x = values; D holds the second differences where the steps (N - 1,) are one,
    and the differences of slopes over the root of their distance where they are not."""
    from scipy.linalg import solveh_banded

    n = len(values)
    root = np.sqrt((step[:-1] + step[1:]) / 2.0)
    rows = np.stack([1.0 / step[:-1], -1.0 / step[:-1] - 1.0 / step[1:], 1.0 / step[1:]]) / root
    bands = np.zeros((3, n))
    for i in range(3):
        for j in range(i, 3):
            bands[2 - j + i, j : n - 2 + j] += 10.0**power * rows[i] * rows[j]
    bands[2] += 1.0
    out: Array = solveh_banded(bands, values, overwrite_ab=True, check_finite=False)
    return out
