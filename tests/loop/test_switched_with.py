"""What jumps whenever a logged channel is switched follows that channel, and is not a row of events."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import Array, linear_state, scenario, synthetic, verdict_of

from magtensor.loop.fitting.model import Adopted
from magtensor.loop.searching.switched_with import switched_with
from magtensor.registry import Registry

MODELS = ["channel_response", "offset_step", "offset_while", "offset_drift"]
MODES = [1, 0, 3, 0, 3, 1]
OFFSETS = np.array([[0.0, 0.0, 0.0], [1.2, -0.9, 0.8], [0.0, 0.0, 0.0], [-0.5, 1.1, 0.4]])


def mode_of(time: Array) -> Array:
    """(N,) what an instrument is set to, five times another."""
    edges = time[0] + np.ptp(time) * np.array([0.28, 0.58, 0.61, 0.81, 0.88])
    return np.array(MODES)[np.searchsorted(edges, time)]


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
    assert switched_with(model, x) == found
