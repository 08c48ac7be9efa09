"""What a run says of samples that are not used: on success, and where too few are left."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from magtensor.errors import DataError, NotEnoughData
from magtensor.runner import told_of_reading
from magtensor.session import run_recipe
from magtensor.simulate import simulate, write
from magtensor.survey.flags import flag_ranges, summary
from magtensor.survey.model import Survey

RECIPE = Path(__file__).parents[2] / "recipes" / "closed_loop.yaml"
SURVEY: dict[str, Any] = {
    "title": "unordered stamps",
    "seed": 3,
    "rate_Hz": 2.0,
    "instrument": {"seed": 1, "array": {"shape": "cross", "baseline_m": 0.5}, "noise": {"white_sd_nT": 0.2}},
    "motion": {"type": "tumbling", "duration_s": 200.0, "rate_rms_deg_s": 15.0, "rate_time_s": 5.0},
    "field": {"earth": {"total_field_nT": 49500.0, "inclination_deg": 66.0, "declination_deg": 4.0}},
    "base_station": {"rate_Hz": 0.5, "noise_sd_nT": 0.1, "resolution_nT": 0.01},
}


def test_a_large_loss_is_told_and_a_small_one_is_not() -> None:
    time = np.arange(100.0)
    survey = Survey.build({"time": (["time"], time, {"units": "s"})}, {"notes": ["12 samples left out"]})
    flags = [
        *flag_ranges(time, time < 8, by="load", reason="few"),
        *flag_ranges(time, (time > 20) & (time < 32), by="load", reason="many", sensor="S1"),
        *flag_ranges(time, (time > 40) & (time < 48), by="load", reason="many", sensor="S2"),
        *flag_ranges(time, (time > 60) & (time < 68), by="load", reason="few of each", sensor="S1"),
        *flag_ranges(time, (time > 60) & (time < 68), by="load", reason="few of each", sensor="S2"),
    ]
    told = told_of_reading(survey.merged({}, flags))
    assert told == ["as read: 12 samples left out", "not used: load: 7 to 11 samples of each of S1, S2: many (of 100)"]


@pytest.mark.parametrize(
    ("lost", "told"),
    [
        ({"S1": 13}, "13 samples of S1"),
        ({"S2": 13, "S1": 13}, "13 samples of each of S1, S2"),
        ({"S1": 13, "S2": 11, "S3": 12}, "11 to 13 samples of each of S1, S2, S3"),
        ({"": 13}, "13 samples"),
        ({"": 3, "S1": 10, "S2": 8}, "11 to 13 samples of each of S1, S2"),
    ],
)
def test_samples_are_counted_by_sensor(lost: dict[str, int], told: str) -> None:
    time = np.arange(100.0)
    flags = [f for s, n in lost.items() for f in flag_ranges(time, time < n, by="load", reason="gone", sensor=s)]
    assert summary(flags) == [f"load: {told}: gone"]


def test_where_too_few_are_left_the_refusal_says_why(tmp_path: Path) -> None:
    few = SURVEY | {"motion": SURVEY["motion"] | {"duration_s": 4.0}}
    write(simulate(few), tmp_path / "survey.h5")
    with h5py.File(tmp_path / "survey.h5", "a") as file:
        file["time"][4:7] = file["time"][3]
    with pytest.raises(NotEnoughData, match=r"as read: 3 samples left out whose time does not move on"):
        run_recipe(RECIPE, tmp_path / "out", survey=tmp_path / "survey.h5")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("order", "told"),
    [("reversed", "time: the times run backwards"), ("shuffled", r"time: .* \d+ samples of 400 do not move on")],
)
def test_times_in_another_order_are_no_faults_of_a_clock(order: str, told: str, tmp_path: Path) -> None:
    """Dropping what does not move on would leave a handful of samples, or a single one."""
    write(simulate(SURVEY), tmp_path / "survey.h5")
    with h5py.File(tmp_path / "survey.h5", "a") as file:
        time = file["time"][:]
        file["time"][:] = time[::-1] if order == "reversed" else time[np.random.default_rng(1).permutation(len(time))]
    with pytest.raises(DataError, match=told):
        run_recipe(RECIPE, tmp_path / "out", survey=tmp_path / "survey.h5")
    assert not (tmp_path / "out").exists()
