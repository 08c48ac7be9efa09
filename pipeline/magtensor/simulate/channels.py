"""Channels beside the field, logged or not: temperatures, currents, supply voltage, encoder, anything else.

Temperatures follow from a thermal mass, tau T' + T = ambient + heating; a supply sags under its loads; the others
are given functions of time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from magtensor.errors import UsageError
from magtensor.simulate.processes import SmoothRandom, low_pass
from magtensor.simulate.spec import Array, Spec, stream


class ChannelBase(Spec):
    """What every channel has."""

    logged: bool = Field(True, description="false: it acts but is not written to the survey")
    log_noise: float = Field(0.0, ge=0, description="standard deviation of the logger's noise, channel units")
    log_resolution: float = Field(0.0, ge=0, description="step of the logger, channel units; 0: none")


class StepSpec(Spec):
    """A sudden change of the ambient temperature."""

    time_s: float = Field(description="when, s since the start")
    change_degC: float = Field(description="by how much, degC")


class TemperatureSpec(ChannelBase):
    """A body that follows the ambient temperature and its own heating with a time constant."""

    type: Literal["temperature"]
    ambient_degC: float = Field(20.0, description="ambient temperature at the start, degC")
    trend_degC_per_h: float = Field(0.0, description="steady change of the ambient temperature, degC/h")
    wander_rms_degC: float = Field(0.0, ge=0, description="rms of its irregular change, degC")
    wander_time_s: float = Field(600.0, gt=0, description="correlation time of that, s")
    steps: list[StepSpec] = Field(default=[], description="sudden changes of the ambient temperature (sun, shade)")
    self_heating_degC: float = Field(0.0, description="rise above ambient in the long run, degC")
    start_heated: bool = Field(False, description="true: heating has acted for long; false: switched on at the start")
    tau_s: float = Field(300.0, ge=0, description="thermal time constant, s")
    per_sensor: bool = Field(False, description="true: one temperature for each sensor")
    spread: float = Field(
        0.2,
        ge=0,
        lt=1,
        description="relative spread of heating and time constant between sensors, where per_sensor",
    )


class SwitchedSpec(ChannelBase):
    """Switches between levels at random times: a heater, a pump, a transmitter."""

    type: Literal["switched"]
    levels: list[float] = Field(
        default=[0.0, 1.0], min_length=2, description="levels, channel units; each change goes to another one"
    )
    mean_hold_s: float = Field(60.0, gt=0, description="mean time at a level, s")
    ripple: float = Field(0.0, ge=0, description="rms of an irregular change of the level, relative")
    ripple_time_s: float = Field(5.0, gt=0, description="correlation time of that, s")
    units: str = Field("A", description="units")


class SupplySpec(ChannelBase):
    """A battery: its voltage falls with time and sags with the current drawn."""

    type: Literal["supply"]
    voltage_V: float = Field(12.0, description="voltage at the start without load, V")
    discharge_V_per_h: float = Field(0.0, ge=0, description="steady fall, V/h")
    resistance_ohm: float = Field(0.0, ge=0, description="inner resistance, ohm")
    loads: list[str] = Field(default=[], description="names of current channels drawn from it")
    wander_rms_V: float = Field(0.0, ge=0, description="rms of an irregular change, V")
    wander_time_s: float = Field(30.0, gt=0, description="correlation time of that, s")


class AngleSpec(ChannelBase):
    """The angle of a moving part, as an encoder gives it, in rad."""

    type: Literal["angle"]
    rate_deg_s: float = Field(0.0, description="steady rate, deg/s")
    swing_rms_deg: float = Field(60.0, ge=0, description="rms of an irregular swing, deg")
    swing_time_s: float = Field(5.0, gt=0, description="correlation time of that, s")


class SmoothSpec(ChannelBase):
    """Any quantity that varies smoothly and irregularly about a mean."""

    type: Literal["smooth"]
    mean: float = Field(0.0, description="mean, channel units")
    rms: float = Field(1.0, ge=0, description="rms about the mean, channel units")
    time_s: float = Field(30.0, gt=0, description="correlation time, s")
    units: str = Field("1", description="units")


class SineSpec(ChannelBase):
    """Any quantity that varies periodically."""

    type: Literal["sine"]
    mean: float = Field(0.0, description="mean, channel units")
    amplitude: float = Field(1.0, description="amplitude, channel units")
    period_s: float = Field(gt=0, description="period, s")
    phase_deg: float = Field(0.0, description="phase at the start, deg")
    units: str = Field("1", description="units")


class RampSpec(ChannelBase):
    """Any quantity that changes steadily."""

    type: Literal["ramp"]
    start: float = Field(0.0, description="value at the start, channel units")
    per_h: float = Field(1.0, description="change per hour, channel units")
    units: str = Field("1", description="units")


ChannelSpec = Annotated[
    TemperatureSpec | SwitchedSpec | SupplySpec | AngleSpec | SmoothSpec | SineSpec | RampSpec,
    Field(discriminator="type"),
]


@dataclass(frozen=True)
class Channel:
    """A channel on the survey's even time base: true values (N,) or (N, S), and units."""

    values: Array
    units: str


