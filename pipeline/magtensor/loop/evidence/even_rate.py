"""Series at an even rate, where a survey has gaps.

Slow noise goes on in a gap, and would seem to have jumped if what comes after it followed at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.evidence.quick_length import quick_length
from magtensor.loop.evidence.sensor_noise import LEAST

MOST_MISSING = 0.25  # of the samples: longer gaps are shortened to that


@dataclass(frozen=True)
class EvenRate:
    """Where samples are missing.

    Attributes:
        before: (M,) number of the sample at a place, or before it, where it is in a gap.
        part: (M,) how far into the gap; 0 at a sample.
        missing: (M,) how many places the gap has; 0 at a sample.
    """

    before: NDArray[np.int_]
    part: Array
    missing: NDArray[np.int_]

    @classmethod
    def of(cls, time: Array | None) -> EvenRate | None:
        """Of samples at times (N,) s; None where none are missing."""
        if time is None or len(time) < LEAST:
            return None
        steps = np.diff(time)
        missing = np.maximum(np.round(steps / np.median(steps)) - 1.0, 0.0)
        if not missing.any():
            return None
        missing = np.floor(missing * min(1.0, MOST_MISSING * len(time) / missing.sum())).astype(int)
        before = np.repeat(np.arange(len(time)), np.append(missing, 0) + 1)
        before = before[: quick_length(len(before))]
        first = np.flatnonzero(np.diff(before, prepend=-1))  # the places of the samples
        number = np.arange(len(before)) - first[before]
        gap = np.append(missing, 0)[before]
        return cls(before, number / (gap + 1), np.where(number > 0, gap, 0))

    def __call__(self, series: Array) -> Array:
        """(M,) or (M, K): the values (N,) or (N, K) at samples, and in a gap a straight line.

        It leads from the mean of as many samples before the gap as are missing to that of as many after it: between two
        single ones it would be their noise, all along the gap.
        """
        sums = np.concatenate([np.zeros((1, *series.shape[1:])), np.cumsum(series, axis=0)])
        gap = self.missing > 0
        first, width = self.before[gap] + 1, self.missing[gap]
        begin, end = np.maximum(first - width, 0), np.minimum(first + width, len(series))
        out: Array = series[self.before]
        shape = (-1, *(1,) * (series.ndim - 1))
        left = (sums[first] - sums[begin]) / (first - begin).reshape(shape)
        right = (sums[end] - sums[first]) / (end - first).reshape(shape)
        part = self.part[gap].reshape(shape)
        out[gap] = left * (1.0 - part) + right * part
        return out
