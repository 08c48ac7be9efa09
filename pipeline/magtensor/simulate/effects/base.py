"""What an effect is, and the bench on which it acts.

An effect has settings and coefficients. Its waveform is what it adds to the raw output of each sensor, computed
from the undisturbed field and output; effects add up, and what they do to one another (the product of two small
things) is left out. Coefficients are given in physical units, or drawn from the instrument's seed and scaled so
that the effect has the rms asked for.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from magtensor.errors import UsageError, did_you_mean
from magtensor.simulate.channels import Channel
from magtensor.simulate.field import FieldModel
from magtensor.simulate.instrument import Instrument
from magtensor.simulate.processes import low_pass, play
from magtensor.simulate.rotations import transform
from magtensor.simulate.spec import Array, Spec, per_sensor, stream

CHUNK = 1 << 15  # samples evaluated at once: bounds the memory, has no influence on the result
SUBSTEPS = 4  # steps per sample interval between which a hysteresis loop is followed

Kind = Literal["instrument", "site", "reference"]


@dataclass
class Bench:
    """A survey under simulation, on the even time base that the kept samples are taken from.

    Attributes:
        time: (N,) s since the start; kept: (K,) indices of the recorded samples.
        b: (N, S, 3) nT, true field at the nominal sensor positions in the platform frame, site effects included.
        channels: true values of all channels.
        seed: of the scenario.
    """

    time: Array
    kept: np.ndarray
    instrument: Instrument
    field: FieldModel
    b: Array
    channels: dict[str, Channel]
    seed: int
    chunk: int = CHUNK

    @property
    def sensors(self) -> int:
        return len(self.instrument.names)

    @property
    def rate_Hz(self) -> float:
        return float((len(self.time) - 1) / (self.time[-1] - self.time[0])) if len(self.time) > 1 else 1.0

    def pieces(self) -> Iterator[slice]:
        """Slices of at most `chunk` samples."""
        for begin in range(0, len(self.time), self.chunk):
            yield slice(begin, min(begin + self.chunk, len(self.time)))

    def sensed(self, vectors: Array) -> Array:
        """C v for fields (N, S, 3) or (N, 1, 3) nT: what the sensors make of them, without offset."""
        out = np.empty((len(vectors), self.sensors, 3))
        for begin in range(0, len(vectors), self.chunk):
            piece = slice(begin, begin + self.chunk)
            out[piece] = transform(self.instrument.matrix, vectors[piece])
        return out

    def output(self) -> Array:
        """C b + o (N, S, 3) nT: the raw output without effects and noise."""
        out = self.sensed(self.b)
        out += self.instrument.offset
        return out

    def over_time(self, function: Callable[[Array], Array]) -> Array:
        """A function of times (n,) that gives (n, ...), over the whole time base."""
        return np.concatenate([function(self.time[piece]) for piece in self.pieces()])

    def field_at(self, time: Array, offsets: Array) -> Array:
        """Field (N, S', 3) nT at other times (N,) s or places, (S', 3) or (N, S', 3) m."""
        out = np.empty((len(time), offsets.shape[-2], 3))
        for piece in self.pieces():
            out[piece] = self.field.at(time[piece], offsets[piece] if offsets.ndim == 3 else offsets)
        return out

    def lagged_field(self, tau_s: float) -> Array:
        """x (N, S, 3) nT of tau x' + x = b; in a uniform field (N, 1, 3)."""
        places = self.instrument.positions if self.field.sources else self.instrument.positions[:1]
        return low_pass(lambda t: self.field.at(t, places), self.time, tau_s, chunk=self.chunk)

    def left_behind(self, half_widths: Sequence[float], seen: Callable[[Array], Array]) -> Array:
        """(N, S, 3) nT: the mean of P_r(u) - u with the play operators P_r of these half widths, nT, followed between
        the samples too. `seen` makes of the field (n, S, 3) what moves them."""
        out = np.zeros(self.b.shape)
        states: list[Array | None] = [None] * len(half_widths)
        step = 1 / (self.rate_Hz * SUBSTEPS)
        for piece in self.pieces():
            count = piece.stop - piece.start
            fine = self.time[0] + (piece.start * SUBSTEPS + np.arange(count * SUBSTEPS)) * step
            u = seen(self.field.at(fine, self.instrument.positions)).reshape(len(fine), -1)
            for i, half_width in enumerate(half_widths):
                followed = play(u, half_width, states[i])
                states[i] = followed[-1].copy()
                out[piece] += (followed - u)[::SUBSTEPS].reshape(count, self.sensors, 3)
        return out / len(half_widths)

    def channel(self, name: str, effect: str) -> Array:
        """(N, S): true values of a channel at each sensor.

        Raises:
            UsageError: the scenario has no such channel.
        """
        if name not in self.channels:
            raise UsageError(
                f"effect {effect}: no channel {name!r}{did_you_mean(name, self.channels)}; "
                f"the scenario has {', '.join(self.channels) or 'none'}"
            )
        values = self.channels[name].values
        return values if values.ndim == 2 else np.repeat(values[:, None], self.sensors, axis=1)

    def lagged_channel(self, name: str, lag_s: float, effect: str) -> Array:
        """(N, S): the channel seen through a first-order lag, settled at the start."""
        values = self.channel(name, effect)
        if lag_s == 0:
            return values
        interpolated = lambda t: np.stack([np.interp(t, self.time, column) for column in values.T], axis=-1)  # noqa: E731
        return low_pass(interpolated, self.time, lag_s, chunk=self.chunk)

    def kept_mean(self, values: Array) -> Array:
        """Mean over the recorded samples."""
        out: Array = values[self.kept].mean(axis=0)
        return out


@dataclass(frozen=True)
class EffectTruth:
    """What an effect did.

    Attributes:
        name, kind: as in the catalogue of error models.
        rms_nT: over the recorded samples, axes and affected sensors.
        sensors: the affected ones.
        settings: as given; coefficients: name with units, and the values used.
        added: (K, S, 3) nT on the raw output, or (M,) nT on the reference; empty where not kept.
    """

    name: str
    kind: Kind
    rms_nT: float
    sensors: list[str]
    settings: dict[str, Any]
    coefficients: dict[str, Any]
    added: Array = field(default_factory=lambda: np.empty(0))


class EffectSpec(Spec):
    """Base of the effects."""

    KIND: ClassVar[Kind] = "instrument"
    COEFFICIENTS: ClassVar[str]  # the field that holds them
    LINEAR: ClassVar[bool] = True  # whether the waveform is proportional to the coefficients
    DYNAMIC: ClassVar[bool] = False  # whether it depends on how the attitude changes between the samples

    rms_nT: float | None = Field(
        None,
        gt=0,
        description=(
            "scale the coefficients so that the effect has this rms over samples, axes and affected sensors, nT"
        ),
    )

    @property
    def name(self) -> str:
        """Name in the catalogue of error models."""
        return str(getattr(self, "type"))  # noqa: B009

    @property
    def given(self) -> Any:
        """The coefficients as given, None where they are to be drawn."""
        return getattr(self, self.COEFFICIENTS)

    @model_validator(mode="after")
    def _has_amplitude(self) -> EffectSpec:
        if self.given is None and self.rms_nT is None:
            raise ValueError(f"give {self.COEFFICIENTS} or rms_nT (or both: then it is scaled)")
        return self


class SensorEffectSpec(EffectSpec):
    """An effect on the raw output of the sensors."""

    sensors: list[str] | None = Field(None, min_length=1, description="names of the sensors it acts on; all where null")
    alike: bool = Field(
        False, description="where drawn: true: the same coefficients for all sensors; false: each sensor has its own"
    )

    @model_validator(mode="after")
    def _alike_if_drawn(self) -> SensorEffectSpec:
        if self.alike and self.given is not None:
            raise ValueError(f"alike is for coefficients that are drawn; {self.COEFFICIENTS} says what each sensor has")
        return self

    def drawn(self, bench: Bench, rng: np.random.Generator) -> Array:
        """Coefficients of random size and sign; (S, 3) unless overridden."""
        return rng.standard_normal((bench.sensors, 3))

    def read(self, bench: Bench) -> Array:
        """Coefficients as given; one vector for all sensors, or one for each, unless overridden."""
        return per_sensor(self.given, bench.sensors, f"effect {self.name}: {self.COEFFICIENTS}")

    @abstractmethod
    def waveform(self, bench: Bench, coefficients: Array) -> Array:
        """What it adds to the raw output, (N, S, 3) nT."""


def stop_if_jumping(effect: EffectSpec, bench: Bench) -> None:
    """Refuse an effect that needs rates where the attitude jumps from sample to sample."""
    if effect.DYNAMIC and not bench.field.motion.continuous:
        raise UsageError(
            f"effect {effect.name} depends on how the array turns; this motion is a list of attitudes. "
            "Use tumbling, limited_tilt, postures, one_axis or survey_lines"
        )


def scaled_to(effect: EffectSpec, rms: float, target: float) -> float:
    """target / rms, or a clear refusal where the effect does nothing on this survey."""
    if not rms > 0:
        raise UsageError(f"effect {effect.name} adds nothing on this survey, so it cannot be scaled to rms_nT")
    return target / rms


def sensor_effect(spec: SensorEffectSpec, number: int, instrument_seed: int, bench: Bench) -> tuple[EffectTruth, Array]:
    """Evaluate one effect.

    Args:
        number: its place among the scenario's effects of the same type: two of them draw different coefficients.
        instrument_seed: where its coefficients are drawn from.

    Returns:
        its truth (with nothing in `added`), and what it adds to the raw output, (N, S, 3) nT.

    Raises:
        UsageError: a sensor or channel that does not exist, or an effect that needs another motion.
    """
    stop_if_jumping(spec, bench)
    known = bench.instrument.names
    affected = spec.sensors or known
    for sensor in affected:
        if sensor not in known:
            raise UsageError(f"effect {spec.name}: no sensor {sensor!r}; the array has {', '.join(known)}")
    idle = [i for i, sensor in enumerate(known) if sensor not in affected]

    def run(values: Array) -> tuple[Array, float]:
        added = spec.waveform(bench, values)
        added[:, idle] = 0.0
        return added, rms_of(added, bench.kept, len(affected))

    rng = stream(instrument_seed, "effect", spec.name, str(number))
    values = spec.drawn(bench, rng) if spec.given is None else spec.read(bench)
    if spec.alike:
        if values.shape[:1] != (bench.sensors,):
            raise UsageError(f"effect {spec.name} has no coefficients of each sensor, so alike says nothing of it")
        values = np.broadcast_to(values[:1], values.shape)
    added, rms = run(values)
    if spec.rms_nT is not None:
        for _ in range(1 if spec.LINEAR else 8):
            factor = scaled_to(spec, rms, spec.rms_nT)
            values = values * factor
            if spec.LINEAR:
                added *= factor
                rms = spec.rms_nT
            elif abs(factor - 1) > 1e-6:
                added, rms = run(values)
    return truth_of(spec, rms, affected, values), added


def rms_of(added: Array, kept: np.ndarray, sensors: int) -> float:
    """Rms over the recorded samples, the axes and the affected sensors."""
    total = sum(float(np.square(added[kept[i : i + CHUNK]]).sum()) for i in range(0, len(kept), CHUNK))
    return float(np.sqrt(total / (len(kept) * sensors * 3)))


def truth_of(spec: EffectSpec, rms: float, sensors: list[str], values: Array) -> EffectTruth:
    """The record of an effect with the coefficients it ended up with."""
    settings = spec.model_dump(exclude={"type", "rms_nT", "sensors", "alike", spec.COEFFICIENTS})
    return EffectTruth(spec.name, spec.KIND, rms, sensors, settings, {spec.COEFFICIENTS: np.asarray(values).tolist()})
