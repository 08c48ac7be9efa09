"""Lines in the spectrum of a residual."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.evidence.colour import beside_the_field
from magtensor.loop.evidence.residual import Residual

MOST_MISSING = 0.25  # of the samples of an even grid
_ON_THE_GRID = 0.1  # of a step, that an interval may be off it
_SPREAD = 10  # places of the fine grid to either side that a sample is spread over: to 1e-9
_OF_A_MEDIAN = 2.0 / np.pi  # of what a mean of as many values tells
_LEAST_VARIANCE = 1e-6  # of the largest, of the noise of a coordinate


def spectral_lines(residual: Residual, time: Array, most: int = 5) -> list[tuple[float, float, float]]:
    """(frequency Hz, rms nT, p) of the strongest peaks of the residual across over its smooth spectrum.

    p is that of the largest of all peaks under noise without lines. What C took of slow noise turns with the platform,
    at a rate that would seem a line, and is put back (`colour.beside_the_field`). The lowest frequencies, where no
    smooth spectrum can be told from a line, are left out; so are surveys that lack more than a quarter of their
    samples. Those that are missing from an even grid are interpolated; where the times lie on none, each sample counts
    at its own.
    """
    from scipy.special import chdtri, fdtrc

    if len(time) < 256 or residual.across is None:
        return []
    step = np.median(np.diff(time))
    steps = np.rint(np.diff(time) / step)
    off = np.abs(np.diff(time) - steps * step).max()
    even = bool(steps.min() >= 1.0 and off <= _ON_THE_GRID * step)
    places = np.concatenate([[0.0], np.cumsum(steps)]) if even else (time - time[0]) / step
    n = int(np.rint(places[-1])) + 1
    if len(time) < (1.0 - MOST_MISSING) * n:
        return []
    values, vectors = np.linalg.eigh(residual.projector)
    coordinates, colour = beside_the_field(residual.across @ vectors[:, values > 0.5], residual.affine)
    size = np.ones((n + 1) // 2 - 1)  # of the noise's amplitude that is left
    if not even and colour.power is not None:
        # what is slow would show at all frequencies, as the times scatter, in all coordinates alike
        coordinates = colour.whiten(coordinates) * np.sqrt(colour.white)
        size /= np.sqrt(np.interp(np.arange(1.0, len(size) + 1) / n, _cycles(colour.power), colour.power))
    k = coordinates.shape[1]
    # without the highest frequency of an even number of samples, which has one phase and not two
    spectrum = _of_a_grid(coordinates, places, n) if even else transform(coordinates, places, n) * (n / len(places))
    spectrum = spectrum[1 : (n + 1) // 2]
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
        amplitude = float(np.sqrt(2.0 * np.sum(np.abs(spectrum[i]) ** 2) / k) / n * residual.scale / size[i])
        peaks.append((float(frequency[i]), amplitude, p))
    return peaks


def _of_a_grid(coordinates: Array, places: Array, n: int) -> NDArray[np.complex128]:
    """(n // 2 + 1, K) Fourier transform of coordinates (N, K) at places of a grid, between which they are straight."""
    from scipy.fft import rfft

    if n > len(places):
        coordinates = np.column_stack([np.interp(np.arange(float(n)), places, column) for column in coordinates.T])
    return np.asarray(rfft(coordinates, axis=0))


def transform(coordinates: Array, places: Array, n: int) -> NDArray[np.complex128]:
    """(n // 2 + 1, K) sums of coordinates (N, K) times exp(-2 pi i m place / n).

    Spread over a grid twice as fine with a Gaussian (Greengard and Lee, SIAM Review 46, 443, 2004), to 1e-9.

    Parameters
    ----------
    places: (N,) times in steps since the first, ascending, in [0, n).
    """
    from scipy.fft import rfft

    fine = 2 * n
    width = np.sqrt(2.0) * _SPREAD / np.pi  # of exp(-d^2 / width): what is cut off and what aliases are as small
    nearest = np.rint(2.0 * places).astype(int)
    spread = np.zeros((fine, coordinates.shape[1]))
    for beside in range(-_SPREAD, _SPREAD + 1):
        part = np.exp(-((nearest + beside - 2.0 * places) ** 2) / width)
        for column, out in zip(coordinates.T, spread.T, strict=True):
            out += np.bincount((nearest + beside) % fine, weights=part * column, minlength=fine)
    m = np.arange(n // 2 + 1)
    undone = np.exp(width * (np.pi * m / fine) ** 2) / np.sqrt(np.pi * width)
    return np.asarray(rfft(spread, axis=0))[: len(m)] * undone[:, None]


def _cycles(power: Array) -> Array:
    """Cycles a sample of the frequencies of a colour."""
    return np.arange(len(power)) / (2.0 * len(power))


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
