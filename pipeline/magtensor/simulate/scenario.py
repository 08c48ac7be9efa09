"""A scenario: everything that `magtensor simulate` needs to know, as one strict model."""

from __future__ import annotations

import json
import re
from datetime import date
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from magtensor.errors import UsageError
from magtensor.simulate.base_station import BaseStationSpec
from magtensor.simulate.channels import ChannelSpec, units_of
from magtensor.simulate.effects import AnyEffect
from magtensor.simulate.effects.reference import ReferenceEffectSpec
from magtensor.simulate.field import FieldSpec
from magtensor.simulate.instrument import InstrumentSpec
from magtensor.simulate.motion_spec import MotionSpec
from magtensor.simulate.spec import Spec, UtcTime

RESERVED = {"time", "b_raw", "position", "sensor", "axis", "quaternion", "segment", "attitude"}
RESERVED |= {"acceleration", "angular_rate", "reference", "truth", "calibrated"}


class LoggingSpec(Spec):
    """Attitude and inertial channels written to the survey."""

    attitude: bool = Field(False, description="write the attitude, as a quaternion")
    attitude_noise_deg: float = Field(0.0, ge=0, description="standard deviation of each component of its error, deg")
    angular_rate: bool = Field(False, description="write the angular rate")
    angular_rate_noise_rad_s: float = Field(0.0, ge=0, description="standard deviation of its noise, rad/s")
    acceleration: bool = Field(False, description="write the specific force")
    acceleration_noise_m_s2: float = Field(0.0, ge=0, description="standard deviation of its noise, m/s^2")


class Scenario(Spec):
    """A survey to be simulated. World frame: x east, y north, z up; attitudes platform to world, scalar last."""

    title: str = Field(description="what the scenario shows")
    authors: list[str] = Field(default=[], description="who wrote it")
    references: list[str] = Field(default=[], description="where its figures come from")
    seed: int = Field(
        ge=0, description="seed of everything random that is not the instrument; equal seeds give equal bits"
    )
    start: UtcTime = Field(default="2026-01-01T00:00:00Z", description="time of the first sample, UTC")
    rate_Hz: float = Field(10.0, gt=0, description="sampling rate of the array, Hz")
    instrument: InstrumentSpec = Field(description="the array and its sensors")
    motion: MotionSpec = Field(description="how the array moves")
    field: FieldSpec = Field(description="the field at the place of the survey")
    base_station: BaseStationSpec | None = Field(None, description="scalar reference; none where null")
    channels: dict[str, ChannelSpec] = Field(
        default={}, description="further channels by name: temperature, current_<name>, ..."
    )
    logging: LoggingSpec = Field(default=LoggingSpec(), description="attitude and inertial channels")
    effects: list[AnyEffect] = Field(default=[], description="what goes wrong, by the names of the error models")
    truth: bool | Literal["effects"] = Field(
        True, description="write the true values into the group /truth; effects: with each effect's waveform"
    )

    @field_validator("channels")
    @classmethod
    def _usable_names(cls, channels: dict[str, ChannelSpec]) -> dict[str, ChannelSpec]:
        for name, spec in channels.items():
            if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or name in RESERVED:
                raise ValueError(f"a channel cannot be called {name!r}")
            if name == "temperature" and units_of(spec) != "degC":
                raise ValueError("channel temperature must be of type temperature")
            if name.startswith("current_") and units_of(spec) != "A":
                raise ValueError(f"channel {name} must have the units A")
        return channels

    @model_validator(mode="after")
    def _reference_exists(self) -> Scenario:
        if self.base_station is None and any(isinstance(e, ReferenceEffectSpec) for e in self.effects):
            raise ValueError("reference_* effects need a base_station")
        return self


def read_scenario(mapping: dict[str, Any]) -> Scenario:
    """Check a mapping, as a YAML file holds it or as Python code builds it (times and numpy values allowed).

    Raises:
        UsageError: with every mistake on a line of its own: where, what, and the nearest known word.
    """
    from magtensor.recipe.problems import Problems
    from magtensor.recipe.source import Document

    try:
        plain = json.loads(json.dumps(mapping, default=_plain))
    except TypeError as error:
        raise UsageError(f"scenario: {error}") from None
    problems = Problems(Document(plain, "scenario"))
    checked = problems.validated(Scenario, plain, ())
    problems.raise_if_any()
    assert checked is not None
    return checked


def _plain(value: object) -> object:
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{value!r} cannot stand in a scenario")
