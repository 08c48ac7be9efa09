"""Effects of time: an axis is sampled at another instant than its time stamp says."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from magtensor.errors import UsageError
from magtensor.simulate.effects.base import Bench, SensorEffectSpec
from magtensor.simulate.motion import MARGIN_S
from magtensor.simulate.spec import Array, PerSensor, stream


def _sampled_at(bench: Bench, shift: Array, effect: str) -> Array:
    """C (b(t + shift) - b(t)) for shifts (N or 1, S, 3) s of each axis.

    Raises:
        UsageError: a shift longer than the time for which the motion is defined beyond the survey.
    """
    if not np.abs(shift).max() < MARGIN_S - 1:
        raise UsageError(
            f"effect {effect}: a time error of {np.abs(shift).max():.3g} s; up to {MARGIN_S - 1:g} s can be simulated"
        )
    added = np.empty(bench.b.shape)
    for s in range(bench.sensors):
        place = bench.instrument.positions[s : s + 1]
        matrix = bench.instrument.matrix[s]
        for axis in range(3):
            if axis == 0 or not np.array_equal(shift[:, s, axis], shift[:, s, axis - 1]):
                change = bench.field_at(bench.time + shift[:, s, axis], place)[:, 0] - bench.b[:, s]
            row = matrix[axis]
            added[:, s, axis] = row[0] * change[:, 0] + row[1] * change[:, 1] + row[2] * change[:, 2]
    return added


class SamplingLag(SensorEffectSpec):
    """Each sensor, or each axis, is sampled late by a constant time."""

    COEFFICIENTS = "lag_s"
    DYNAMIC = True
    LINEAR = False
    type: Literal["sampling_lag"]
    lag_s: PerSensor | None = Field(
        None, description="delays of x, y, z behind the time stamp, s, for all sensors or for each"
    )
    per_axis: bool = Field(False, description="where drawn: true: one delay for each axis; false: one for each sensor")

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        lag = 1e-3 * rng.standard_normal((bench.sensors, 3))
        return lag if self.per_axis else np.repeat(lag[:, :1], 3, axis=1)

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        return _sampled_at(bench, -coefficients[None], self.name)


class LagStep(SensorEffectSpec):
    """Each sensor is sampled late from a time on: a sample of its stream was lost, or held twice."""

    COEFFICIENTS = "lag_s"
    DYNAMIC = True
    LINEAR = False
    type: Literal["lag_step"]
    lag_s: PerSensor | None = Field(
        None, description="delays of x, y, z behind the time stamp, s, for all sensors or for each"
    )
    time_s: float = Field(ge=0, description="from when on, s since the start")

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return np.repeat(1e-3 * rng.standard_normal((bench.sensors, 1)), 3, axis=1)

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        since = bench.time - bench.time[0] >= self.time_s
        return _sampled_at(bench, np.where(since[:, None, None], -coefficients, 0.0), self.name)


class ClockDrift(SensorEffectSpec):
    """The clock of a sensor's logger runs fast or slow: sample t was taken at t (1 + drift)."""

    COEFFICIENTS = "ppm"
    DYNAMIC = True
    LINEAR = False
    type: Literal["clock_drift"]
    ppm: list[float] | None = Field(None, description="drift of each sensor's clock, 1e-6")

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return rng.standard_normal(bench.sensors)

    def read(self, bench: Bench) -> Array:
        values = np.array(self.given, dtype=float)
        if values.shape != (bench.sensors,):
            raise UsageError(f"effect clock_drift: ppm has {len(values)} values; the array has {bench.sensors} sensors")
        return values

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        shift = (bench.time - bench.time[0])[:, None] * (1e-6 * coefficients)
        return _sampled_at(bench, np.repeat(shift[..., None], 3, axis=-1), self.name)


class Averaging(SensorEffectSpec):
    """Each row is the mean over a time about its stamp."""

    COEFFICIENTS = "spread_s2"
    DYNAMIC = True
    LINEAR = False
    type: Literal["averaging"]
    spread_s2: list[float] | None = Field(
        None, description="half the variance of the time that each sensor's rows are the mean over: T^2 / 24"
    )

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return np.full(bench.sensors, 1e-4 * (0.1 + abs(rng.standard_normal())))

    def read(self, bench: Bench) -> Array:
        values = np.array(self.given, dtype=float)
        if values.shape != (bench.sensors,) or (values < 0).any():
            raise UsageError(
                f"effect averaging: spread_s2 is {self.given}; {bench.sensors} values from 0 on would be right"
            )
        return values

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        places, weights = np.polynomial.legendre.leggauss(6)
        half = np.sqrt(24.0 * coefficients)[None, :, None] / 2.0 * np.ones((1, 1, 3))
        parts = [0.5 * w * _sampled_at(bench, p * half, self.name) for p, w in zip(places, weights, strict=True)]
        out: Array = np.sum(parts, axis=0)
        return out


class Jitter(SensorEffectSpec):
    """Each sensor's sampling instants scatter: noise that grows with the rate of change of the field."""

    COEFFICIENTS = "sd_s"
    DYNAMIC = True
    LINEAR = False
    type: Literal["jitter"]
    sd_s: float | None = Field(None, gt=0, description="standard deviation of the sampling instant, s")

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return np.array(1e-4)

    def read(self, bench: Bench) -> Array:
        return np.array(self.sd_s)

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        shift = coefficients * stream(bench.seed, "jitter").standard_normal((len(bench.time), bench.sensors, 1))
        return _sampled_at(bench, np.repeat(shift, 3, axis=-1), self.name)
