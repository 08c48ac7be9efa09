"""An offset that was another one for a part of the survey: a tool, a telephone, a magnet on the platform."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import adopted_names, scenario, verdict_of

MODELS = ["offset_while", "offset_step", "offset_drift", "passing_source", "temperature_offset", "scale_step"]
LEFT_THERE, TAKEN_AWAY = 371.0, 733.0  # s


def magnet(strength: float, sensors: int) -> list[dict[str, Any]]:
    """Two jumps of opposite sign, nT of each sensor's axes."""
    vectors = [[0.3, -0.2, 1.1], [0.1, 0.4, -0.5], [-0.6, 0.2, 0.3], [0.2, -0.1, 0.4]][:sensors]
    return [
        {"type": "offset_step", "time_s": [at], "nT": [[sign * strength * v for v in row] for row in vectors]}
        for at, sign in ((LEFT_THERE, 1.0), (TAKEN_AWAY, -1.0))
    ]


@pytest.mark.long
@pytest.mark.parametrize(
    ("sensors", "strength"),
    [
        pytest.param(4, 0.3, marks=pytest.mark.long),
        pytest.param(4, 300.0, marks=pytest.mark.long),
        (1, 1.5),
        pytest.param(1, 3000.0, marks=pytest.mark.long),
    ],
)
def test_it_is_found_with_both_times(tmp_path: Path, sensors: int, strength: float) -> None:
    survey = scenario(11, *magnet(strength, sensors))
    if sensors == 1:
        survey["instrument"] = survey["instrument"] | {"array": {"positions_m": [[0.0, 0.0, 0.0]]}}
    told = verdict_of(tmp_path, survey, models=MODELS)
    assert adopted_names(told) == {"offset_while"} and len(told["adopted"]) == 1
    settings = told["adopted"][0]["settings"]
    within = 0.5 if strength > 2 else 12.0  # a sample, or where some samples more tell nothing from noise
    assert sorted((settings["time_s"], settings["until_s"])) == pytest.approx([LEFT_THERE, TAKEN_AWAY], abs=within)
    assert not told["unexplained"]["present"], told["unexplained"]


@pytest.mark.long
def test_a_jump_for_good_is_a_step(tmp_path: Path) -> None:
    told = verdict_of(tmp_path, scenario(12, magnet(0.6, 4)[0]), models=MODELS)
    assert adopted_names(told) == {"offset_step"}


@pytest.mark.parametrize(("samples", "seed"), [(5, 41), pytest.param(8, 43, marks=pytest.mark.long)])
def test_a_sensor_that_hangs_for_a_moment_is_a_disturbance(tmp_path: Path, samples: int, seed: int) -> None:
    """A handful of samples, which the loading of a survey does not find: the last digit goes on changing."""

    def hang(path: Path) -> None:
        rng = np.random.default_rng(seed)
        with h5py.File(path, "a") as file:
            file["b_raw"][700 : 700 + samples, 1] = file["b_raw"][700, 1] + 0.01 * rng.standard_normal((samples, 3))

    told = verdict_of(tmp_path, scenario(seed), hang, models=["offset_while", "offset_step", "passing_source"])
    assert told["adopted"] == []
    assert "mostly on S2: they are flagged" in told["unexplained"]["description"]
