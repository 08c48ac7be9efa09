"""A log whose clock is late or early: at every change the logged value is wrong for a while."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import scenario, suspects, verdict_of

from magtensor.error_models.settings import Range

LATE = 3  # samples of half a second


def make_late(path: Path) -> None:
    """Write every value of the current so many samples later."""
    with h5py.File(path, "a") as file:
        logged = file["channels/current_heater"] if "channels" in file else file["current_heater"]
        values = logged[:]
        logged[:] = np.concatenate([np.repeat(values[:1], LATE), values[:-LATE]])


@pytest.mark.parametrize("rms_nT", [0.5, pytest.param(5.0, marks=pytest.mark.long)])
def test_it_is_found_with_its_delay(rms_nT: float, tmp_path: Path) -> None:
    effect = {"type": "current_field", "channel": "current_heater", "rms_nT": rms_nT}
    models = ["current_field", "channel_response", "offset_drift"]
    told = verdict_of(tmp_path, scenario(31, effect), make_late, models)
    assert [a["error_model"] for a in told["adopted"]] == ["current_field"], suspects(told)
    assert told["adopted"][0]["settings"]["lag_s"] == pytest.approx(-0.5 * LATE, abs=0.15)
    assert told["adopted"][0]["evidence"]["held_out_rms_after_nT"] < 1.1 * told["noise_floor_nT"]


def make_early(channel: str, samples: int) -> Callable[[Path], None]:
    """Write every value so many samples sooner: what it does comes later, as a whole."""

    def change(path: Path) -> None:
        with h5py.File(path, "a") as file:
            logged = file[f"channels/{channel}"] if "channels" in file else file[channel]
            values = logged[:]
            logged[:] = np.concatenate([values[samples:], np.repeat(values[-1:], samples)])

    return change


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "channel", "samples"), [("current_field", "current_heater", 6), ("channel_response", "wind", 40)]
)
def test_a_delay_is_told_from_a_time_constant(name: str, channel: str, samples: int, tmp_path: Path) -> None:
    survey = scenario(33, {"type": name, "channel": channel, "rms_nT": 3.0})
    wind = {"type": "smooth", "mean": 5.0, "rms": 1.0, "time_s": 40.0, "units": "m/s", "log_noise": 0.002}
    survey["channels"] = survey["channels"] | {"wind": wind}
    told = verdict_of(tmp_path, survey, make_early(channel, samples), ["current_field", "channel_response"])
    assert [a["error_model"] for a in told["adopted"]] == [name], suspects(told)
    settings = told["adopted"][0]["settings"]
    assert settings["delayed"]  # before the log begins nothing is known of what it does then
    assert settings["lag_s"] == pytest.approx(0.5 * samples, rel=0.02)
    assert told["adopted"][0]["evidence"]["held_out_rms_after_nT"] < 1.1 * told["noise_floor_nT"]


def test_a_time_constant_is_told_from_a_delay(tmp_path: Path) -> None:
    effect = {"type": "current_field", "channel": "current_heater", "rms_nT": 3.0, "lag_s": 3.0}
    told = verdict_of(tmp_path, scenario(34, effect), models=["current_field", "channel_response"])
    (adopted,) = told["adopted"]
    assert not adopted["settings"]["delayed"]
    assert adopted["settings"]["lag_s"] == pytest.approx(3.0, abs=0.1)


def test_a_log_in_time_is_not_said_to_be_late(tmp_path: Path) -> None:
    effect = {"type": "current_field", "channel": "current_heater", "rms_nT": 0.5}
    told = verdict_of(tmp_path, scenario(32, effect), models=["current_field", "offset_drift"])
    assert told["adopted"][0]["settings"]["lag_s"] == 0.0


def test_a_range_on_both_sides_of_zero() -> None:
    grid = Range(-2.0, 10.0, count=6, spacing="log").values(None)  # type: ignore[arg-type]
    assert grid == sorted(grid) and 0.0 in grid and -2.0 <= grid[0] < grid[1] < 0
    assert grid[grid.index(0.0) :] == Range(0.0, 10.0, count=6, spacing="log").values(None)  # type: ignore[arg-type]
