"""Whether a series goes in jumps: steady noise, whatever its spectrum, has differences of a normal law.

Popcorn noise of a sensor, a contact that opens and closes, a heater that nobody logged stay for a while and go at once.
Means over a few samples before and after each moment differ by little at most times, then, and by much at some. Noise
that is louder for a while is measured by how its samples scatter there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array

SAMPLES = (4, 8, 16)  # that means are taken over
LEAST = 20  # independent means
ABOUT = 101  # samples, of which the scatter is the usual one


def jumpiness(series: Array, run: NDArray[np.int_] | None = None) -> float:
    """The excess kurtosis of what means of a series (N,) differ by from one to the next, in standard errors of that of
    a normal law; of the lengths of the means the one with the largest. Of normal noise, white, 1/f or of one time
    constant, above 4 in less than one series in a thousand.

    Parameters
    ----------
    run: (N,) number of the contiguous run that a sample belongs to: slow noise differs across a gap by more than from
        sample to sample, and is not asked there. Without, there is one.
    """
    from scipy.ndimage import median_filter

    count, found = len(series), 0.0
    run = np.zeros(count, dtype=int) if run is None else run
    sums = [np.concatenate([[0.0], np.cumsum(series**power)]) for power in (1, 2)]
    for n in SAMPLES:
        if count < 2 * n:
            break
        within = run[: count - 2 * n + 1] == run[2 * n - 1 :]
        if (asked := np.count_nonzero(within)) <= (LEAST - 2) * n:
            break
        mean, square = (np.stack([s[n:-n] - s[: -2 * n], s[2 * n :] - s[n:-n]]) / n for s in sums)
        own = (square - mean**2).mean(axis=0)
        scatter = np.maximum(median_filter(own, size=ABOUT, mode="nearest"), own)  # where it grows, at once
        step = (mean[1] - mean[0]) / np.sqrt(np.maximum(scatter, 1e-300))
        step = step[within]
        kurtosis = float(np.mean(step**4) / max(np.mean(step**2) ** 2, 1e-300)) - 3.0
        found = max(found, kurtosis / np.sqrt(24.0 * 2 * n / (asked + 2 * n - 1)))
    return found