def _switched(spec: SwitchedSpec, rng: np.random.Generator, span: tuple[float, float]) -> Callable[[Array], Array]:
    """A step function; holds are exponential."""
    changes, levels = [span[0]], [int(rng.integers(len(spec.levels)))]
    while changes[-1] < span[1]:
        changes.append(changes[-1] + float(rng.exponential(spec.mean_hold_s)))
        levels.append((levels[-1] + 1 + int(rng.integers(len(spec.levels) - 1))) % len(spec.levels))
    at, value = np.array(changes), np.array(spec.levels, dtype=float)[levels]
    ripple = SmoothRandom(rng, span, spec.ripple_time_s, spec.ripple, 1)
    return lambda t: value[np.searchsorted(at, t, side="right") - 1] * (1 + ripple(t)[:, 0])


def _temperature(spec: TemperatureSpec, rng: np.random.Generator, time: Array, sensors: int) -> Array:
    """(N,) or (N, S) degC."""
    span = (float(time[0]), float(time[-1]))
    wander = SmoothRandom(rng, span, spec.wander_time_s, spec.wander_rms_degC, 1)
    bodies = sensors if spec.per_sensor else 1
    spread = 1 + (spec.spread * rng.uniform(-1, 1, (2, bodies)) if spec.per_sensor else np.zeros((2, 1)))
    heating, tau = spec.self_heating_degC * spread[0], spec.tau_s * spread[1]

    def ambient(t: Array) -> Array:
        out = spec.ambient_degC + spec.trend_degC_per_h * t / 3600 + wander(np.clip(t, *span))[:, 0]
        for step in spec.steps:
            out = out + step.change_degC * (t >= step.time_s)
        return np.repeat(out[:, None], bodies, axis=1)

    body = low_pass(ambient, time, tau)
    risen = 1.0 if spec.start_heated else -np.expm1(-(time - time[0])[:, None] / np.where(tau > 0, tau, 1e-9))
    out: Array = body + heating * risen
    return out if spec.per_sensor else out[:, 0]


def _at_any_instant(
    spec: SwitchedSpec | AngleSpec | SmoothSpec | SineSpec | RampSpec,
    rng: np.random.Generator,
    span: tuple[float, float],
) -> Callable[[Array], Array]:
    if isinstance(spec, SwitchedSpec):
        return _switched(spec, rng, span)
    if isinstance(spec, AngleSpec):
        swing = SmoothRandom(rng, span, spec.swing_time_s, np.deg2rad(spec.swing_rms_deg), 1)
        start = rng.uniform(0, 2 * np.pi)
        return lambda t: start + np.deg2rad(spec.rate_deg_s) * t + swing(t)[:, 0]
    if isinstance(spec, SmoothSpec):
        smooth = SmoothRandom(rng, span, spec.time_s, spec.rms, 1)
        return lambda t: spec.mean + smooth(t)[:, 0]
    if isinstance(spec, SineSpec):
        return lambda t: spec.mean + spec.amplitude * np.sin(2 * np.pi * t / spec.period_s + np.deg2rad(spec.phase_deg))
    return lambda t: spec.start + spec.per_h * t / 3600


def units_of(spec: ChannelSpec) -> str:
    """Units a channel is written in."""
    if isinstance(spec, TemperatureSpec):
        return "degC"
    if isinstance(spec, SupplySpec):
        return "V"
    return "rad" if isinstance(spec, AngleSpec) else spec.units


def one_channel(
    name: str, spec: ChannelSpec, seed: int, time: Array, sensors: int, currents: Mapping[str, Channel]
) -> Channel:
    """Simulate one channel on an even time base (N,) s.

    Raises:
        UsageError: a supply names a load that is not a channel.
    """
    rng = stream(seed, "channel", name)
    if isinstance(spec, TemperatureSpec):
        return Channel(_temperature(spec, rng, time, sensors), units_of(spec))
    span = (float(time[0]), float(time[-1]))
    if isinstance(spec, SupplySpec):
        wander = SmoothRandom(rng, span, spec.wander_time_s, spec.wander_rms_V, 1)
        voltage = spec.voltage_V - spec.discharge_V_per_h * time / 3600 + wander(time)[:, 0]
        for load in spec.loads:
            if load not in currents:
                raise UsageError(f"channels.{name}.loads: no channel {load!r}; known: {', '.join(currents) or 'none'}")
            voltage = voltage - spec.resistance_ohm * currents[load].values
        return Channel(voltage, units_of(spec))
    return Channel(_at_any_instant(spec, rng, span)(time), units_of(spec))


def build_channels(specs: Mapping[str, ChannelSpec], seed: int, time: Array, sensors: int) -> dict[str, Channel]:
    """All channels of a scenario; supplies last, because they sag under the currents."""
    out: dict[str, Channel] = {}
    for name in sorted(specs, key=lambda n: isinstance(specs[n], SupplySpec)):
        currents = {n: c for n, c in out.items() if c.values.ndim == 1}
        out[name] = one_channel(name, specs[name], seed, time, sensors, currents)
    return {name: out[name] for name in specs}


def logged(name: str, spec: ChannelSpec, channel: Channel, seed: int) -> Array:
    """What the logger writes: noise and resolution added to the true values."""
    rng = stream(seed, "logger", name)
    values = channel.values + spec.log_noise * rng.standard_normal(channel.values.shape)
    return np.rint(values / spec.log_resolution) * spec.log_resolution if spec.log_resolution > 0 else values
