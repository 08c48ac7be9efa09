"""The true field at the sensors: the Earth's, its variation in time, and local sources.

World frame: x east, y north, z up.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field, model_validator

from magtensor.simulate.motion import Motion
from magtensor.simulate.processes import SmoothRandom
from magtensor.simulate.rotations import congruence_back, matrices, transform, transform_back
from magtensor.simulate.sources import DipoleSpec, Source
from magtensor.simulate.spec import Array, Spec, Vector3

DAY_H = 24.0
VARIATION_REACH_S = 2 * 86400.0  # how far before and after the survey the variation is defined
TONES = 24  # sinusoids that make up one band of pulsations


class EarthSpec(Spec):
    """The steady Earth field, by its elements or as a vector."""

    total_field_nT: float | None = Field(None, gt=0, description="total field, nT")
    inclination_deg: float | None = Field(None, ge=-90, le=90, description="inclination, positive down, deg")
    declination_deg: float = Field(0.0, ge=-180, le=180, description="declination, positive east, deg")
    vector_nT: Vector3 | None = Field(None, description="east, north, up, nT; instead of the elements")

    @model_validator(mode="after")
    def _one_way(self) -> EarthSpec:
        elements = self.total_field_nT is not None and self.inclination_deg is not None
        if elements == (self.vector_nT is not None):
            raise ValueError("give either total_field_nT and inclination_deg, or vector_nT")
        return self

    def vector(self) -> Array:
        """(3,) nT: east, north, up."""
        if self.vector_nT is not None:
            return np.array(self.vector_nT)
        dip, east = np.deg2rad(float(self.inclination_deg or 0.0)), np.deg2rad(self.declination_deg)
        level = np.cos(dip)
        return float(self.total_field_nT or 0.0) * np.array([level * np.sin(east), level * np.cos(east), -np.sin(dip)])


class DiurnalSpec(Spec):
    """A quiet day: harmonics of 24, 12 and 8 h, largest at noon."""

    amplitude_nT: Vector3 = Field(description="deflection at noon: east, north, up, nT")
    start_hour: float = Field(9.0, ge=0, lt=24, description="local time at the start of the survey, h")


class PulsationSpec(Spec):
    """A band of geomagnetic pulsations: a narrow-band Gaussian process."""

    rms_nT: float = Field(ge=0, description="rms amplitude, nT")
    period_s: float = Field(gt=0, description="central period, s")
    relative_width: float = Field(0.2, gt=0, lt=1, description="standard deviation of the frequency over its mean")
    direction: Vector3 = Field(default=[0.2, 1.0, 0.3], description="polarisation: east, north, up")


class IrregularSpec(Spec):
    """Slow irregular variation of each component."""

    rms_nT: float = Field(ge=0, description="rms of each component, nT")
    time_s: float = Field(300.0, gt=0, description="correlation time, s")


class VariationSpec(Spec):
    """What changes in time, the same at the site and (but for reference_scale) at the base station."""

    diurnal: DiurnalSpec | None = Field(None, description="daily variation")
    pulsations: list[PulsationSpec] = Field(default=[], description="bands of pulsations")
    irregular: IrregularSpec | None = Field(None, description="slow irregular variation")


class FieldSpec(Spec):
    """The field at the place of the survey."""

    earth: EarthSpec = Field(description="steady Earth field")
    variation: VariationSpec = Field(default=VariationSpec(), description="variation in time")
    dipoles: list[DipoleSpec] = Field(default=[], description="dipole sources: what a survey looks for")


class Variation:
    """The change of the Earth field with time, (n, 3) nT in the world frame at times (n,) s."""

    def __init__(self, spec: VariationSpec, rng: np.random.Generator, duration_s: float) -> None:
        self.spec = spec
        self.bands = []
        for band in spec.pulsations:
            frequency = np.abs(1 + band.relative_width * rng.standard_normal(TONES)) / band.period_s
            phase = rng.uniform(0, 2 * np.pi, TONES)
            direction = np.array(band.direction) / np.linalg.norm(band.direction)
            self.bands.append((frequency, phase, band.rms_nT * np.sqrt(2 / TONES) * direction))
        span = (-VARIATION_REACH_S, duration_s + VARIATION_REACH_S)
        self.irregular = (
            SmoothRandom(rng, span, spec.irregular.time_s, spec.irregular.rms_nT, 3) if spec.irregular else None
        )

    def __call__(self, t: Array) -> Array:
        out = np.zeros((len(t), 3))
        if self.spec.diurnal:
            angle = 2 * np.pi * (self.spec.diurnal.start_hour - DAY_H / 2 + t / 3600) / DAY_H
            shape = (np.cos(angle) + 0.5 * np.cos(2 * angle) + 0.2 * np.cos(3 * angle)) / 1.7
            out += shape[:, None] * np.array(self.spec.diurnal.amplitude_nT)
        for frequency, phase, amplitude in self.bands:
            wave = np.zeros(len(t))
            for f, p in zip(frequency, phase, strict=True):
                wave += np.cos(2 * np.pi * f * t + p)
            out += wave[:, None] * amplitude
        if self.irregular:
            out += self.irregular(t)
        return out


class FieldModel:
    """The field and its gradient seen from the moving platform, at any instant."""

    def __init__(self, earth: Array, variation: Variation, sources: Sequence[Source], motion: Motion) -> None:
        self.earth, self.variation, self.sources, self.motion = earth, variation, tuple(sources), motion

    def with_sources(self, sources: Sequence[Source]) -> FieldModel:
        """The same Earth and motion, other local sources."""
        return FieldModel(self.earth, self.variation, sources, self.motion)

    def at(self, t: Array, offsets: Array) -> Array:
        """Field (n, S, 3) nT in the platform frame.

        Args:
            t: (n,) s since the start.
            offsets: (S, 3) or (n, S, 3) m, sensor positions in the platform frame.
        """
        rotation = matrices(self.motion.attitude(t))[:, None]
        world = (self.earth + self.variation(t))[:, None]
        shape = (len(t), offsets.shape[-2], 3)
        return np.broadcast_to(transform_back(rotation, world), shape) + self.local(t, offsets)

    def local(self, t: Array, offsets: Array) -> Array:
        """The local sources' part of `at`."""
        shape = (len(t), offsets.shape[-2], 3)
        if not self.sources:
            return np.zeros(shape)
        rotation = matrices(self.motion.attitude(t))[:, None]
        x = self.motion.origin(t)[:, None] + transform(rotation, np.broadcast_to(offsets, shape))
        world = np.zeros(shape)
        for source in self.sources:
            world += source.field(t, x)
        return transform_back(rotation, world)

    def tensor(self, t: Array, centre: Array) -> Array:
        """Gradient tensor (n, 3, 3) nT/m in the platform frame at a point (3,) m of it; [i, j] = dB_i / dx_j."""
        rotation = matrices(self.motion.attitude(t))
        x = self.motion.origin(t) + transform(rotation, centre)
        world = np.zeros((len(t), 3, 3))
        for source in self.sources:
            world += source.gradient(t, x)
        return congruence_back(rotation, world)
