"""Errors of the base station, declared beside the other effects because nobody knows of them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from magtensor.errors import UsageError
from magtensor.simulate.effects.base import EffectSpec, EffectTruth, Kind, scaled_to
from magtensor.simulate.spec import Array

TotalField = Callable[[Array, float], Array]  # (times (n,) s, diurnal ratio) -> (n,) nT at the base station


MAX_CLOCK_ERROR_S = 86400.0  # a time zone, or the wrong day


class ReferenceEffectSpec(EffectSpec):
    """An error of the reference total field."""

    KIND: ClassVar[Kind] = "reference"

    def values(self) -> Array:
        """Coefficients as given, or of unit size."""
        return np.asarray(1.0 if self.given is None else self.given, dtype=float)

    @abstractmethod
    def waveform(self, total_field: TotalField, stamp: Array, coefficients: Array) -> Array:
        """What it adds to the reference at its time stamps (M,) s, nT."""


class ReferenceScale(ReferenceEffectSpec):
    """The variation at the base station is larger or smaller than at the site."""

    COEFFICIENTS = "excess"
    type: Literal["reference_scale"]
    excess: float | None = Field(
        None,
        gt=-1,
        description="relative: 0.05 where the base station sees 5 % more of the variation than the site",
    )

    def waveform(self, total_field: TotalField, stamp: Array, coefficients: Array) -> Array:
        return total_field(stamp, 1 + float(coefficients)) - total_field(stamp, 1.0)


class ReferenceClock(ReferenceEffectSpec):
    """The base station's clock is late or early, and drifts: its stamp is true time + offset + drift."""

    COEFFICIENTS = "offset_s"
    type: Literal["reference_clock"]
    offset_s: float | None = Field(None, description="stamp minus true time at the start, s")
    drift_ppm: float = Field(0.0, description="further drift, 1e-6; scaled together with the offset")

    def waveform(self, total_field: TotalField, stamp: Array, coefficients: Array) -> Array:
        drift = 1e-6 * self.drift_ppm * float(coefficients) / float(self.values() or 1.0)
        late = float(coefficients) + drift * stamp
        if not np.abs(late).max() <= MAX_CLOCK_ERROR_S:
            raise UsageError(
                f"effect reference_clock: a clock error of {np.abs(late).max():.3g} s; up to one day can be simulated"
            )
        return total_field(stamp - late, 1.0) - total_field(stamp, 1.0)


class ReferenceDrift(ReferenceEffectSpec):
    """The base station drifts, steadily or until it has warmed up."""

    COEFFICIENTS = "rate_nT_h"
    type: Literal["reference_drift"]
    rate_nT_h: float | None = Field(None, description="drift at the start, nT/h")
    settles_s: float | None = Field(None, gt=0, description="time constant with which it settles, s; null: it goes on")

    def waveform(self, total_field: TotalField, stamp: Array, coefficients: Array) -> Array:
        lasted = stamp if self.settles_s is None else self.settles_s * -np.expm1(-stamp / self.settles_s)
        out: Array = float(coefficients) * lasted / 3600.0
        return out


class ReferenceStep(ReferenceEffectSpec):
    """The base station was moved or retuned."""

    COEFFICIENTS = "steps_nT"
    type: Literal["reference_step"]
    steps_nT: list[float] | None = Field(
        None, min_length=1, description="change at each time, nT; all equal where null"
    )
    time_s: list[float] = Field(min_length=1, description="times, s since the start")

    @model_validator(mode="after")
    def _as_many(self) -> ReferenceStep:
        if self.steps_nT is not None and len(self.steps_nT) != len(self.time_s):
            raise ValueError("steps_nT and time_s need the same number of entries")
        return self

    def values(self) -> Array:
        return np.ones(len(self.time_s)) if self.steps_nT is None else np.array(self.steps_nT)

    def waveform(self, total_field: TotalField, stamp: Array, coefficients: Array) -> Array:
        added = np.zeros(len(stamp))
        for at, step in zip(self.time_s, coefficients, strict=True):
            added += step * (stamp >= at)
        return added


def reference_effect(
    spec: ReferenceEffectSpec, total_field: TotalField, stamp: Array, within: np.ndarray
) -> tuple[EffectTruth, Array]:
    """The effect's truth and what it adds to the reference, (M,) nT.

    Args:
        stamp: (M,) s, the base station's time stamps; within: (M,) bool, those during the survey, over which
            the rms is taken.
    """
    values = spec.values()
    added = spec.waveform(total_field, stamp, values)
    rms = float(np.sqrt(np.mean(added[within] ** 2)))
    if spec.rms_nT is not None:
        for _ in range(4):
            values = values * scaled_to(spec, rms, spec.rms_nT)
            added = spec.waveform(total_field, stamp, values)
            rms = float(np.sqrt(np.mean(added[within] ** 2)))
    settings = spec.model_dump(exclude={"type", "rms_nT", spec.COEFFICIENTS})
    truth = EffectTruth(spec.name, spec.KIND, rms, [], settings, {spec.COEFFICIENTS: values.tolist()})
    return truth, added
