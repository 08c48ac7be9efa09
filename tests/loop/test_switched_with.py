"""What jumps whenever a logged channel is switched follows that channel, and is not a row of events."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import Array, adopted_names, linear_state, scenario, synthetic, verdict_of

from magtensor.loop.fitting.model import Adopted
from magtensor.loop.remainder.flagged import between_switches
from magtensor.loop.searching.switched_with import switched_with
from magtensor.registry import Registry

MODELS = ["channel_response", "offset_step", "offset_while", "offset_drift"]
MODES = [1, 0, 3, 0, 3, 1]
OFFSETS = np.array([[0.0, 0.0, 0.0], [1.2, -0.9, 0.8], [0.0, 0.0, 0.0], [-0.5, 1.1, 0.4]])


def mode_of(time: Array) -> Array:
    """(N,) what an instrument is set to, five times another."""
    edges = time[0] + np.ptp(time) * np.array([0.28, 0.58, 0.61, 0.81, 0.88])
    return np.array(MODES)[np.searchsorted(edges, time)]


@pytest.mark.long
def test_an_offset_for_each_mode_is_traced_to_the_mode(tmp_path: Path) -> None:
    def switched(path: Path) -> None:
        with h5py.File(path, "a") as file:
            mode = mode_of(file["time"][:])
            file["b_raw"][:] = file["b_raw"][:] + OFFSETS[mode][:, None] * np.array([1.0, 1.4, 0.7, 1.2])[:, None]
            file["mode"] = mode.astype(float)
            file["mode"].attrs["units"] = "1"

    told = verdict_of(tmp_path, scenario(41), switched, MODELS)
    assert [(a["error_model"], a["settings"]["channel"]) for a in told["adopted"]] == [("channel_response", "mode")]


@pytest.mark.parametrize(
    ("times", "found"),
    [
        ({"time_s": 300.4, "until_s": 700.6}, ("stage",)),
        ({"time_s": 300.4, "until_s": 650.0}, ()),
        ({"time_s": 500.0, "until_s": 650.0}, ()),
    ],
)
def test_a_channel_is_one_of_an_event_that_was_switched_at_each_of_its_times(
    times: dict[str, Any], found: tuple[str, ...]
) -> None:
    record = synthetic(5)
    stage = np.interp(record.time, [300.0, 301.0, 700.0, 701.0], [0.0, 2.0, 2.0, 1.0])
    noise = np.random.default_rng(6).standard_normal((2, len(record.time)))
    state = linear_state(record)
    logged = {"stage": stage + 0.01 * noise[0], "supply": 12.0 + 0.1 * noise[1]}
    x = replace(state.excitation, logged=logged)
    model = Adopted(Registry.load().find("error_model", "offset_while"), times)
    assert switched_with(model, replace(state, excitation=x)) == found


@pytest.mark.parametrize(("first", "end", "named"), [(301, 701, True), (301, 650, False), (0, 0, False)])
def test_flagged_samples_between_two_switchings_name_the_channel(first: int, end: int, named: bool) -> None:
    record = synthetic(5)
    state, time = linear_state(record), record.time
    pump = np.interp(time, [300.0, 301.0, 700.0, 701.0], [0.0, 2.0, 2.0, 0.0])
    flagged = (np.arange(len(time)) >= first) & (np.arange(len(time)) < end)
    words = between_switches(flagged, replace(state, excitation=replace(state.excitation, logged={"pump": pump})))
    assert words == (", and begin and end with switchings of pump" if named else "")


@pytest.mark.long
def test_what_acts_from_some_time_on_is_no_event_at_its_last_switch(tmp_path: Path) -> None:
    """A pump whose leads were laid past the sensors half way: most of what it does is left out as what nothing
    explains, and its last switch is no step."""
    at = np.array([60.0, 220.0, 330.0, 450.0, 560.0, 620.0, 640.0, 860.0, 970.0, 1100.0, 1125.0])
    amperes = np.array([0.0, 2.5, 4.0, 1.0, 2.5, 0.0, 4.0, 4.0, 2.5, 2.5, 0.0, 1.0])

    def laid(path: Path) -> None:
        with h5py.File(path, "a") as file:
            time = file["time"][:] - file["time"][0]
            current = amperes[np.searchsorted(at, time)]
            vectors = np.random.default_rng(17).standard_normal(file["b_raw"].shape[1:])
            file["b_raw"][:] = file["b_raw"][:] + 0.4 * (current * (time > 600.0))[:, None, None] * vectors
            file["current_motor"] = current + 0.01 * np.random.default_rng(18).standard_normal(len(time))
            file["current_motor"].attrs["units"] = "A"

    told = verdict_of(tmp_path, scenario(43, channels={}), laid, [*MODELS, "current_field", "calibration_step"])
    assert adopted_names(told) <= {"current_field"}
    assert told["unexplained"]["present"]
