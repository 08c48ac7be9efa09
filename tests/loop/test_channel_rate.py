"""What a changing channel induces: named with its rate, not as the channel ahead of its log, nor as two responses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import BASE, adopted_names, scenario, verdict_of

from magtensor.verdict_words import sentence

MODELS = ["channel_rate", "channel_response", "current_field", "channel_alignment", "periodic_interference"]
MODELS += ["latent_source", "offset_drift", "warm_up", "temperature_offset", "temperature_rate", "eddy_current"]
LOG_NOISE_A = 0.005
FIELD_NT_S_PER_A = np.array([[0.9, -0.4, 0.3], [0.0, 0.8, -0.7], [-0.5, 0.2, 1.0], [0.4, 0.6, -0.3]])


def with_a_coil(seed: int, size: float, of_the_current: float = 0.0) -> Callable[[Path], None]:
    """A current of a dozen tones with periods of 8 s and more, logged with noise; near each sensor a loop in which it
    induces a voltage, known in closed form."""

    def change(path: Path) -> None:
        rng = np.random.default_rng(seed)
        rates, phases = 2.0 * np.pi * rng.uniform(0.02, 0.12, 12), rng.uniform(0.0, 2.0 * np.pi, 12)
        with h5py.File(path, "r+") as file:
            t = file["time"][:]
            turns = np.outer(t, rates) + phases
            current, slope = np.sin(turns).sum(axis=1), (rates * np.cos(turns)).sum(axis=1)
            file["current_coil"] = 2.0 + current + LOG_NOISE_A * rng.standard_normal(len(t))
            file["current_coil"].attrs["units"] = "A"
            added = size * FIELD_NT_S_PER_A * (slope + of_the_current * current)[:, None, None]
            file["b_raw"][...] = file["b_raw"][:] + added

    return change


def test_a_voltage_that_a_current_induces_is_named_with_the_rate(tmp_path: Path) -> None:
    told = verdict_of(tmp_path, scenario(31), with_a_coil(31, 0.5), MODELS)
    (found,) = told["adopted"]
    assert (found["error_model"], found["settings"]["channel"]) == ("channel_rate", "current_coil")
    assert found["settings"]["lag_s"] < 0.1
    assert "traced to channel_rate of current_coil: " in sentence(told)
    values = np.array([c["value"] for c in found["coefficients"]]).reshape(4, 3)
    errors = np.array([c["std"] for c in found["coefficients"]]).reshape(4, 3)
    # C differs from 1 by 2 %; the central difference of what has periods of 8 s, every 0.5 s, is 2.5 % too small
    expected = 0.5 * FIELD_NT_S_PER_A
    assert (np.abs(values - expected) < 4.0 * errors + 0.05 * np.abs(expected).max()).all()
    assert told["unexplained"]["present"] is False, told["unexplained"]["description"]


@pytest.mark.long
def test_a_current_and_its_rate_are_two_effects(tmp_path: Path) -> None:
    told = verdict_of(tmp_path, scenario(33), with_a_coil(33, 0.5, of_the_current=1.0), MODELS)
    names = adopted_names(told)
    assert "current_field" in names and len(told["adopted"]) <= 2, told["adopted"]


@pytest.mark.long
@pytest.mark.parametrize("tau_s", [pytest.param(6.0, marks=pytest.mark.long), 40.0])
def test_a_kick_whenever_something_is_switched(tmp_path: Path, tau_s: float) -> None:
    kick: dict[str, Any] = {"type": "channel_rate", "channel": "current_heater", "tau_s": tau_s, "rms_nT": 0.6}
    told = verdict_of(tmp_path, scenario(32, kick), models=MODELS[:3])
    (found,) = told["adopted"]
    assert (found["error_model"], found["settings"]["channel"]) == ("channel_rate", "current_heater")
    assert found["settings"]["lag_s"] == pytest.approx(tau_s, rel=0.15)
    assert told["unexplained"]["present"] is False, told["unexplained"]["description"]


@pytest.mark.long
@pytest.mark.parametrize("seed", [41, 42, 43, 44])
def test_a_clean_survey_has_no_rate_of_what_it_logs(tmp_path: Path, seed: int) -> None:
    told = verdict_of(tmp_path, scenario(seed, channels=BASE["channels"]), with_a_coil(seed, 0.0), MODELS)
    assert told["adopted"] == []
