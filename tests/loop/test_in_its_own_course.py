"""A channel that nobody wrote a model for is believed for its own course, not for what dies away after a beginning."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import RECIPE, Array, linear_state, scenario, survey_file

from magtensor.loop.fitting.model import State
from magtensor.loop.fitting.record import record_of
from magtensor.loop.searching.beginnings import begun
from magtensor.loop.searching.profiling import REFINING_SAMPLES, thinned
from magtensor.preparing import load_as
from magtensor.recipe.plan import read_plan
from magtensor.registry import Registry

MODEL = Registry.load().find("error_model", "channel_response")
IN_EQUILIBRIUM = {
    "channel": "",
    "power": 1,
    "lag_s": 0.0,
    "smooth": False,
    "delayed": False,
    "at_start": 0.0,
    "times_field": False,
    "of_field": False,
}
MOTORS = 6
TOWARDS = np.array([0.3, -0.4, 0.8])


def flown(folder: Path, seed: int, heard: bool) -> State:
    """The fit of a survey with the commands of six motors and a sensor that drifts or that hears a motor."""
    path = survey_file(folder, scenario(seed), f"{seed}.h5")
    random = np.random.default_rng(seed)
    with h5py.File(path, "a") as file:
        time = file["time"][:]
        commands = [1500.0 + wandering(len(time), random) for _ in range(MOTORS)]
        for i, command in enumerate(commands):
            file[f"motor_{i}"] = command
            file[f"motor_{i}"].attrs["units"] = "us"
        since = (time - time[0]) / (time[-1] - time[0])
        course = body_of(time, commands[0]) / 25.0 if heard else 6.0 * (np.exp(-since / 0.25) - 1.3 * since**2)
        raw = file["b_raw"][:]
        raw[:, 1] += course[:, None] * TOWARDS
        file["b_raw"][...] = raw
    return linear_state(record_of(load_as(read_plan(RECIPE, survey=path), path)))


def wandering(samples: int, random: np.random.Generator) -> Array:
    """Steps that are taken back slowly."""
    steps = np.zeros(samples)
    steps[np.sort(random.integers(0, samples, 25))] = 100.0 * random.normal(size=25)
    out = np.zeros(samples)
    for i in range(1, samples):
        out[i] = 0.997 * out[i - 1] + steps[i]
    return out


def body_of(time: Array, command: Array) -> Array:
    """What follows a command with a lag of a minute, 300 us above it at first."""
    out = np.empty_like(command)
    out[0] = command[0] + 300.0
    for i in range(1, len(time)):
        out[i] = out[i - 1] + (time[i] - time[i - 1]) / 60.0 * (command[i - 1] - out[i - 1])
    return out - 1500.0


def settings_found(state: State, motor: int, samples: int = REFINING_SAMPLES) -> dict[str, Any]:
    return begun(MODEL, IN_EQUILIBRIUM | {"channel": f"motor_{motor}"}, state, thinned(state, samples))


@pytest.mark.parametrize("seed", [300, 305])
def test_a_drift_is_no_channel_that_began_out_of_equilibrium(seed: int, tmp_path: Path) -> None:
    state = flown(tmp_path, seed, heard=False)
    assert [settings_found(state, i)["at_start"] for i in range(MOTORS)] == [0.0] * MOTORS


@pytest.mark.parametrize("samples", [REFINING_SAMPLES, 900])
def test_a_channel_that_is_heard_and_began_out_of_equilibrium(samples: int, tmp_path: Path) -> None:
    found = settings_found(flown(tmp_path, 300, heard=True), 0, samples)
    assert found["lag_s"] == pytest.approx(60.0, rel=0.1)
    assert found["at_start"] == pytest.approx(300.0, rel=0.2)
