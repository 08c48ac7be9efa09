"""Lines in the spectrum of a residual."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.colour import beside_the_field
from magtensor.loop.evidence.residual import Residual

MOST_MISSING = 0.25  # of the samples of an even grid
_OF_A_MEDIAN = 2.0 / np.pi  # of what a mean of as many values tells
_LEAST_VARIANCE = 1e-6  # of the largest, of the noise of a coordinate


def spectral_lines(residual: Residual, time: Array, most: int = 5) -> list[tuple[float, float, float]]:
    """(frequency Hz, rms nT, p) of the strongest peaks of the residual across over its smooth spectrum.

    p is that of the largest of all peaks under noise without lines. What C took of slow noise turns with the platform,
    at a rate that would seem a line, and is put back (`colour.beside_the_field`). The lowest frequencies, where no
    smooth spectrum can be told from a line, are left out; so are surveys that are not evenly sampled. Samples that are
    missing from an even grid, no more than a quarter, are interpolated.
    """
    from scipy.fft import rfft
    from scipy.special import chdtri, fdtrc

    if len(time) < 256 or residual.across is None:
        return []
    step = np.median(np.diff(time))
    steps = np.rint(np.diff(time) / step)
    places = np.concatenate([[0.0], np.cumsum(steps)])
    if steps.min() < 1.0 or len(time) < (1.0 - MOST_MISSING) * (places[-1] + 1.0):
        return []
    values, vectors = np.linalg.eigh(residual.projector)
    coordinates, _ = beside_the_field(residual.across @ vectors[:, values > 0.5], residual.affine)
    grid = np.arange(places[-1] + 1.0)
    if len(grid) > len(time):
        coordinates = np.column_stack([np.interp(grid, places, column) for column in coordinates.T])
    n, k = coordinates.shape
    # without the highest frequency of an even number of samples, which has one phase and not two
    spectrum = rfft(coordinates, axis=0)[1 : (n + 1) // 2]
    power = np.sum(np.abs(spectrum @ _alike(coordinates)) ** 2, axis=1) / n
    frequency = np.arange(1, len(power) + 1) / (n * step)
    width = max(len(power) // 100, 15)
    smooth = _running_median(power, width)
    ratio = power / np.maximum(smooth, 1e-300) * chdtri(2 * k, 0.5) / 2.0  # to the scale of k exponentials' sum
    ratio[: 2 * width] = 0.0
    known_from = 2 * k * _OF_A_MEDIAN * (2 * width + 1)
    order = np.argsort(-ratio)
    peaks: list[tuple[float, float, float]] = []
    for i in order:
        if len(peaks) == most:
            break
        if any(abs(frequency[i] - f) < 3.0 / (n * step) for f, _, _ in peaks):
            continue
        p = min(1.0, float(fdtrc(2 * k, known_from, ratio[i] / k)) * len(power))
        amplitude = float(np.sqrt(2.0 * np.sum(np.abs(spectrum[i]) ** 2) / k) / n * residual.scale)
        peaks.append((float(frequency[i]), amplitude, p))
    return peaks


def _alike(coordinates: Array) -> Array:
    """(K, K) what makes the fast noise of coordinates (N, K) independent and alike, its mean variance kept: the largest
    of sums of K squares is no line where one axis, louder than all others, makes nearly all of each sum."""
    fast = np.diff(coordinates, n=2, axis=0)
    variance, axes = np.linalg.eigh(fast.T @ fast / len(fast))
    least = np.maximum(variance, _LEAST_VARIANCE * variance[-1])
    out: Array = axes / np.sqrt(least) * np.sqrt(variance.mean())
    return out


def _running_median(values: Array, width: int) -> Array:
    from scipy.ndimage import median_filter

    out: Array = median_filter(values, size=2 * width + 1, mode="reflect")
    return out
