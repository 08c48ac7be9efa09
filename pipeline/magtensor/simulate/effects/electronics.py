"""Effects of temperature, age, supply and switch-on: what the sensor's electronics do to scale and offset."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from magtensor.simulate.effects.base import Bench, SensorEffectSpec
from magtensor.simulate.processes import SmoothRandom
from magtensor.simulate.spec import Array, PerSensor, stream


def _about_reference(bench: Bench, values: Array, reference: float | None) -> Array:
    """(N, S) minus the reference, or minus each column's mean over the recorded samples."""
    return values - (bench.kept_mean(values) if reference is None else reference)


class LaggingTemperature(SensorEffectSpec):
    """What follows the temperature of the sensor, which lags the logged one."""

    channel: str = Field("temperature", description="temperature channel")
    lag_s: float = Field(0.0, ge=0, description="thermal time constant between the channel and the sensor, s")
    reference_degC: float | None = Field(None, description="temperature at which it is nil; null: the survey's mean")

    def change(self, bench: Bench) -> Array:
        """(N, S) degC of the sensors, less the reference."""
        return _about_reference(bench, bench.lagged_channel(self.channel, self.lag_s, self.name), self.reference_degC)


class TemperatureOffset(LaggingTemperature):
    """The offset follows the temperature of the sensor, which lags the logged one."""

    COEFFICIENTS = "nT_per_degC"
    type: Literal["temperature_offset"]
    nT_per_degC: PerSensor | None = Field(None, description="x, y, z, for all sensors or for each")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        return self.change(bench)[..., None] * coefficients


class TemperatureScale(LaggingTemperature):
    """The scale factors follow the temperature of the sensor, which lags the logged one."""

    COEFFICIENTS = "ppm_per_degC"
    type: Literal["temperature_scale"]
    ppm_per_degC: PerSensor | None = Field(None, description="x, y, z, for all sensors or for each")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        return bench.sensed(bench.b) * (1e-6 * coefficients) * self.change(bench)[..., None]


class TemperatureRate(SensorEffectSpec):
    """Thermoelectric currents: a field in proportion to the temperature difference between skin and core.

    The core follows the skin (the channel) with a time constant, so that for slow changes the difference is that
    time constant times the rate.
    """

    COEFFICIENTS = "nT_per_degC"
    type: Literal["temperature_rate"]
    nT_per_degC: PerSensor | None = Field(
        None, description="x, y, z, per degC of difference, for all sensors or for each"
    )
    channel: str = Field("temperature", description="temperature channel")
    tau_s: float = Field(20.0, gt=0, description="time constant of the core, s")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        skin = bench.channel(self.channel, self.name)
        core = bench.lagged_channel(self.channel, self.tau_s, self.name)
        return (skin - core)[..., None] * coefficients


class OffsetDrift(SensorEffectSpec):
    """The offset wanders off with time, whatever the temperature."""

    COEFFICIENTS = "nT_per_h"
    type: Literal["offset_drift"]
    nT_per_h: PerSensor | None = Field(None, description="x, y, z, for all sensors or for each")
    shape: Literal["linear", "quadratic", "wander"] = Field(
        "linear",
        description=(
            "linear: in proportion to time; quadratic: to (time in h)^2; wander: irregular, of that rms "
            "for time_s = 1 h"
        ),
    )
    time_s: float = Field(600.0, gt=0, description="correlation time of a wander, s")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        hours = (bench.time - bench.time[0]) / 3600
        if self.shape == "wander":
            span = (float(bench.time[0]), float(bench.time[-1]))
            rng = stream(bench.seed, "offset_drift")
            course = SmoothRandom(rng, span, self.time_s, self.time_s / 3600, bench.sensors * 3)(bench.time)
            return course.reshape(-1, bench.sensors, 3) * coefficients
        course = hours if self.shape == "linear" else hours**2
        return course[:, None, None] * coefficients


class ScaleDrift(SensorEffectSpec):
    """The scale factors age."""

    COEFFICIENTS = "ppm"
    type: Literal["scale_drift"]
    ppm: PerSensor | None = Field(
        None, description="x, y, z; per hour (linear), or per factor e of 1 + t / time_s (logarithmic)"
    )
    shape: Literal["linear", "logarithmic"] = Field(
        "linear", description="linear, or logarithmic as after launch or switch-on"
    )
    time_s: float = Field(600.0, gt=0, description="time constant of the logarithm, s")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        elapsed = bench.time - bench.time[0]
        course = elapsed / 3600 if self.shape == "linear" else np.log1p(elapsed / self.time_s)
        return bench.sensed(bench.b) * (1e-6 * coefficients) * course[:, None, None]


class WarmUp(SensorEffectSpec):
    """The offset settles after the electronics were switched on."""

    COEFFICIENTS = "nT"
    type: Literal["warm_up"]
    nT: PerSensor | None = Field(None, description="x, y, z at switch-on, for all sensors or for each")
    tau_s: float = Field(300.0, gt=0, description="time constant, s")
    switched_on_s: float = Field(0.0, le=0, description="switch-on, s since the start of the survey")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        left = np.exp(-(bench.time - self.switched_on_s) / self.tau_s)
        return left[:, None, None] * coefficients


class OffsetStep(SensorEffectSpec):
    """The offset jumps: a core is magnetised by a shock, a connector is touched."""

    COEFFICIENTS = "nT"
    type: Literal["offset_step"]
    nT: PerSensor | None = Field(None, description="x, y, z of each jump, for all sensors or for each")
    time_s: list[float] = Field(min_length=1, description="times of the jumps, s since the start")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        jumps = np.zeros(len(bench.time))
        for at in self.time_s:
            jumps += bench.time >= at
        return jumps[:, None, None] * coefficients


class ScaleStep(SensorEffectSpec):
    """The scale factors jump: a feedback path, a range or a reference voltage is not what it was."""

    COEFFICIENTS = "ppm"
    type: Literal["scale_step"]
    ppm: PerSensor | None = Field(None, description="x, y, z of each jump, for all sensors or for each")
    time_s: list[float] = Field(min_length=1, description="times of the jumps, s since the start")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        jumps = np.sum([bench.time >= at for at in self.time_s], axis=0)
        return bench.sensed(bench.b) * (1e-6 * coefficients) * jumps[:, None, None]


class FromSupply(SensorEffectSpec):
    """What follows the supply voltage."""

    channel: str = Field("supply_voltage", description="supply channel")
    reference_V: float | None = Field(None, description="voltage at which it is nil; null: the survey's mean")

    def change(self, bench: Bench) -> Array:
        """(N, S) V, less the reference."""
        return _about_reference(bench, bench.channel(self.channel, self.name), self.reference_V)


class SupplyScale(FromSupply):
    """The scale factors follow the supply voltage."""

    COEFFICIENTS = "ppm_per_V"
    type: Literal["supply_scale"]
    ppm_per_V: PerSensor | None = Field(None, description="x, y, z, for all sensors or for each")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        return bench.sensed(bench.b) * (1e-6 * coefficients) * self.change(bench)[..., None]


class SupplyOffset(FromSupply):
    """The offset follows the supply voltage."""

    COEFFICIENTS = "nT_per_V"
    type: Literal["supply_offset"]
    nT_per_V: PerSensor | None = Field(None, description="x, y, z, for all sensors or for each")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        return self.change(bench)[..., None] * coefficients
