"""Thermometers whose log is written seldom, each value held until the next."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import scenario, verdict_of

from magtensor.error_models.held_logs import unheld

HELD = 60  # samples of half a second
TIME = np.arange(3000) * 0.5


def course(time: np.ndarray) -> np.ndarray:
    """Slow, some degrees."""
    return np.asarray(3.0 * np.sin(time / 300.0) + 0.002 * time)


@pytest.mark.parametrize("jitter", [0, 8])
def test_what_was_held_is_slow_again(jitter: int) -> None:
    rng = np.random.default_rng(2)
    read = np.unique(
        np.clip(np.arange(0, len(TIME), HELD) + rng.integers(-jitter, jitter + 1, len(TIME) // HELD), 0, None)
    )
    read[0] = 0
    true = course(TIME)
    held = true[read][np.searchsorted(read, np.arange(len(TIME)), side="right") - 1]
    inside = slice(0, read[-1])
    assert np.std((held - true)[inside]) > 0.1
    assert np.std((unheld(TIME, held) - true)[inside]) < 0.02


def test_steps_of_resolution_are_smoothed_and_a_dense_log_is_left() -> None:
    coarse = np.round(course(TIME) / 0.25) * 0.25
    assert np.std(unheld(TIME, coarse) - course(TIME)) < 0.12
    np.testing.assert_allclose(unheld(TIME, course(TIME)), course(TIME), atol=1e-4)
    np.testing.assert_array_equal(unheld(TIME, np.zeros(3000)), 0.0)


def test_what_goes_on_between_regular_readings_is_not_rounded_off() -> None:
    angular = 2.0 * np.pi / 300.0  # read ten times a period
    true = np.sin(angular * TIME)
    held = true[np.arange(len(TIME)) // HELD * HELD]
    inside = slice(2 * HELD, len(TIME) - 3 * HELD)
    straight = (angular * 30.0) ** 2 / np.sqrt(
        240.0
    )  # rms error of straight lines: h^2 f'' (s - s^2) / 2, s even in 0..1
    assert np.std((unheld(TIME, held) - true)[inside]) < 0.15 * straight


def test_a_rounded_log_that_flickers_does_not_swing() -> None:
    rng = np.random.default_rng(4)
    flickering = np.round((course(TIME) + 0.01 * rng.standard_normal(len(TIME))) / 0.25) * 0.25
    found = unheld(TIME, flickering)
    assert found.min() >= flickering.min() - 0.01 and found.max() <= flickering.max() + 0.01


@pytest.mark.long
@pytest.mark.parametrize("held", [False, True])
def test_a_temperature_offset_keeps_its_lag_and_needs_no_helper(held: bool, tmp_path: Path) -> None:
    def hold(path: Path) -> None:
        with h5py.File(path, "a") as file:
            logged = file["channels/temperature"] if "channels" in file else file["temperature"]
            values = logged[:]
            logged[:] = values[np.arange(len(values)) // HELD * HELD]

    effect = {"type": "temperature_offset", "rms_nT": 2.0, "lag_s": 50.0}
    models = ["temperature_offset", "latent_source", "offset_drift"]
    told = verdict_of(tmp_path, scenario(51, effect), hold if held else None, models)
    assert [a["error_model"] for a in told["adopted"]] == ["temperature_offset"]
    assert told["adopted"][0]["settings"]["lag_s"] == pytest.approx(50.0, abs=10.0)
