"""A current whose log is late: at every switching the logged value is wrong for a while."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import scenario, suspects, verdict_of

from magtensor.loop.settings import Range

LATE = 3  # samples of half a second


def make_late(path: Path) -> None:
    """Write every value of the current so many samples later."""
    with h5py.File(path, "a") as file:
        logged = file["channels/current_heater"] if "channels" in file else file["current_heater"]
        values = logged[:]
        logged[:] = np.concatenate([np.repeat(values[:1], LATE), values[:-LATE]])


@pytest.mark.parametrize("rms_nT", [0.5, 5.0])
def test_it_is_found_with_its_delay(rms_nT: float, tmp_path: Path) -> None:
    effect = {"type": "current_field", "channel": "current_heater", "rms_nT": rms_nT}
    models = ["current_field", "channel_response", "offset_drift"]
    told = verdict_of(tmp_path, scenario(31, effect), make_late, models)
    assert [a["error_model"] for a in told["adopted"]] == ["current_field"], suspects(told)
    assert told["adopted"][0]["settings"]["lag_s"] == pytest.approx(-0.5 * LATE, abs=0.15)
    assert told["adopted"][0]["evidence"]["held_out_rms_after_nT"] < 1.1 * told["noise_floor_nT"]


def test_a_log_in_time_is_not_said_to_be_late(tmp_path: Path) -> None:
    effect = {"type": "current_field", "channel": "current_heater", "rms_nT": 0.5}
    told = verdict_of(tmp_path, scenario(32, effect), models=["current_field", "offset_drift"])
    assert told["adopted"][0]["settings"]["lag_s"] == 0.0


def test_a_range_on_both_sides_of_zero() -> None:
    grid = Range(-2.0, 10.0, count=6, spacing="log").values(None)  # type: ignore[arg-type]
    assert grid == sorted(grid) and 0.0 in grid and -2.0 <= grid[0] < grid[1] < 0
    assert grid[grid.index(0.0) :] == Range(0.0, 10.0, count=6, spacing="log").values(None)  # type: ignore[arg-type]
