"""Effects of what else is on the platform: currents, moving parts, motors, feedback coils, metal, an elastic frame."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from magtensor.errors import UsageError
from magtensor.simulate.channels import ChannelSpec, one_channel
from magtensor.simulate.effects.base import Bench, SensorEffectSpec
from magtensor.simulate.effects.electronics import LaggingTemperature
from magtensor.simulate.motion import specific_force
from magtensor.simulate.processes import low_pass
from magtensor.simulate.rotations import exponential, matrices, transform, transform_back
from magtensor.simulate.sources import MU0_OVER_4PI, dipole_field
from magtensor.simulate.spec import Array, Matrix3, PerSensor, Spec, Vector3, stream

ARCMIN = np.pi / (180 * 60)
G_M_S2 = 9.81


class LoopSpec(Spec):
    """A small current loop on the platform."""

    position_m: Vector3 = Field(description="centre in the platform frame, m")
    area_m2: Vector3 = Field(description="turns times area along the loop's normal, m^2")


class CurrentField(SensorEffectSpec):
    """The magnetic field of a current that is logged."""

    COEFFICIENTS = "nT_per_A"
    type: Literal["current_field"]
    nT_per_A: PerSensor | None = Field(
        None, description="field in the platform frame, x, y, z, for all sensors or for each"
    )
    loop: LoopSpec | None = Field(None, description="a current loop from which the field follows, instead of nT_per_A")
    channel: str = Field(description="current channel")
    lag_s: float = Field(0.0, ge=0, description="time constant of the current behind the logged one, s")

    @property
    def given(self) -> list[float] | list[list[float]] | LoopSpec | None:
        return self.loop if self.nT_per_A is None else self.nT_per_A

    @model_validator(mode="after")
    def _one_way(self) -> CurrentField:
        if self.loop is not None and self.nT_per_A is not None:
            raise ValueError("give either loop or nT_per_A")
        return self

    def read(self, bench: Bench) -> Array:
        if self.loop is None:
            return super().read(bench)
        return dipole_field(np.array(self.loop.area_m2), bench.instrument.positions - self.loop.position_m)

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        current = bench.lagged_channel(self.channel, self.lag_s, self.name)
        return bench.sensed(current[..., None] * coefficients)


class ChannelResponse(SensorEffectSpec):
    """The output follows a power of any logged channel, as an offset or as a factor."""

    COEFFICIENTS = "nT_per_unit"
    type: Literal["channel_response"]
    nT_per_unit: PerSensor | None = Field(
        None,
        description=(
            "x, y, z per (channel unit)^power, for all sensors or for each; where times_field: 1e-6 per "
            "(channel unit)^power"
        ),
    )
    channel: str = Field(description="channel")
    power: Literal[1, 2, 3] = Field(1, description="power of the channel")
    lag_s: float = Field(0.0, ge=0, description="time constant behind the channel, s")
    times_field: bool = Field(False, description="true: multiplies the sensed field instead of adding to it")
    reference: float | None = Field(None, description="channel value at which it is nil; null: the survey's mean")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        values = bench.lagged_channel(self.channel, self.lag_s, self.name)
        zero = bench.kept_mean(values) if self.reference is None else self.reference
        course = ((values - zero) ** self.power)[..., None]
        return bench.sensed(bench.b) * (1e-6 * coefficients) * course if self.times_field else course * coefficients


class ChannelRate(SensorEffectSpec):
    """The output answers to a change of a channel and forgets it, as through a capacitor into a resistor."""

    COEFFICIENTS = "nT_per_unit"
    type: Literal["channel_rate"]
    nT_per_unit: PerSensor | None = Field(
        None, description="x, y, z per channel unit by which it jumps, for all sensors or for each"
    )
    channel: str = Field(description="channel")
    tau_s: float = Field(10.0, gt=0, description="time constant with which it forgets, s")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        across_capacitor = bench.lagged_channel(self.channel, self.tau_s, self.name)
        return (bench.channel(self.channel, self.name) - across_capacitor)[..., None] * coefficients


class LatentSource(SensorEffectSpec):
    """A magnetic source on the platform that nobody logged: one waveform, one vector at each sensor."""

    COEFFICIENTS = "nT_per_unit"
    type: Literal["latent_source"]
    nT_per_unit: PerSensor | None = Field(
        None, description="field in the platform frame per unit of the waveform, for all sensors or for each"
    )
    waveform_of: ChannelSpec = Field(description="how the source varies in time, as a channel")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        hidden = one_channel("latent_source", self.waveform_of, bench.seed, bench.time, bench.sensors, {})
        values = hidden.values if hidden.values.ndim == 2 else hidden.values[:, None]
        return bench.sensed(values[..., None] * coefficients)


class MovingPart(SensorEffectSpec):
    """A magnetised part that turns about an axis on the platform, its angle given by an encoder."""

    COEFFICIENTS = "moment_Am2"
    type: Literal["moving_part"]
    moment_Am2: float | None = Field(None, gt=0, description="magnetic moment across the axis, A m^2")
    position_m: Vector3 = Field(description="in the platform frame, m")
    axis: Vector3 = Field(default=[0.0, 0.0, 1.0], description="axis of rotation in the platform frame")
    channel: str = Field("encoder", description="angle channel, rad")

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return np.array(1.0)

    def read(self, bench: Bench) -> Array:
        return np.array(self.moment_Am2)

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        angle = bench.channel(self.channel, self.name)[:, :1]
        axis = np.array(self.axis) / np.linalg.norm(self.axis)
        start = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        start /= np.linalg.norm(start)
        moment = np.cos(angle) * start + np.sin(angle) * np.cross(axis, start)
        reach = bench.instrument.positions - self.position_m
        return bench.sensed(dipole_field(coefficients * moment[:, None], reach))


class PeriodicInterference(SensorEffectSpec):
    """Mains, a motor, a propeller: a tone sampled as it comes, so that it aliases where it is above half the rate."""

    COEFFICIENTS = "amplitude_nT"
    type: Literal["periodic_interference"]
    amplitude_nT: PerSensor | None = Field(
        None,
        description=(
            "amplitude of the fundamental in the platform frame, for all sensors or for each; phases are random"
        ),
    )
    frequency_Hz: float = Field(gt=0, description="true frequency, Hz")
    harmonics: list[float] = Field(
        default=[], description="amplitudes of the 2nd, 3rd, ... harmonic over the fundamental's"
    )

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        rng = stream(bench.seed, "periodic_interference", str(self.frequency_Hz))
        added = np.zeros((len(bench.time), bench.sensors, 3))
        for order, ratio in enumerate([1.0, *self.harmonics], start=1):
            phase = rng.uniform(0, 2 * np.pi, (bench.sensors, 3))
            if self.alike:
                phase[:] = phase[0]
            turn = 2 * np.pi * order * self.frequency_Hz * bench.time
            added += np.cos(turn)[:, None, None] * (ratio * coefficients * np.cos(phase))
            added += np.sin(turn)[:, None, None] * (ratio * coefficients * np.sin(phase))
        return bench.sensed(added)


class Crosstalk(SensorEffectSpec):
    """The feedback coil of each sensor, which cancels the field there, is a dipole at the other sensors."""

    COEFFICIENTS = "coil_m3"
    type: Literal["crosstalk"]
    coil_m3: float | None = Field(
        None,
        gt=0,
        description=(
            "coil moment per field, times mu0 / 4 pi, m^3: the stray field at distance r is about 2 "
            "coil_m3 / r^3 of the field"
        ),
    )

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return np.array(1.0)

    def read(self, bench: Bench) -> Array:
        return np.array(self.coil_m3)

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        places = bench.instrument.positions
        stray = np.zeros(bench.b.shape)
        for j in range(bench.sensors):
            others = [i for i in range(bench.sensors) if i != j]
            moment = bench.b[:, j, None] * (coefficients / MU0_OVER_4PI)
            stray[:, others] += dipole_field(moment, places[others] - places[j])
        return bench.sensed(stray)


class EddyCurrent(SensorEffectSpec):
    """Conductors near the sensors: currents that decay with L/R and shield the change of the field.

    The current's field at a sensor is K (x - b) with tau x' + x = b: nothing at rest, -K tau db/dt for slow turns,
    -K b for fast ones.
    """

    COEFFICIENTS = "coupling"
    DYNAMIC = True
    type: Literal["eddy_current"]
    coupling: list[Matrix3] | None = Field(None, description="K of each sensor, without dimension")
    tau_s: float = Field(1e-3, gt=0, description="time constant L/R, s")

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return rng.standard_normal((bench.sensors, 3, 3))

    def read(self, bench: Bench) -> Array:
        return _matrices(self.given, bench.sensors, "effect eddy_current: coupling")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        shielded = bench.lagged_field(self.tau_s) - bench.b
        return bench.sensed(_coupled(bench, coefficients, shielded))


class ViscousMagnetisation(SensorEffectSpec):
    """Iron whose magnetisation follows the field late: it adds K x with tau x' + x = b."""

    COEFFICIENTS = "coupling"
    DYNAMIC = True
    type: Literal["viscous_magnetisation"]
    coupling: list[Matrix3] | None = Field(None, description="K of each sensor, without dimension")
    tau_s: float = Field(20.0, gt=0, description="time constant of the magnetisation, s")

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return rng.standard_normal((bench.sensors, 3, 3))

    def read(self, bench: Bench) -> Array:
        return _matrices(self.given, bench.sensors, "effect viscous_magnetisation: coupling")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        return bench.sensed(_coupled(bench, coefficients, bench.lagged_field(self.tau_s)))


