"""A constant in the place of a base station: what the field does meanwhile is no effect of the instrument."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, synthetic

from magtensor.loop.fitting.model import Fitting, Record
from magtensor.loop.searching.found import Search
from magtensor.loop.searching.search import search
from magtensor.loop.searching.unexplained import unexplained
from magtensor.registry import Registry

SAMPLES = 1200
CONSTANT = 50_000.0
MODELS = ("scale_drift", "scale_step", "temperature_scale", "reference_drift", "offset_drift")
TIME = np.arange(SAMPLES) / SAMPLES


def without_station(seed: int, field: Array, share: Array | None = None) -> Record:
    """Outputs in a field (N,) nT of which only a constant is known, each sensor's multiplied by 1 + share (N, S)."""
    record = synthetic(seed, SAMPLES)
    assert record.total_field is not None
    raw = record.raw * (field / record.total_field)[:, None, None]
    if share is not None:
        raw = raw * (1.0 + share[:, :, None])
    warming = 20.0 + 3.0 * TIME
    known = np.full(SAMPLES, CONSTANT)
    logged = {"temperature": warming}
    more = {"logged": logged, "origins": {"temperature": 20.0}, "units": {"temperature": "degC"}}
    return replace(record, raw=raw, total_field=known, quiet_field=known, **more)  # type: ignore[arg-type]


def found(record: Record) -> Search:
    registry = Registry.load()
    return search(record, [registry.find("error_model", name) for name in MODELS], Fitting())


@pytest.mark.parametrize("course", [TIME, 1.0 * (TIME > 0.6)], ids=["it drifts", "it jumps, for the array was moved"])
@pytest.mark.parametrize("nT", [5.0, 300.0])
def test_a_field_that_changes_is_no_scale_of_the_sensors(nT: float, course: Array) -> None:
    result = found(without_station(1, CONSTANT + nT * course))
    assert result.last.adopted == ()
    refused = [why for step in result.steps for why in step.refused.values()]
    assert any("the field, of which only a constant is known, would look the same" in why for why in refused)
    told = unexplained(result, result.record)
    assert told["present"] and "mostly in |b| - F, alike in all sensors" in told["description"]


def test_a_scale_factor_of_one_sensor_is_found_beside_a_constant() -> None:
    share = np.zeros((SAMPLES, 4))
    share[:, 1] = 1e-4 * TIME
    result = found(without_station(2, np.full(SAMPLES, CONSTANT), share))
    (adopted,) = result.last.adopted
    assert (adopted.name, adopted.sensors) in {("scale_drift", ("S2",)), ("temperature_scale", ("S2",))}
