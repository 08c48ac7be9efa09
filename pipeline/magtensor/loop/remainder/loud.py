"""Where the noise of a sensor is louder for a while: no effect, but worth a look."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.residual import residual_of
from magtensor.loop.evidence.stretches import ABOUT, LEAST_LOUD
from magtensor.loop.fitting.model import Fitting, Record, State
from magtensor.loop.fitting.refit import rounding, without

LOUD = 2.0  # times the usual noise
FAR_LOUDER = 3.0  # times the noise of the median sensor
PARTS = 10  # of a survey, that are compared


@dataclass(frozen=True)
class Loud:
    """What is said of noise that is louder for a while, and when it is: begin and end, s after the survey's start."""

    words: list[str]
    stretches: list[tuple[float, float]]

    @classmethod
    def of(cls, state: State, record: Record, how: Fitting) -> Loud:
        """Of what a fit leaves, the samples included that were left out because most sensors are loud in them."""
        from scipy.ndimage import median_filter

        if step := rounding(record, state):
            words = f"the outputs come in steps of {step:.3g} nT, whose rounding makes most of the noise"
            return cls([words], [])
        if state.residual.across is None or len(state.residual.across) < 4 * LEAST_LOUD:
            return cls([], [])
        seen = state.residual
        if how.without:
            raw, reference = without(record, [a.terms(state.excitation) for a in state.adopted], state.theta)
            believed = state.fit.keep | ~how.among(record.time)
            seen = residual_of(replace(state.fit, keep=believed), raw, reference, how.reference_noise)
        assert seen.across is not None
        elapsed = record.time[seen.samples] - record.start
        names = state.excitation.sensors
        each = [(name, slice(3 * number, 3 * number + 3)) for number, name in enumerate(names)]
        told: list[str] = []
        stretches: list[tuple[float, float]] = []
        longest: dict[str, tuple[float, float, float, int]] = {}  # begin, end, times as loud, how many others
        for name, own in [(" and ".join(names), slice(None))] if len(names) == 2 else each:  # two have one contrast
            steps = np.sum(np.diff(seen.across[:, own], axis=0) ** 2, axis=1)
            rough = median_filter(steps, size=ABOUT, mode="mirror")
            usual = float(np.median(rough))
            loud = rough > LOUD**2 * usual
            edges = np.flatnonzero(np.diff(loud.astype(int), prepend=0, append=0)).reshape(-1, 2)
            found = [(first, end) for first, end in edges if end - first >= LEAST_LOUD]
            if not found:
                told += growing_words(name, steps, elapsed)
                continue
            stretches += [(float(elapsed[first]), float(elapsed[end])) for first, end in found]
            first, end = max(found, key=lambda stretch: stretch[1] - stretch[0])
            times = float(np.sqrt(np.median(rough[first:end]) / usual))
            longest[name] = float(elapsed[first]), float(elapsed[end]), times, len(found) - 1
        told += _stretch_words(longest, len(names))
        if how.without:
            count = int(np.sum(~how.among(record.time)))
            told.append(
                f"{count} samples in which most sensors are so loud have no part in the calibration, which is better "
                "without them, nor in the sensor noise"
            )
        return cls(told, stretches)


def _stretch_words(longest: dict[str, tuple[float, float, float, int]], sensors: int) -> list[str]:
    """The longest stretch of each sensor in which it is loud; of all, where all have one, the longest."""
    if not longest:
        return []
    each = list(longest.items())
    if len(longest) == sensors > 2:
        name, (begin, end, times, others) = max(each, key=lambda one: one[1][1] - one[1][0])
        most = max(one[2] for one in longest.values())
        where = ", and in other stretches" if others or len({one[:2] for one in longest.values()}) > 1 else ""
        return [
            f"from {begin:.5g} to {end:.5g} s the noise of {name} is {times:.2g} times as loud as usual{where}, and so "
            f"is that of all other sensors for a while, up to {most:.2g} times"
        ]
    return [
        f"from {begin:.5g} to {end:.5g} s the noise of {name} is {times:.2g} times as loud as usual"
        + (f", and in {others} shorter stretches" if others else "")
        for name, (begin, end, times, others) in each
    ]


def louder_words(state: State, record: Record) -> list[str]:
    """Which sensors are far louder than most, and whether rounding makes it: what no model of a search would ever
    follow, a converter that lost a bit, passes for the noise of its sensor."""
    noise = np.sqrt(np.mean(state.residual.noise.reshape(-1, 3) ** 2, axis=1))
    usual, louder = float(np.median(noise)), list[str]()
    for number, name in enumerate(state.excitation.sensors):
        if noise[number] > FAR_LOUDER * usual:
            step = rounding(record, state, number)
            why = f", for its outputs come in steps of {step:.3g} nT" if step else ""
            louder.append(f"that of {name} is {noise[number]:.3g} nT{why}")
    return [f"the noise of most sensors is {usual:.3g} nT an axis, {' and '.join(louder)}"] if louder else []


def growing_words(name: str, steps: Array, elapsed: Array) -> list[str]:
    """Whether noise is much louder in one tenth of a survey than in another, as where it grows all the time.

    Parameters
    ----------
    steps: (n - 1,) squares of the steps from one sample to the next; elapsed: (n,) s.
    """
    edges = np.linspace(0, len(steps), PARTS + 1).round().astype(int)
    loudness = np.array([np.median(steps[i:j]) for i, j in pairwise(edges)])
    quiet, loud = int(loudness.argmin()), int(loudness.argmax())
    if np.diff(edges).min() < LEAST_LOUD or loudness[loud] < LOUD**2 * loudness[quiet]:
        return []
    times = float(np.sqrt(loudness[loud] / loudness[quiet]))
    here, there = (f"from {elapsed[edges[k]]:.5g} to {elapsed[edges[k + 1]]:.5g} s" for k in (loud, quiet))
    return [f"the noise of {name} is {times:.2g} times as loud {here} as {there}"]
