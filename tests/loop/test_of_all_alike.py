"""What all sensors show alike: nothing but another reference would tell it from a drift of the base station."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import linear_state, looked_at, scenario, synthetic, verdict_of
from scipy.ndimage import gaussian_filter1d

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.like_a_station import (
    as_a_station_would,
    channels_of_the_total_field,
    stations_like,
    turns_with_the_platform,
)
from magtensor.loop.searching.own_fit import plainer_forms
from magtensor.registry import Registry

BESIDE_DRIFTS = [
    "temperature_offset", "temperature_scale", "current_field", "channel_response", "offset_drift", "warm_up",
    "reference_drift", "reference_scale",
]  # fmt: skip
STATIONS = ["reference_drift", "reference_step", "reference_while", "reference_scale", "offset_drift", "scale_step"]
FOLLOWING = ["temperature_scale", "temperature_offset", "channel_response"]


@pytest.mark.parametrize(("sensors", "alike"), [((0, 1, 2, 3), True), ((1,), False), ((0, 1, 2), False)])
def test_scale_factors_that_drift_together_and_apart(sensors: tuple[int, ...], alike: bool) -> None:
    field = synthetic(21, turning_s=4.0).raw
    added = np.zeros_like(field)
    for number in sensors:  # 100 ppm: 5 nT
        added[:, number] = 1e-4 * np.linspace(-1.0, 1.0, len(field))[:, None] * (field[:, number] - field.mean((0, 1)))
    record = synthetic(21, turning_s=4.0, added=added)
    registry = Registry.load()
    model = Adopted(registry.find("error_model", "scale_drift"), {"order": 1, "span_s": 1199.0})
    state = joint_state(record, [model], Fitting())
    assert as_a_station_would(state, 0) is alike
    assert stations_like(state, [registry.find("error_model", name) for name in STATIONS]) == (
        {"reference_drift"} if alike else set()
    )


@pytest.mark.parametrize("axes", [(1.0, 1.0, 1.0), (1.0, 0.0, 0.0)])
def test_a_jump_of_all_scale_factors_may_be_one_of_the_base_station(axes: tuple[float, float, float]) -> None:
    """Of one axis of all sensors it turns with the platform."""
    field = synthetic(23, turning_s=4.0).raw
    added = np.zeros_like(field)
    added[700:] = 1e-4 * (field[700:] - field.mean((0, 1))) * axes
    registry = Registry.load()
    model = Adopted(registry.find("error_model", "scale_step"), {"time_s": 700.0})
    state = joint_state(synthetic(23, turning_s=4.0, added=added), [model], Fitting())
    found = stations_like(state, [registry.find("error_model", name) for name in STATIONS])
    assert found == ({"reference_step"} if axes[1] else set())


@pytest.mark.parametrize(("turning_s", "alike"), [(4.0, False), (80.0, True)])
def test_one_offset_of_all_sensors_turns_with_the_platform_if_that_turns(turning_s: float, alike: bool) -> None:
    added = np.zeros((1200, 4, 3))
    added += np.linspace(-2.0, 2.0, 1200)[:, None, None]
    record = synthetic(22, turning_s=turning_s, added=added)
    model = Adopted(Registry.load().find("error_model", "offset_drift"), {"order": 1, "span_s": 1199.0})
    state = joint_state(record, [model], Fitting())
    own = joint_state(record, [], Fitting())
    assert state.residual.square() < own.residual.square()
    assert as_a_station_would(state, 0) is alike


@pytest.mark.parametrize(
    "effect",
    [
        pytest.param({"type": "temperature_offset", "nT_per_degC": [0.3, 0.2, 0.1]}, marks=pytest.mark.long),
        pytest.param({"type": "temperature_scale", "ppm_per_degC": [10.0, 16.0, 7.0]}, marks=pytest.mark.long),
        pytest.param(
            {"type": "current_field", "channel": "current_heater", "nT_per_A": [0.4, -0.3, 0.5]},
            marks=pytest.mark.long,
        ),
    ],
)
def test_what_every_sensor_has_alike_is_found_where_the_platform_turns(effect: dict[str, Any], tmp_path: Path) -> None:
    told = verdict_of(tmp_path, scenario(5, effect), models=BESIDE_DRIFTS)
    assert [a["error_model"] for a in told["adopted"]] == [effect["type"]]


@pytest.mark.parametrize("of_the_station", [False, True])
def test_a_field_of_the_platform_turns_and_an_error_of_the_station_does_not(of_the_station: bool) -> None:
    course = np.sin(np.arange(1200) / 25.0) + np.sin(np.arange(1200) / 40.0) ** 3
    vector = np.array([3.0, -2.0, 2.0])
    added = None if of_the_station else np.repeat((course[:, None] * vector)[:, None], 4, axis=1)
    record = synthetic(31, turning_s=4.0, added=added)
    if of_the_station:
        assert record.total_field is not None
        record = replace(record, total_field=record.total_field + 4.0 * course)
    assert turns_with_the_platform(linear_state(record)) is not of_the_station


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_readings_of_the_station_that_scatter_do_not_turn(seed: int) -> None:
    """As of wrong stamps in a field that pulsates: faster than any course that turns, which is faster than itself."""
    record, readings = synthetic(seed, turning_s=4.0), np.arange(0.0, 1205.0, 5.0)
    scatter = np.interp(record.time, readings, np.random.default_rng(seed).standard_normal(len(readings)))
    assert record.total_field is not None
    record = replace(record, total_field=record.total_field + 2.0 * scatter)
    assert not turns_with_the_platform(linear_state(record))


TURNS = "turns with the platform"


@pytest.mark.parametrize("seed", [71, pytest.param(72, marks=pytest.mark.long)])
def test_a_weak_source_on_the_platform_that_nobody_logged_is_told(seed: int, tmp_path: Path) -> None:
    """One vector in all sensors, less than three times their noise of |b| - F: no base station could be so."""
    rng = np.random.default_rng(seed)
    on = np.cumsum(rng.random(2400) < 1 / 120.0) % 2  # one that switches once a minute

    def switched(path: Path) -> None:
        with h5py.File(path, "a") as file:
            file["b_raw"][:] = file["b_raw"][:] + on[: len(file["time"]), None, None] * np.array([0.6, -0.5, 0.4])

    source = verdict_of(tmp_path, scenario(seed), switched, ["current_field"])
    assert not source["adopted"]
    assert TURNS in source["unexplained"]["description"]
    assert TURNS not in verdict_of(tmp_path, scenario(seed), None, ["current_field"])["unexplained"]["description"]


def test_channels_that_the_base_station_alone_does_not_see_are_named() -> None:
    """A regional gradient along the track, and a channel that has nothing to do with it."""
    rng = np.random.default_rng(33)
    east, north, other = gaussian_filter1d(rng.standard_normal((3, 1200)), 15.0) * 10.0
    plain = synthetic(33, turning_s=4.0)
    assert plain.total_field is not None
    logged = {"east": east - east.mean(), "north": north - north.mean(), "other": other - other.mean()}
    record = replace(
        plain, logged=logged, origins=dict.fromkeys(logged, np.zeros(())), units=dict.fromkeys(logged, "m")
    )
    assert channels_of_the_total_field(linear_state(record), 1e-3) == []
    beside = replace(record, total_field=plain.total_field + 3.0 * east - 2.0 * north)
    assert set(channels_of_the_total_field(linear_state(beside), 1e-3)) == {"east", "north"}


@pytest.mark.long
def test_a_base_station_that_follows_the_temperature_is_no_fault_of_the_sensors(tmp_path: Path) -> None:
    def warmed(path: Path) -> None:
        with h5py.File(path, "a") as file:
            warmer = np.interp(file["reference/time"][:], file["time"][:], file["temperature"][:])
            file["reference/total_field"][:] = file["reference/total_field"][:] + 0.4 * (warmer - warmer.mean())

    told = verdict_of(tmp_path, scenario(61), warmed, FOLLOWING)
    assert not told["adopted"]
    (why,) = (r["why"] for r in told["rejected"] if r["error_model"] == "temperature_scale")
    assert "an error of the base station that follows temperature would look the same" in why
    assert told["unexplained"]["present"]


@pytest.mark.long
def test_scale_factors_that_follow_the_temperature_each_by_its_own_are_the_sensors(tmp_path: Path) -> None:
    told = verdict_of(tmp_path, scenario(61, {"type": "temperature_scale", "rms_nT": 0.3}), models=FOLLOWING)
    assert [a["error_model"] for a in told["adopted"]] == ["temperature_scale"]


@pytest.mark.parametrize("sensors", [1, 3])
def test_a_delay_of_all_axes_is_asked_of_sensors_that_show_it(sensors: int) -> None:
    """Axes that are read in turn. What one sensor's whole vector is late by no length shows, and a fit of that goes
    anywhere; several sensors show what they are late by beside each other."""
    plain = synthetic(4, 2000, sensors, noise_nT=0.2, turning_s=3.0)
    rate = np.gradient(plain.raw, axis=0)
    late = np.array([4e-5, -2e-5, 0.0]) + 1e-3 * np.arange(sensors)[:, None]
    record = replace(plain, raw=plain.raw - late * rate)
    state = linear_state(record)
    model = Adopted(Registry.load().find("error_model", "sampling_lag"), {"per_axis": True}, record.sensors)
    plainer = plainer_forms(looked_at(state, model), state)
    assert [c.model.settings["per_axis"] for c in plainer] == ([False] if sensors > 1 else [])
