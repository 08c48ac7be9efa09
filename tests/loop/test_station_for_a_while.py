"""A base station whose level is another one for a while, and what is no such thing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from loop_cases import adopted_names, scenario, verdict_of

FROM_S, UNTIL_S = 430.0, 700.0
MODELS = [
    "reference_while", "reference_step", "reference_drift", "reference_scale", "offset_while", "offset_step",
    "passing_source", "scale_step",
]  # fmt: skip
OFF: dict[str, Any] = {"type": "reference_step", "steps_nT": [1.2, -1.2], "time_s": [FROM_S, UNTIL_S]}


@pytest.mark.long
@pytest.mark.parametrize(
    "motion",
    [None, {"type": "limited_tilt", "duration_s": 1200.0, "tilt_deg": 25.0}],
)
def test_a_level_that_comes_and_goes_is_one_effect(motion: dict[str, Any] | None, tmp_path: Path) -> None:
    sections = {} if motion is None else {"motion": motion}
    told = verdict_of(tmp_path, scenario(31, OFF, **sections), models=MODELS)
    (adopted,) = told["adopted"]
    assert adopted["error_model"] == "reference_while" and adopted["kind"] == "reference"
    times = sorted((adopted["settings"]["time_s"], adopted["settings"]["until_s"]))
    assert times == pytest.approx([FROM_S, UNTIL_S], abs=4.0)  # readings every two seconds
    (shift,) = adopted["coefficients"]
    assert shift["value"] == pytest.approx(1.2, abs=max(5.0 * shift["std"], 0.1))
    assert not told["unexplained"]["present"]


@pytest.mark.long
def test_a_tool_on_the_platform_is_none_of_the_station(tmp_path: Path) -> None:
    there = {"type": "offset_step", "nT": [0.8, -0.6, 0.7], "time_s": [FROM_S]}
    gone = {"type": "offset_step", "nT": [-0.8, 0.6, -0.7], "time_s": [UNTIL_S]}
    told = verdict_of(tmp_path, scenario(31, there, gone), models=MODELS)
    assert adopted_names(told) == {"offset_while"}


@pytest.mark.long
def test_a_station_that_stays_where_it_went_has_stepped(tmp_path: Path) -> None:
    stays = OFF | {"steps_nT": [1.2], "time_s": [FROM_S]}
    told = verdict_of(tmp_path, scenario(31, stays), models=MODELS)
    assert adopted_names(told) == {"reference_step"}
