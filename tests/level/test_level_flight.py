"""The closed loop on flights whose attitudes determine no calibration, as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from level_cases import flight, written

from magtensor.cli import status_of

RECIPES = Path(__file__).parents[2] / "recipes"


def closed(folder: Path, survey: Path, *more: str) -> dict[str, Any]:
    """The verdict of the recipe, unedited."""
    recipe = str(RECIPES / "closed_loop.yaml")
    assert status_of(["run", recipe, "--input", str(survey), "--output", str(folder / "run"), *more]) == 0
    found: dict[str, Any] = json.loads((folder / "run" / "verdict.json").read_text(encoding="utf-8"))
    return found


@pytest.mark.long
def test_the_current_is_found_and_the_calibration_is_not_claimed(tmp_path: Path, capsys: Any) -> None:
    effect = np.array([60.0, -25.0, 40.0])
    found = closed(tmp_path, written(tmp_path / "flight.h5", flight(11, tilt_deg=0.7, effect=effect)))
    (adopted,) = found["adopted"]
    assert adopted["error_model"] == "current_field" and "M2" in adopted["sensors"]
    for coefficient in adopted["coefficients"]:
        true = effect["xyz".index(coefficient["name"])] if coefficient["sensor"] == "M2" else 0.0
        assert abs(coefficient["value"] - true) < 5.0 * coefficient["std"]
    doubt = found["calibration"]
    assert doubt["determined"] is False and doubt["combinations_by_prior"] >= 1
    assert doubt["total_field_std_nT"]["worst_direction"] > 500 > doubt["total_field_std_nT"]["flown"]
    assert doubt["further_attitudes"].startswith("the field along")
    said = capsys.readouterr()
    told = said.out + said.err
    assert "the attitudes do not determine the calibration" in told
    assert "QC failed: calibration determined" in told
    assert "attitudes do not determine" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")


def test_a_clean_flight_is_not_accused(tmp_path: Path) -> None:
    found = closed(tmp_path, written(tmp_path / "flight.h5", flight(12, noise=2.0, tilt_deg=0.7)))
    assert found["adopted"] == [] and found["unexplained"]["present"] is False
    assert found["calibration"]["determined"] is False


def test_an_axis_that_stands_still_to_the_last_digit(tmp_path: Path) -> None:
    found = closed(tmp_path, written(tmp_path / "still.h5", flight(16, noise=0.0, tilt_deg=1e-12)))
    assert found["adopted"] == [] and found["calibration"]["determined"] is False


def test_it_can_be_refused_and_joint_says_where_to_go(tmp_path: Path, capsys: Any) -> None:
    survey = written(tmp_path / "flight.h5", flight(13))
    recipe = str(RECIPES / "closed_loop.yaml")
    refuse = "stages.close_loop.undetermined=refuse"
    assert status_of(["run", recipe, "--input", str(survey), "--output", str(tmp_path / "a"), "--set", refuse]) == 3
    (tmp_path / "joint.yaml").write_text("title: joint\nstages: [load, detrend_diurnal, calibrate_joint]\n")
    again = ["run", str(tmp_path / "joint.yaml"), "--input", str(survey), "--output", str(tmp_path / "b")]
    capsys.readouterr()
    assert status_of(again) == 3
    assert "close_loop looks for effects all the same" in capsys.readouterr().err


def test_one_sensor_alone_needs_a_measured_total_field(tmp_path: Path, capsys: Any) -> None:
    found = closed(tmp_path, written(tmp_path / "measured.h5", flight(14, 1, tilt_deg=0.7, swing=20.0)))
    assert found["adopted"] == [] and found["calibration"]["determined"] is False
    constant = str(written(tmp_path / "constant.h5", flight(14, 1, tilt_deg=0.7)))
    capsys.readouterr()
    assert (
        status_of(["run", str(RECIPES / "closed_loop.yaml"), "--input", constant, "--output", str(tmp_path / "b")]) == 3
    )
    said = capsys.readouterr().err
    assert "what the sensor adds cannot be told from the field" in said and "calibrate_vector" not in said
    with h5py.File(constant, "r+") as file:
        file["attitude"] = np.tile([0.0, 0.0, 0.0, 1.0], (len(file["time"]), 1))
        file["attitude"].attrs["units"] = "1"
    assert status_of(["run", str(RECIPES / "closed_loop.yaml"), "--input", constant, "--output", str(tmp_path / "c")])
    assert "`calibrate_vector` in the place of close_loop" in capsys.readouterr().err
