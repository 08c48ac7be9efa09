"""Simulate a survey from a scenario.

Everything lives on the even time base of the sampling rate, from which the recorded samples are taken; what
has a shorter memory than a sample interval (eddy currents, filters, delays) is computed from the field between the
samples.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magtensor.errors import UsageError
from magtensor.simulate.base_station import Reference, read_base_station
from magtensor.simulate.channels import build_channels, logged
from magtensor.simulate.effects.base import CHUNK, Bench, EffectTruth, SensorEffectSpec, sensor_effect
from magtensor.simulate.effects.reference import ReferenceEffectSpec
from magtensor.simulate.effects.site import SiteEffectSpec, site_effect
from magtensor.simulate.field import FieldModel, Variation
from magtensor.simulate.gradiometers import Gradiometers
from magtensor.simulate.instrument import Instrument, InstrumentSpec, build_instrument
from magtensor.simulate.motion import (
    NOT_RECORDED,
    Motion,
    angular_rate,
    build_motion,
    specific_force,
)
from magtensor.simulate.motion_spec import length_s
from magtensor.simulate.noise import level, sensor_noise
from magtensor.simulate.rotations import exponential, multiply, transform
from magtensor.simulate.scenario import LoggingSpec, Scenario, read_scenario
from magtensor.simulate.sources import Dipole
from magtensor.simulate.spec import Array, stream

MAX_SAMPLES = 50_000_000  # some 25 GB of memory with four sensors


@dataclass(frozen=True)
class Truth:
    """What the survey hides.

    Attributes:
        b: (N, S, 3) nT, field at the stated sensor positions in the platform frame, site effects included.
        tensor: (N, 3, 3) nT/m at `centre` in the platform frame, [i, j] = dB_i / dx_j.
        total_field: (N,) nT at `centre`.
        centre: (3,) m, mean of the stated sensor positions.
        matrix: C (S, 3, 3); offset: o (S, 3) nT: the linear part of each sensor, m = C b + o.
        noise_sd: (S, 3) nT, white part, before any averaging.
        attitude: (N, 4) platform to world, scalar last.
        gradiometers: the errors of the elemental gradiometers, where there are any.
        effects: what was added on top.
    """

    b: Array
    tensor: Array
    total_field: Array
    centre: Array
    matrix: Array
    offset: Array
    noise_sd: Array
    attitude: Array
    gradiometers: Gradiometers | None
    effects: list[EffectTruth]


@dataclass(frozen=True)
class Simulated:
    """A simulated survey in the canonical variables, with its truth.

    Attributes:
        scenario: what it was made from.
        time: (N,) s since scenario.start; b_raw: (N, S, 3) nT; position: (S, 3) m; sensors: S names.
        segment: (N,) int, or None where the motion has no segments.
        reference: readings of the base station, or None.
        channels: name -> values, dimensions, units; those that are logged.
    """

    scenario: Scenario
    time: Array
    b_raw: Array
    position: Array
    sensors: list[str]
    segment: np.ndarray | None
    reference: Reference | None
    channels: dict[str, tuple[Array, tuple[str, ...], str]]
    truth: Truth


def simulate(scenario: Scenario | dict[str, Any] | str | os.PathLike[str], *, chunk: int = CHUNK) -> Simulated:
    """Simulate a survey.

    Args:
        scenario: checked, or as a mapping, or as the path of a YAML file.
        chunk: samples evaluated at once; bounds the memory and leaves the result alone.

    Raises:
        UsageError: the scenario is wrong.
    """
    if not isinstance(scenario, Scenario):
        scenario = read_scenario(scenario if isinstance(scenario, dict) else _mapping(scenario))
    samples = scenario.rate_Hz * length_s(scenario.motion, scenario.rate_Hz)
    if samples > MAX_SAMPLES:
        raise UsageError(f"motion: {samples:.3g} samples; up to {MAX_SAMPLES:.3g} can be simulated at once")
    instrument = build_instrument(scenario.instrument)
    motion = build_motion(scenario.motion, stream(scenario.seed, "motion"), scenario.rate_Hz)
    count = int(np.floor(motion.duration_s * scenario.rate_Hz + 1e-6))
    if count < 1:
        raise UsageError("motion: shorter than one sample interval")
    time = np.arange(count) / scenario.rate_Hz
    segment = motion.segment(time)
    kept = np.flatnonzero(segment != NOT_RECORDED)

    base = scenario.base_station
    variation = Variation(scenario.field.variation, stream(scenario.seed, "variation"), motion.duration_s)
    earth = scenario.field.earth.vector()
    dipoles = [Dipole(np.array(d.position_m), np.array(d.moment_Am2)) for d in scenario.field.dipoles]
    bench = Bench(
        time,
        kept,
        instrument,
        FieldModel(earth, variation, dipoles, motion),
        np.empty(0),
        build_channels(scenario.channels, scenario.seed, time, len(instrument.names)),
        scenario.seed,
        chunk,
    )
    bench, site = _on_site(scenario, bench)
    b_raw, added = _recorded(scenario, bench)
    reference = None
    if base is not None:
        reference, faults = read_base_station(
            base,
            [e for e in scenario.effects if isinstance(e, ReferenceEffectSpec)],
            earth,
            variation,
            stream(scenario.seed, "base_station"),
            motion.duration_s,
        )
        added += faults if scenario.truth == "effects" else [(t, np.empty(0)) for t, _ in faults]
    rows = _Rows(kept, segment, _averages(scenario))
    return Simulated(
        scenario=scenario,
        time=rows.taken(time),
        b_raw=rows.taken(b_raw),
        position=instrument.positions,
        sensors=instrument.names,
        segment=rows.numbers() if motion.numbered else None,
        reference=reference,
        channels=_logged(scenario, bench, rows),
        truth=_truth(scenario, bench, rows, site + added),
    )


def _mapping(path: str | os.PathLike[str]) -> dict[str, Any]:
    from magtensor.recipe.source import load_yaml

    value = load_yaml(os.fspath(path)).value
    if not isinstance(value, dict):
        raise UsageError(f"{os.fspath(path)}: not a scenario (a mapping is expected)")
    return value


def _averages(scenario: Scenario) -> bool:
    return bool(getattr(scenario.motion, "average", False))


class _Rows:
    """Takes the recorded samples, one by one or averaged over each segment."""

    def __init__(self, kept: np.ndarray, segment: np.ndarray, average: bool) -> None:
        self.kept, self.segment, self.average = kept, segment[kept], average
        changes = np.flatnonzero(np.diff(self.segment)) + 1
        self.begins = np.concatenate([[0], changes]) if len(kept) else changes

    def taken(self, values: Array) -> Array:
        """(N, ...) on the even time base to the rows of the survey."""
        if not self.average:
            return values if len(self.kept) == len(values) else values[self.kept]
        counts = np.diff(np.append(self.begins, len(self.kept)))
        sums: Array = np.add.reduceat(values[self.kept], self.begins, axis=0)
        return sums / counts.reshape(-1, *[1] * (values.ndim - 1))

    def first(self, values: Array) -> Array:
        """The same for what cannot be averaged and does not change within a segment."""
        return values[self.kept[self.begins]] if self.average else values[self.kept]

    def numbers(self) -> np.ndarray:
        """Segment of each row."""
        return self.segment[self.begins] if self.average else self.segment


def _on_site(scenario: Scenario, bench: Bench) -> tuple[Bench, list[tuple[EffectTruth, Array]]]:
    """Put the site effects into the field, then evaluate the field at the sensors."""
    done: list[tuple[EffectTruth, Array]] = []
    sources = list(bench.field.sources)
    for number, spec in _numbered(scenario):
        if isinstance(spec, SiteEffectSpec):
            truth, source, added = site_effect(spec, number, bench)
            sources.append(source)
            done.append((truth, added if scenario.truth == "effects" else np.empty(0)))
    bench = replace(bench, field=bench.field.with_sources(sources))
    bench.b = bench.field_at(bench.time, bench.instrument.positions)
    return bench, done


def _numbered(scenario: Scenario) -> list[tuple[int, Any]]:
    """Effects with their place among those of the same type."""
    seen: dict[str, int] = {}
    out = []
    for spec in scenario.effects:
        out.append((seen.get(spec.type, 0), spec))
        seen[spec.type] = seen.get(spec.type, 0) + 1
    return out


def _recorded(scenario: Scenario, bench: Bench) -> tuple[Array, list[tuple[EffectTruth, Array]]]:
    """Raw output on the even time base, and the sensor effects in it."""
    spec: InstrumentSpec = scenario.instrument
    raw = bench.output()
    each_sensor = sensor_noise(
        spec.noise, stream(scenario.seed, "noise"), len(bench.time), scenario.rate_Hz, bench.sensors
    )
    for i, noise in enumerate(each_sensor):
        raw[:, i] += transform(bench.instrument.matrix[i], noise) if spec.noise.enters == "field" else noise
    done: list[tuple[EffectTruth, Array]] = []
    for number, effect in _numbered(scenario):
        if isinstance(effect, SensorEffectSpec):
            truth, added = sensor_effect(effect, number, spec.seed, bench)
            raw += added
            done.append((truth, added if scenario.truth == "effects" else np.empty(0)))
    if spec.resolution_nT > 0:
        raw /= spec.resolution_nT
        np.rint(raw, out=raw)
        raw *= spec.resolution_nT
    if spec.range_nT is not None:
        np.clip(raw, -spec.range_nT, spec.range_nT, out=raw)
    return raw, done


def _logged(scenario: Scenario, bench: Bench, rows: _Rows) -> dict[str, tuple[Array, tuple[str, ...], str]]:
    """Everything that is written beside the field."""
    out: dict[str, tuple[Array, tuple[str, ...], str]] = {}
    for name, channel in bench.channels.items():
        spec = scenario.channels[name]
        if spec.logged:
            dims = ("time",) if channel.values.ndim == 1 else ("time", "sensor")
            out[name] = (rows.taken(logged(name, spec, channel, scenario.seed)), dims, channel.units)
    if bench.instrument.gradiometers is not None:
        readings = bench.instrument.gradiometers.readings(_tensor(bench), stream(scenario.seed, "gradiometers"))
        out |= {name: (rows.taken(values), ("time",), "nT m-1") for name, values in readings.items()}
    return out | _inertial(scenario.logging, bench.field.motion, bench, rows)


def _tensor(bench: Bench) -> Array:
    """(n, 3, 3) nT/m at the array's centre, on the even time base."""
    centre = bench.instrument.positions.mean(axis=0)
    return bench.over_time(lambda t: bench.field.tensor(t, centre))


