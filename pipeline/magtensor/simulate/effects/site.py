"""Real fields at the place of the survey that are not its target. They are part of the true field."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from magtensor.simulate.effects.base import Bench, EffectSpec, EffectTruth, Kind, rms_of, scaled_to, truth_of
from magtensor.simulate.sources import Dipole, Source, UniformGradient, traceless_symmetric
from magtensor.simulate.spec import Array, Vector3, stream


class SiteEffectSpec(EffectSpec):
    """An effect that is a source in the world."""

    KIND: ClassVar[Kind] = "site"

    @abstractmethod
    def source(self, coefficients: Array) -> Source:
        """The source, proportional to its coefficients."""


class FixedSource(SiteEffectSpec):
    """A magnetic thing on the ground near the rig."""

    COEFFICIENTS = "moment_Am2"
    type: Literal["fixed_source"]
    position_m: Vector3 = Field(description="east, north, up of the survey's origin, m")
    moment_Am2: Vector3 | None = Field(None, description="east, north, up, A m^2; drawn where null")

    def source(self, coefficients: Array) -> Source:
        return Dipole(np.array(self.position_m), coefficients)


class SiteGradient(SiteEffectSpec):
    """The field at the site is not uniform."""

    COEFFICIENTS = "tensor_nT_per_m"
    type: Literal["site_gradient"]
    tensor_nT_per_m: list[float] | None = Field(
        None,
        min_length=5,
        max_length=5,
        description="xx, xy, xz, yy, yz in the world frame, nT/m; drawn where null",
    )

    def source(self, coefficients: Array) -> Source:
        return UniformGradient(traceless_symmetric(coefficients.tolist()))


class PassingSource(SiteEffectSpec):
    """A vehicle passes by: a dipole on a straight track."""

    COEFFICIENTS = "moment_Am2"
    type: Literal["passing_source"]
    moment_Am2: Vector3 | None = Field(None, description="east, north, up, A m^2; drawn where null")
    time_s: float = Field(description="when it is at closest_m, s since the start")
    closest_m: Vector3 = Field(description="its position then: east, north, up, m")
    velocity_m_s: Vector3 = Field(description="east, north, up, m/s")

    def source(self, coefficients: Array) -> Source:
        return Dipole(np.array(self.closest_m), coefficients, np.array(self.velocity_m_s), self.time_s)


def site_effect(spec: SiteEffectSpec, number: int, bench: Bench) -> tuple[EffectTruth, Source, Array]:
    """The effect's truth, its source, and what it adds to the raw output, (N, S, 3) nT.

    Args:
        number: its place among the scenario's effects of the same type.
        bench: of the survey without site effects.
    """
    if spec.given is None:
        size = 5 if isinstance(spec, SiteGradient) else 3
        values = stream(bench.seed, "effect", spec.name, str(number)).standard_normal(size)
    else:
        values = np.array(spec.given, dtype=float)
    source = spec.source(values)
    model = bench.field.with_sources([source])
    added = bench.sensed(bench.over_time(lambda t: model.local(t, bench.instrument.positions)))
    rms = rms_of(added, bench.kept, bench.sensors)
    if spec.rms_nT is not None:
        factor = scaled_to(spec, rms, spec.rms_nT)
        values, source, rms = values * factor, source.scaled(factor), spec.rms_nT
        added *= factor
    return truth_of(spec, rms, list(bench.instrument.names), values), source, added
