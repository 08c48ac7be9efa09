"""A law that one sensor does not quite obey is in the field that all are compared with, and on no other sensor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import BASE, linear_state, loaded, scenario, verdict_of

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.on_fewer_sensors import narrowed
from magtensor.loop.searching.overheard import _of_sensors, shown_by_one
from magtensor.registry import Registry

CURVES = ["nonlinearity_quadratic", "nonlinearity_cubic", "cross_field", "hysteresis"]


def another_range(path: Path) -> None:
    """Beyond 25 000 nT the converter of S2 reads in another range, by 400 ppm more of what is beyond."""
    with h5py.File(path, "r+") as file:
        raw = file["b_raw"][()]
        beyond = np.maximum(np.abs(raw[:, 1]) - 25_000.0, 0.0)
        raw[:, 1] += 4e-4 * np.sign(raw[:, 1]) * beyond
        file["b_raw"][...] = raw


def cubic(sensors: tuple[str, ...] = ()) -> Adopted:
    component = Registry.load().find("error_model", "nonlinearity_cubic")
    return Adopted(component, {"of_field": False}, sensors)


@pytest.mark.long
def test_only_the_sensor_that_is_bent_is_named(tmp_path: Path) -> None:
    told = verdict_of(tmp_path, scenario(91), another_range, models=CURVES)
    assert told["adopted"]
    assert {s for a in told["adopted"] for s in a["sensors"]} == {"S2"}


@pytest.mark.parametrize("others", [0.0, 1.0])
def test_what_the_others_have_themselves_stays_theirs(tmp_path: Path, others: float) -> None:
    """One sensor has ten times as much; the others have something of their own, or seem to."""
    vectors = [[others, -others, others], [10.0, 8.0, -9.0], [-others, others, others], [others, others, -others]]
    effect = {"type": "nonlinearity_cubic", "nT_at_full_scale": vectors}
    record = loaded(tmp_path, scenario(92, effect), None if others else another_range)
    state = joint_state(record, [cubic(record.sensors)], Fitting())
    assert shown_by_one(record, state, 0, Fitting()) == ("" if others else "S2")


def test_what_is_large_on_several_sensors_is_no_matter_of_one(tmp_path: Path) -> None:
    effect = {"type": "nonlinearity_cubic", "nT_at_full_scale": [3.0, -2.0, 2.0]}
    record = loaded(tmp_path, scenario(93, effect))
    state = joint_state(record, [cubic(record.sensors)], Fitting())
    assert shown_by_one(record, state, 0, Fitting()) == ""
    alone = narrowed(record, state, 0, ("S2",), Fitting())
    assert shown_by_one(record, alone, 0, Fitting()) == ""


def test_a_record_of_some_sensors_has_their_logs_and_vectors(tmp_path: Path) -> None:
    record = loaded(tmp_path, scenario(94, logging={"attitude": True, "acceleration": True}))
    count = len(record.time)
    each = np.arange(4.0 * count).reshape(count, 4)
    more = {"temperature_head": each, "wind": np.ones((count, 3))}  # a vector would be taken for a log of each of three
    origins = {"temperature_head": np.arange(4.0), "wind": np.zeros(3)}
    record = replace(record, logged={**record.logged, **more}, origins={**record.origins, **origins})
    three = _of_sensors(record, [0, 2, 3])
    assert three.sensors == ("S1", "S3", "S4")
    np.testing.assert_array_equal(three.logged["temperature_head"], each[:, [0, 2, 3]])
    np.testing.assert_array_equal(three.origins["temperature_head"], [0.0, 2.0, 3.0])
    assert set(three.logged) == {*BASE["channels"], "acceleration", "temperature_head"}
    np.testing.assert_array_equal(three.raw, record.raw[:, [0, 2, 3]])
    assert linear_state(three).excitation.sensors == three.sensors
