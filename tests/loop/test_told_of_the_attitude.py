"""An attitude on another clock than the sensors is no effect on their outputs, and the verdict tells it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import RECIPE, scenario, survey_file

from magtensor.session import run_recipe


@pytest.mark.parametrize("late_s", [0.0, 0.5])
def test_the_verdict_tells_an_attitude_that_is_late(tmp_path: Path, late_s: float) -> None:
    motion = {"type": "tumbling", "duration_s": 400.0, "rate_rms_deg_s": 8.0, "rate_time_s": 8.0}
    path = survey_file(tmp_path, scenario(31, motion=motion, logging={"attitude": True}))
    with h5py.File(path, "r+") as file:
        file["attitude"][...] = np.roll(file["attitude"][()], round(late_s * 2.0), axis=0)
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(RECIPE.read_text().replace("- close_loop", "- close_loop: {search: []}"))
    finished = run_recipe(recipe, tmp_path / "out", survey=path)
    told = "; the attitude is 0.5 s late against the sensors: without that the field keeps its direction to "
    assert (told in finished.sentence) is bool(late_s)


def test_a_sensor_that_is_late_by_itself_says_nothing_of_the_attitude(tmp_path: Path) -> None:
    motion = {"type": "tumbling", "duration_s": 400.0, "rate_rms_deg_s": 8.0, "rate_time_s": 8.0}
    late = {"type": "sampling_lag", "lag_s": [[0.0] * 3, [0.05] * 3, [0.0] * 3, [0.0] * 3]}
    path = survey_file(tmp_path, scenario(31, late, motion=motion, logging={"attitude": True}))
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(RECIPE.read_text().replace("- close_loop", "- close_loop: {search: []}"))
    told = run_recipe(recipe, tmp_path / "out", survey=path).sentence
    assert "mostly on S2" in told and "the attitude is" not in told
