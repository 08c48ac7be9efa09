"""Effects of where the sensors really are. They show only in a gradient."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from magtensor.simulate.effects.base import Bench, SensorEffectSpec
from magtensor.simulate.spec import Array, PerSensor


class PositionError(SensorEffectSpec):
    """A sensor's centre is not where the survey says."""

    COEFFICIENTS = "offset_m"
    LINEAR = False
    type: Literal["position_error"]
    offset_m: PerSensor | None = Field(
        None, description="true minus stated position in the platform frame, m, for all sensors or for each"
    )

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return 1e-3 * rng.standard_normal((bench.sensors, 3))

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        true = bench.field_at(bench.time, bench.instrument.positions + coefficients)
        return bench.sensed(true - bench.b)


class BaselineExpansion(SensorEffectSpec):
    """The frame grows with temperature about the platform origin."""

    COEFFICIENTS = "ppm_per_degC"
    LINEAR = False
    type: Literal["baseline_expansion"]
    ppm_per_degC: float | None = Field(None, description="coefficient of expansion, 1e-6 per degC")
    channel: str = Field("temperature", description="temperature channel")
    reference_degC: float | None = Field(
        None, description="temperature at which the stated positions hold; null: the survey's mean"
    )

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return np.array(23.0)

    def read(self, bench: Bench) -> Array:
        return np.array(self.ppm_per_degC)

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        temperature = bench.channel(self.channel, self.name).mean(axis=1)
        zero = bench.kept_mean(temperature) if self.reference_degC is None else self.reference_degC
        growth = 1 + 1e-6 * coefficients * (temperature - zero)
        true = bench.field_at(bench.time, growth[:, None, None] * bench.instrument.positions)
        return bench.sensed(true - bench.b)