class IronHysteresis(SensorEffectSpec):
    """Iron whose magnetisation hangs behind the field like gears with play: K times the mean of P_r(b) - b, the play
    operators along the platform's axes."""

    COEFFICIENTS = "coupling"
    DYNAMIC = True
    type: Literal["iron_hysteresis"]
    coupling: list[Matrix3] | None = Field(None, description="K of each sensor, without dimension")
    half_width_nT: list[float] = Field(
        default=[5000.0], min_length=1, description="half widths r of the play operators, nT"
    )

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return rng.standard_normal((bench.sensors, 3, 3))

    def read(self, bench: Bench) -> Array:
        return _matrices(self.given, bench.sensors, "effect iron_hysteresis: coupling")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        return bench.sensed(_coupled(bench, coefficients, bench.left_behind(self.half_width_nT, lambda b: b)))


class FrameFlexure(SensorEffectSpec):
    """The frame bends under gravity and acceleration, and turns each sensor by a small angle."""

    COEFFICIENTS = "arcmin_per_g"
    LINEAR = False
    type: Literal["frame_flexure"]
    arcmin_per_g: list[Matrix3] | None = Field(
        None, description="rotation vector of each sensor per specific force in the platform frame"
    )
    lag_s: float = Field(0.0, ge=0, description="time constant of the frame behind the force, s")

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return rng.standard_normal((bench.sensors, 3, 3))

    def read(self, bench: Bench) -> Array:
        return _matrices(self.given, bench.sensors, "effect frame_flexure: arcmin_per_g")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        turned = np.empty(bench.b.shape)
        motion = bench.field.motion
        forces = low_pass(lambda t: specific_force(motion, t), bench.time, self.lag_s, chunk=bench.chunk) / G_M_S2
        for piece in bench.pieces():
            bend = matrices(exponential(ARCMIN * transform(coefficients, forces[piece, None])))
            turned[piece] = transform_back(bend, bench.b[piece]) - bench.b[piece]
        return bench.sensed(turned)


