"""A source that is on or off: two levels in noise, a hidden Markov chain."""

from __future__ import annotations

import math

import numpy as np

from magtensor.calibration.types import Array

LEAST_APART = 3.0  # levels, in standard deviations of a sample's noise
MOST_LEFT = 1.2  # variance of what two levels leave over that of the noise: more, and it is no switch
FAR = 4.5  # standard deviations from either level: a sample taken while it switched, kept as it is
MOST_BETWEEN = 0.1  # of the samples
MOST_SWITCHING = 0.2  # of the samples: faster, and no sample has neighbours that tell its state
_ROUNDS = 8


def two_levels(series: Array, noise: float, smooth: Array) -> tuple[Array, float] | None:
    """The expected course of a source with two levels, and the rms of its error; None where the series is no such.

    Levels and rate of switching by expectation and maximisation, the states by the forward-backward recursion (Rabiner,
    Proceedings of the IEEE 77, 1989).

    Parameters
    ----------
    series: (N,) with white noise of this standard deviation.
    smooth: (N,) a smoother version of it, from which the levels are first guessed.
    """
    middle = 0.5 * (smooth.min() + smooth.max())
    on = smooth > middle
    if not on.any() or on.all():
        return None
    likely = on.astype(float)
    for _ in range(_ROUNDS):
        low, high = np.average(series, weights=1.0 - likely), np.average(series, weights=likely)
        if high - low < LEAST_APART * noise:
            return None
        rate = (np.abs(np.diff(likely > 0.5)).sum() + 1.0) / len(series)
        if rate > MOST_SWITCHING:
            return None
        evidence = (series - 0.5 * (low + high)) * (high - low) / noise**2
        likely = _posterior(evidence, float(rate))
        if not 1.0 < likely.sum() < len(series) - 1.0:
            return None
    course = low + (high - low) * likely
    between = np.abs(series - course) > FAR * noise
    if between.mean() > MOST_BETWEEN or np.var((series - course)[~between]) > MOST_LEFT * noise**2:
        return None
    spread = np.where(between, noise**2, (high - low) ** 2 * likely * (1.0 - likely))
    return np.where(between, series, course), float(np.sqrt(spread.mean()))


def _posterior(evidence: Array, rate: float) -> Array:
    """(N,) probability of the upper state, from the log likelihood ratios (N,) of the samples."""
    before = _carried(evidence, rate)
    after = _carried(evidence[::-1], rate)[::-1]
    out: Array = 1.0 / (1.0 + np.exp(-np.clip(before + evidence + after, -500.0, 500.0)))
    return out


def _carried(evidence: Array, rate: float) -> Array:
    """(N,) log odds that earlier samples give to the state of each."""
    most = math.log((1.0 - rate) / rate)
    out = np.zeros(len(evidence))
    odds = 0.0
    for i, e in enumerate(evidence.tolist()):
        out[i] = odds
        x = odds + e
        if x > 2 * most:
            odds = most
        elif x < -2 * most:
            odds = -most
        else:
            y = math.exp(x)
            odds = math.log(((1.0 - rate) * y + rate) / (rate * y + 1.0 - rate))
    return out
