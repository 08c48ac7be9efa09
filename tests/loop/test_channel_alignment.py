"""A sensor that turns as a load bends what holds it: told apart from what turns with time, and named with the load."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import BASE, adopted_names, scenario, verdict_of

from magtensor.verdict_words import sentence

TURNS = ["channel_alignment", "temperature_alignment", "alignment_drift", "turn_step", "channel_response", "hysteresis"]
CHANNELS = BASE["channels"] | {
    "winch_load": {"type": "smooth", "mean": 3.0, "rms": 1.0, "time_s": 60.0, "units": "kN", "log_noise": 0.01},
    "fuel": {"type": "ramp", "start": 80.0, "per_h": -60.0, "units": "percent", "log_noise": 0.01},
}


def told_of(tmp_path: Path, effect: dict[str, Any], seed: int) -> dict[str, Any]:
    return verdict_of(tmp_path, scenario(seed, effect, channels=CHANNELS), models=TURNS)


@pytest.mark.long
@pytest.mark.parametrize("lag_s", [0.0, 20.0])
def test_a_boom_that_bends_under_load_is_named_with_its_channel(tmp_path: Path, lag_s: float) -> None:
    vectors = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, -0.06, 0.08], [0.0, 0.0, 0.0]]
    bend = {"type": "channel_alignment", "channel": "winch_load", "arcmin_per_unit": vectors, "lag_s": lag_s}
    told = told_of(tmp_path, bend, 81)
    (found,) = told["adopted"]
    assert (found["error_model"], found["settings"]["channel"]) == ("channel_alignment", "winch_load")
    assert found["settings"]["lag_s"] == pytest.approx(lag_s, abs=3.0)
    assert found["sensors"] == ["S3"]
    assert "traced to channel_alignment of winch_load: " in sentence(told)
    values = np.array([c["value"] for c in found["coefficients"]])
    errors = np.array([c["std"] for c in found["coefficients"]])
    assert (np.abs(values - vectors[2]) < 4.0 * errors).all()
    assert told["unexplained"]["present"] is False


@pytest.mark.long
@pytest.mark.parametrize("seed", [82, 83])
def test_a_mount_that_creeps_does_not_bend_under_what_runs_out(tmp_path: Path, seed: int) -> None:
    told = told_of(tmp_path, {"type": "alignment_drift", "rms_nT": 1.0, "tau_s": 5000.0}, seed)
    assert "channel_alignment" not in adopted_names(told)
    assert "alignment_drift" in adopted_names(told)