class TurnStep(SensorEffectSpec):
    """A sensor is knocked and turns in its mount."""

    COEFFICIENTS = "arcmin"
    LINEAR = False
    type: Literal["turn_step"]
    arcmin: PerSensor | None = Field(
        None, description="rotation vector in the platform frame, x, y, z, for all sensors or for each"
    )
    time_s: float = Field(description="time of the knock, s since the start")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        after = (bench.time >= self.time_s).astype(float)
        return _turned_by(bench, ARCMIN * coefficients, after[:, None])


class CalibrationStep(SensorEffectSpec):
    """A sensor is replaced by one with another C."""

    COEFFICIENTS = "change"
    type: Literal["calibration_step"]
    change: list[Matrix3] | None = Field(None, description="K of each sensor: C becomes (1 + K) C, without dimension")
    time_s: float = Field(description="time at which it is replaced, s since the start")

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        return rng.standard_normal((bench.sensors, 3, 3))

    def read(self, bench: Bench) -> Array:
        return _matrices(self.given, bench.sensors, "effect calibration_step: change")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        after = (bench.time >= self.time_s).astype(float)
        return after[:, None, None] * _coupled(bench, coefficients, bench.sensed(bench.b))


class TemperatureAlignment(LaggingTemperature):
    """The sensors turn in their mounts as these warm."""

    COEFFICIENTS = "arcmin_per_degC"
    LINEAR = False
    type: Literal["temperature_alignment"]
    arcmin_per_degC: PerSensor | None = Field(
        None, description="rotation vector in the platform frame, x, y, z, for all sensors or for each"
    )

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        return _turned_by(bench, ARCMIN * coefficients, self.change(bench))


