"""A scalar base station beside the site: proton, Overhauser or optically pumped, on its own time base."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from magtensor.errors import UsageError
from magtensor.simulate.effects.base import EffectTruth
from magtensor.simulate.effects.reference import MAX_CLOCK_ERROR_S, ReferenceEffectSpec, reference_effect
from magtensor.simulate.field import VARIATION_REACH_S, Variation
from magtensor.simulate.spec import Array, Spec


class GapSpec(Spec):
    """A time in which the base station recorded nothing."""

    begin_s: float = Field(description="begin, s since the start of the survey")
    length_s: float = Field(gt=0, description="length, s")


class BaseStationSpec(Spec):
    """What is known of the base station; what is not known goes under effects (reference_*)."""

    rate_Hz: float = Field(1.0, gt=0, description="readings per second, Hz")
    first_s: float | None = Field(None, description="time of its first reading, s since the start; null: 60 s before")
    last_s: float | None = Field(None, description="time after which it stops, s; null: 60 s after the survey")
    noise_sd_nT: float = Field(0.05, ge=0, description="standard deviation of a reading, nT")
    resolution_nT: float = Field(0.01, ge=0, description="step of a reading, nT; 0: none")
    difference_nT: float = Field(0.0, description="steady difference of the total field, base minus site, nT")
    latency_s: float = Field(0.0, ge=-3600, le=3600, description="known delay: time stamp minus time of measurement, s")
    gaps: list[GapSpec] = Field(default=[], description="times without readings")


@dataclass(frozen=True)
class Reference:
    """Readings of the base station: stamps (M,) s since the start, total field (M,) nT."""

    time: Array
    total_field: Array


BASE_MARGIN_S = 60.0


def reading_times(spec: BaseStationSpec, duration_s: float) -> tuple[float, float]:
    """First and last time stamp the base station may have, s."""
    first = -BASE_MARGIN_S if spec.first_s is None else spec.first_s
    last = duration_s + BASE_MARGIN_S if spec.last_s is None else spec.last_s
    return first, last


def read_base_station(
    spec: BaseStationSpec,
    effects: Sequence[ReferenceEffectSpec],
    earth: Array,
    variation: Variation,
    rng: np.random.Generator,
    duration_s: float,
) -> tuple[Reference, list[tuple[EffectTruth, Array]]]:
    """The readings, and for each reference effect its truth and what it added to them.

    Raises:
        UsageError: no reading is left, or they reach days beyond the survey.
    """
    first, last = reading_times(spec, duration_s)
    reach = VARIATION_REACH_S - MAX_CLOCK_ERROR_S - abs(spec.latency_s)
    if first < -reach or last > duration_s + reach:
        raise UsageError(f"base_station: readings up to {reach:g} s before and after the survey can be simulated")
    stamp = first + np.arange(max(0, int(np.floor((last - first) * spec.rate_Hz + 1e-9)) + 1)) / spec.rate_Hz
    recorded = np.ones(len(stamp), dtype=bool)
    for gap in spec.gaps:
        recorded &= (stamp < gap.begin_s) | (stamp >= gap.begin_s + gap.length_s)
    if not recorded.any():
        raise UsageError("base_station: no reading is left between first_s and last_s and outside the gaps")

    def total_field(t: Array, diurnal_ratio: float) -> Array:
        vector = earth + diurnal_ratio * variation(t - spec.latency_s)
        return np.sqrt(vector[:, 0] ** 2 + vector[:, 1] ** 2 + vector[:, 2] ** 2) + spec.difference_nT

    field = total_field(stamp, 1.0) + spec.noise_sd_nT * rng.standard_normal(len(stamp))
    within = recorded & (stamp >= 0) & (stamp <= duration_s)
    within = within if within.any() else recorded
    done = [reference_effect(effect, total_field, stamp, within) for effect in effects]
    for _, added in done:
        field = field + added
    if spec.resolution_nT > 0:
        field = np.rint(field / spec.resolution_nT) * spec.resolution_nT
    return Reference(stamp[recorded], field[recorded]), [(truth, added[recorded]) for truth, added in done]
