"""A base station's field without its own white noise: a Wiener filter in the cosine transform."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.noise import MAD_TO_SIGMA
from magtensor.calibration.types import Array

LEAST_SAMPLES = 16
BANDS = 20  # the quietest of so many parts of the spectrum bounds the white noise from above
LEAST_IN_A_BAND = 20  # or the quietest is quiet by chance


def quieted(values: Array, clearance: float, step: float = 0.0) -> Array:
    """A series (N,), evenly sampled, without its white noise: the best linear estimate of what was logged.

    A straight trend is left; a series too short to tell noise from signal is only its mean.

    Parameters
    ----------
    clearance: frequencies with less than so many times the noise power are left out altogether.
    step: of its resolution, whose rounding is noise as well: a coarse log of what is quiet repeats itself.
    """
    from scipy.fft import idct

    n = len(values)
    if n < LEAST_SAMPLES:
        return np.full(n, values.mean())
    trend, coefficients = _spectrum(values)
    power = coefficients**2
    noise = _white(values, power, step)
    if noise <= 0:
        return values
    width = max(n // 100, 5)
    smooth = np.convolve(power, np.ones(width) / width, mode="same")
    gain = np.where(smooth > clearance * noise, 1.0 - noise / np.maximum(smooth, 1e-300), 0.0)
    out: Array = idct(coefficients * gain, norm="ortho") + trend
    return out


def white_variance(values: Array) -> float:
    """Variance of the white noise of a series (N,): that of second differences, and no more than the power where the
    spectrum is lowest, so that what is rough by itself is not taken for noise."""
    return _white(values, _spectrum(values)[1] ** 2)


def _spectrum(values: Array) -> tuple[Array, Array]:
    """A straight trend (N,), and the cosine transform (N,) of what is left."""
    from scipy.fft import dct

    at = np.arange(len(values))
    trend: Array = np.polynomial.Polynomial.fit(at, values, 1)(at)
    return trend, dct(values - trend, norm="ortho")


def _white(values: Array, power: Array, step: float = 0.0) -> float:
    bands = int(np.clip(len(values) // LEAST_IN_A_BAND, 1, BANDS))
    lowest = min(float(band.mean()) for band in np.array_split(power, bands))
    second = np.diff(values, n=2)
    scatter = max(float(np.median(np.abs(second)) * MAD_TO_SIGMA) ** 2 / 6.0, step**2 / 12.0)
    return min(scatter, lowest)
