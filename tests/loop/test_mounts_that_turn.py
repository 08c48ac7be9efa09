"""A sensor that turns in its mount: with the temperature, slowly with time, or at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from loop_cases import scenario, verdict_of

MODELS = [
    "temperature_alignment",
    "alignment_drift",
    "turn_step",
    "temperature_scale",
    "scale_drift",
    "frame_flexure",
    "channel_response",
]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "true", "sensors"),
    [
        ("temperature_alignment", {"lag_s": 60.0}, ["S1", "S2", "S3", "S4"]),
        ("temperature_alignment", {"lag_s": 60.0}, ["S3"]),
        ("alignment_drift", {"tau_s": 600.0}, ["S2"]),
        ("turn_step", {"time_s": 500.0}, ["S2"]),
    ],
)
def test_each_is_told_from_the_others(name: str, true: dict[str, Any], sensors: list[str], tmp_path: Path) -> None:
    effect = {"type": name, "rms_nT": 1.0, "sensors": sensors} | true
    told = verdict_of(tmp_path, scenario(12, effect), models=MODELS)
    (adopted,) = told["adopted"]
    assert adopted["error_model"] == name and adopted["sensors"] == sensors
    for setting, value in true.items():
        assert adopted["settings"][setting] == pytest.approx(value, rel=0.2)
    assert adopted["settings"].get("angles", 3) == 3
    assert not told["unexplained"]["present"], told["unexplained"]["description"]
