"""Thermometers whose log is written seldom, each value held until the next."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import BASE, RECIPE, scenario, survey_file, verdict_of

from magtensor.error_models.held_logs import unheld
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import read_plan
from magtensor.runner import run
from magtensor.verdict import verdict

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


@pytest.mark.parametrize("step", [0.1, 0.25, 0.5])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_rounded_log_changes_half_way_between_two_steps(step: float, noise: float) -> None:
    """Rounding leaves 0.29 of a step, and joining the new values from change to change would be half a step ahead."""
    rng = np.random.default_rng(7)
    rounded = np.round((course(TIME) + noise * rng.standard_normal(len(TIME))) / step) * step
    error = unheld(TIME, rounded) - course(TIME)
    assert np.std(error) < 0.25 * step + noise
    rising = np.gradient(course(TIME), TIME)
    ahead = np.sum(error * rising) / np.sum(rising**2)  # s
    assert abs(ahead) * np.abs(rising).max() < 0.1 * step + 0.2 * noise


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


@pytest.mark.long
@pytest.mark.parametrize("every", [2, 12, 60])
def test_a_log_in_rows_of_its_own_is_searched(tmp_path: Path, every: int) -> None:
    """A thermometer that is read seldom, in a table that has a row for every sample: the others are empty."""

    def sparse(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            values = file["temperature"][()]
            values[np.arange(len(values)) % every > 0] = np.nan
            file["temperature"][...] = values

    effect = {"type": "temperature_offset", "rms_nT": 0.5, "sensors": ["S2"]}
    models = ["temperature_offset", "channel_response", "latent_source", "offset_drift"]
    found = verdict_of(tmp_path, scenario(61, effect), sparse, models)
    assert [(a["error_model"], a["sensors"]) for a in found["adopted"]] == [("temperature_offset", ["S2"])]
    assert not found["unexplained"]["present"]
    assert "not searched" not in found["unexplained"]["description"]


@pytest.mark.parametrize(
    ("read", "searched"),
    [
        (slice(None, None, 60), True),
        (slice(0, 1100), False),  # and then the thermometer was off
        pytest.param(slice(None, None, 800), False, marks=pytest.mark.long),  # four readings are no course
    ],
)
def test_a_channel_that_most_of_the_survey_lacks_is_told(tmp_path: Path, read: slice, searched: bool) -> None:
    values = np.full(len(TIME), np.nan)
    values[read] = course(TIME)[read]
    path = survey_file(tmp_path, scenario(62, motion=BASE["motion"] | {"duration_s": 1500.0}))
    with h5py.File(path, "r+") as file:
        file["temperature"][...] = values
    planned = read_plan(RECIPE, survey=path, overrides=["stages.close_loop.search=[temperature_offset]"])
    found = verdict(run(planned, empty_survey(planned)).survey)
    said = "not searched, for most of the survey lacks it: temperature"
    assert (said in found["unexplained"]["description"]) is not searched
    assert [n["error_model"] for n in found["not_tested"]] == ([] if searched else ["temperature_offset"])