class ChannelAlignment(SensorEffectSpec):
    """The sensors turn as what holds them is loaded."""

    COEFFICIENTS = "arcmin_per_unit"
    LINEAR = False
    type: Literal["channel_alignment"]
    arcmin_per_unit: PerSensor | None = Field(
        None, description="rotation vector in the platform frame, x, y, z, for all sensors or for each"
    )
    channel: str = Field(description="channel of the load")
    lag_s: float = Field(0.0, ge=0, description="time constant of what gives way, s")
    reference: float | None = Field(None, description="load at which it is nil; null: the survey's mean")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        load = bench.lagged_channel(self.channel, self.lag_s, self.name)
        return _turned_by(
            bench, ARCMIN * coefficients, load - (load.mean() if self.reference is None else self.reference)
        )


class AlignmentDrift(SensorEffectSpec):
    """The sensors turn slowly in their mounts and come to rest."""

    COEFFICIENTS = "arcmin"
    LINEAR = False
    type: Literal["alignment_drift"]
    arcmin: PerSensor | None = Field(
        None, description="rotation vector after a long time, in the platform frame, for all sensors or for each"
    )
    tau_s: float = Field(3600.0, gt=0, description="time constant, s")

    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        course = 1.0 - np.exp(-(bench.time - bench.time[0]) / self.tau_s)
        return _turned_by(bench, ARCMIN * coefficients, course[:, None])


def _turned_by(bench: Bench, vectors: Array, course: Array) -> Array:
    """What sensors read more when each has turned by its vector (S, 3) in rad times a course, (N, S) or (N, 1)."""
    turned = np.empty(bench.b.shape)
    for piece in bench.pieces():
        rotation = matrices(exponential(vectors * course[piece, :, None]))
        turned[piece] = transform_back(rotation, bench.b[piece]) - bench.b[piece]
    return bench.sensed(turned)


def _matrices(given: object, sensors: int, what: str) -> Array:
    array = np.asarray(given, dtype=float)
    if len(array) not in (1, sensors):
        raise UsageError(f"{what} has {len(array)} matrices; the array has {sensors} sensors (give one, or {sensors})")
    return np.broadcast_to(array, (sensors, 3, 3)).copy()


def _coupled(bench: Bench, coupling: Array, vectors: Array) -> Array:
    """K v for (N, S, 3) or (N, 1, 3)."""
    out = np.empty(bench.b.shape)
    for piece in bench.pieces():
        out[piece] = transform(coupling, vectors[piece])
    return out
