"""Sensor noise with a stated spectrum.

One-sided power spectral density of each axis, f in Hz up to half the rate:

    S(f) = 2 white_sd^2 / rate + flicker^2 / f^exponent        nT^2/Hz

Both parts come from independent draws. The second is drawn in the frequency domain over twice the
survey's length, so that begin and end of the survey are not correlated; it has no component at f = 0, whose place
is the sensor's offset.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from magtensor.errors import UsageError
from magtensor.simulate.spec import Array, Spec

Level = (
    Annotated[float, Field(ge=0)]
    | list[Annotated[list[Annotated[float, Field(ge=0)]], Field(min_length=3, max_length=3)]]
)


class NoiseSpec(Spec):
    """Noise of the vector sensors."""

    white_sd_nT: Level = Field(
        0.0,
        description=(
            "standard deviation of the white part at the sampling rate, nT: one number or x, y, z for each sensor"
        ),
    )
    flicker_nT_per_rtHz: Level = Field(
        0.0,
        description=(
            "amplitude spectral density of the 1/f part at 1 Hz, nT/sqrt(Hz): one number or x, y, z for each sensor"
        ),
    )
    flicker_exponent: float = Field(1.0, gt=0, le=2, description="exponent of the 1/f part's power spectrum")
    enters: Literal["output", "field"] = Field(
        "output",
        description=(
            "output: added to the raw output; field: added to the field before the sensor's errors, as Li 2018 does"
        ),
    )


def level(values: Level, sensors: int, what: str) -> Array:
    """(S, 3) nT from one number or three for each sensor."""
    array = np.asarray(values, dtype=float)
    if array.ndim and array.shape != (sensors, 3):
        raise UsageError(f"noise.{what} has {len(array)} rows; the array has {sensors} sensors")
    return np.broadcast_to(array, (sensors, 3)).copy()


def flicker(rng: np.random.Generator, samples: int, rate_Hz: float, at_1Hz: float, exponent: float) -> Array:
    """(samples,) noise with one-sided density at_1Hz^2 / f^exponent, in nT where at_1Hz is in nT/sqrt(Hz)."""
    from scipy.fft import irfft, next_fast_len

    length = next_fast_len(2 * samples, real=True)
    length += length % 2
    frequency = np.arange(1, length // 2 + 1) * (rate_Hz / length)
    amplitude = at_1Hz * frequency ** (-exponent / 2) * np.sqrt(rate_Hz * length) / 2
    spectrum = np.zeros(length // 2 + 1, dtype=complex)
    spectrum[1:] = amplitude * (rng.standard_normal(length // 2) + 1j * rng.standard_normal(length // 2))
    spectrum[-1] = spectrum[-1].real * np.sqrt(2)
    return irfft(spectrum, length)[:samples]


def sensor_noise(
    spec: NoiseSpec, rng: np.random.Generator, samples: int, rate_Hz: float, sensors: int
) -> Iterator[Array]:
    """(samples, 3) nT of noise on an even time base, for one sensor after the other."""
    white = level(spec.white_sd_nT, sensors, "white_sd_nT")
    pink = level(spec.flicker_nT_per_rtHz, sensors, "flicker_nT_per_rtHz")
    for s in range(sensors):
        out = rng.standard_normal((samples, 3)) * white[s]
        for axis in range(3):
            if pink[s, axis] > 0:
                out[:, axis] += flicker(rng, samples, rate_Hz, float(pink[s, axis]), spec.flicker_exponent)
        yield out