def _inertial(
    spec: LoggingSpec, motion: Motion, bench: Bench, rows: _Rows
) -> dict[str, tuple[Array, tuple[str, ...], str]]:
    out: dict[str, tuple[Array, tuple[str, ...], str]] = {}
    rng = stream(bench.seed, "inertial")
    if spec.attitude:
        tilt = np.deg2rad(spec.attitude_noise_deg) * rng.standard_normal((len(bench.time), 3))
        attitude = multiply(bench.over_time(motion.attitude), exponential(tilt))
        out["attitude"] = (rows.first(attitude), ("time", "quaternion"), "1")
    if spec.angular_rate:
        if not motion.continuous:
            raise UsageError("logging.angular_rate: this motion is a list of attitudes and has no rate")
        rate = bench.over_time(lambda t: angular_rate(motion, t))
        rate += spec.angular_rate_noise_rad_s * rng.standard_normal(rate.shape)
        out["angular_rate"] = (rows.taken(rate), ("time", "axis"), "rad s-1")
    if spec.acceleration:
        force = bench.over_time(lambda t: specific_force(motion, t))
        force += spec.acceleration_noise_m_s2 * rng.standard_normal(force.shape)
        out["acceleration"] = (rows.taken(force), ("time", "axis"), "m s-2")
    return out


def _truth(scenario: Scenario, bench: Bench, rows: _Rows, effects: list[tuple[EffectTruth, Array]]) -> Truth:
    instrument: Instrument = bench.instrument
    centre = instrument.positions.mean(axis=0)
    tensor = _tensor(bench)
    total = bench.over_time(lambda t: np.linalg.norm(bench.field.at(t, centre[None])[:, 0], axis=-1))
    kinds = {True: rows.taken, False: lambda values: values}
    return Truth(
        b=rows.taken(bench.b),
        tensor=rows.taken(tensor),
        total_field=rows.taken(total),
        centre=centre,
        matrix=instrument.matrix,
        offset=instrument.offset,
        noise_sd=level(scenario.instrument.noise.white_sd_nT, len(instrument.names), "white_sd_nT"),
        attitude=rows.first(bench.over_time(bench.field.motion.attitude)),
        gradiometers=instrument.gradiometers,
        effects=[replace(t, added=kinds[t.kind != "reference"](a) if a.size else a) for t, a in effects],
    )
