"""Logged series without their own white noise: a Wiener filter in the cosine transform."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.noise import MAD_TO_SIGMA
from magtensor.calibration.types import Array

LEAST_SAMPLES = 16
BANDS = 20  # the quietest of so many parts of the spectrum bounds the white noise from above
LEAST_IN_A_BAND = 20  # or the quietest is quiet by chance
MOST_NOISE = 0.1  # of a series' variance: one that is rougher is no slow signal with some noise


def quieted(values: Array, clearance: float = 1.0) -> Array:
    """A series (N,), evenly sampled, without its white noise: the best linear estimate of what was logged.

    A regressor made of a noisy log is attenuated, the more the faster what it is asked about, and a lag that it does
    not have seems to suit it, because a lag smooths. The noise is that of second differences, and no more than the
    power where the spectrum is lowest, so that what is rough by itself is not taken for noise.

    Parameters
    ----------
    clearance: frequencies with less than so many times the noise power are left out altogether; with more than one,
        a series too short to tell noise from signal is only its mean.
    """
    from scipy.fft import dct, idct

    n = len(values)
    if n < LEAST_SAMPLES:
        return values if clearance <= 1.0 else np.full(n, values.mean())
    trend = np.polynomial.Polynomial.fit(np.arange(n), values, 1)(np.arange(n))
    coefficients = dct(values - trend, norm="ortho")
    power = coefficients**2
    bands = int(np.clip(n // LEAST_IN_A_BAND, 1, BANDS))
    lowest = min(float(band.mean()) for band in np.array_split(power, bands))
    second = np.diff(values, n=2)
    noise = min(float(np.median(np.abs(second)) * MAD_TO_SIGMA) ** 2 / 6.0, lowest)
    if noise <= 0 or (clearance <= 1.0 and noise > MOST_NOISE * float(power.mean())):
        return values
    width = max(n // 100, 5)
    smooth = np.convolve(power, np.ones(width) / width, mode="same")
    gain = np.where(smooth > clearance * noise, 1.0 - noise / np.maximum(smooth, 1e-300), 0.0)
    out: Array = idct(coefficients * gain, norm="ortho") + trend
    return out
