"""A platform that stands still sees the field's variation and the base station's noise, and nothing of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
from loop_cases import scenario, survey_file

import magtensor

STANDS = {"type": "tumbling", "duration_s": 250.0, "rate_rms_deg_s": 1e-6, "rate_time_s": 5.0}


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.long), pytest.param(3, marks=pytest.mark.long)])
def test_noise_of_the_base_station_is_no_memory_of_the_field(tmp_path: Path, seed: int) -> None:
    """It is in |b| - F, and in the length of the field that models see; read once a second, it is straight between."""
    survey = scenario(seed, rate_Hz=10.0, motion=STANDS, base_station={"rate_Hz": 1.0, "noise_sd_nT": 0.05})
    survey["instrument"]["noise"] = {"white_sd_nT": 0.2}
    told = magtensor.close_loop(survey_file(tmp_path, survey)).verdict
    assert told["adopted"] == [] and not told["unexplained"]["present"]
    missing = {each["error_model"]: each["missing"] for each in told["not_tested"]}
    assert missing["viscous_magnetisation"] == missing["hysteresis"] == ["turning"]
