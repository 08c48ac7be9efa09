"""Effects inside a sensor: nonlinearity, transverse field, hysteresis, bandwidth."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from magtensor.simulate.effects.base import Bench, SensorEffectSpec
from magtensor.simulate.processes import low_pass
from magtensor.simulate.rotations import transform
from magtensor.simulate.spec import Array, PerSensor


class NonlinearityQuadratic(SensorEffectSpec):
    """A second-order term in each axis's transfer curve."""

    COEFFICIENTS = "nT_at_full_scale"
    type: Literal["nonlinearity_quadratic"]
    nT_at_full_scale: PerSensor | None = Field(
        None, description="x, y, z at positive full scale, for all sensors or for each"
    )
    full_scale_nT: float = Field(50000.0, gt=0, description="full scale, nT")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        return (bench.output() / self.full_scale_nT) ** 2 * coefficients


class NonlinearityCubic(SensorEffectSpec):
    """A third-order term in each axis's transfer curve."""

    COEFFICIENTS = "nT_at_full_scale"
    type: Literal["nonlinearity_cubic"]
    nT_at_full_scale: PerSensor | None = Field(
        None, description="x, y, z at positive full scale, for all sensors or for each"
    )
    full_scale_nT: float = Field(50000.0, gt=0, description="full scale, nT")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        return (bench.output() / self.full_scale_nT) ** 3 * coefficients


class CrossField(SensorEffectSpec):
    """Each axis answers to the product of the two field components across it."""

    COEFFICIENTS = "nT_at_full_scale"
    type: Literal["cross_field"]
    nT_at_full_scale: PerSensor | None = Field(
        None, description="x, y, z where both transverse components are at full scale"
    )
    difference_ratio: float = Field(
        0.5, description="size of the term in the difference of their squares, over the product's"
    )
    full_scale_nT: float = Field(50000.0, gt=0, description="full scale, nT")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        m = bench.output() / self.full_scale_nT
        after, next_after = np.roll(m, -1, axis=-1), np.roll(m, -2, axis=-1)
        return (after * next_after + self.difference_ratio * (after**2 - next_after**2)) * coefficients


class Hysteresis(SensorEffectSpec):
    """Part of the output hangs behind like gears with play (Prandtl-Ishlinskii): w times the mean of P_r(m) - m."""

    COEFFICIENTS = "weight"
    DYNAMIC = True
    type: Literal["hysteresis"]
    weight: PerSensor | None = Field(None, description="w of x, y, z, without dimension, for all sensors or for each")
    half_width_nT: list[float] = Field(
        default=[5000.0], min_length=1, description="half widths r of the play operators, nT"
    )

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        matrix, offset = bench.instrument.matrix, bench.instrument.offset
        return coefficients * bench.left_behind(self.half_width_nT, lambda b: transform(matrix, b) + offset)


class Bandwidth(SensorEffectSpec):
    """Each axis is a low-pass filter of its own."""

    COEFFICIENTS = "tau_s"
    DYNAMIC = True
    LINEAR = False
    type: Literal["bandwidth"]
    tau_s: PerSensor | None = Field(None, description="time constants of x, y, z, s, for all sensors or for each")

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return 1e-3 * np.abs(rng.standard_normal((bench.sensors, 3)))

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        matrix, places = bench.instrument.matrix, bench.instrument.positions
        sensed = low_pass(
            lambda t: transform(matrix, bench.field.at(t, places)),
            bench.time,
            coefficients,
            chunk=bench.chunk,
        )
        sensed -= bench.sensed(bench.b)
        return sensed
