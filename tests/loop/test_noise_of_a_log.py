"""What a second function of a channel, or a second log of a cause, gains of the noise of a log is no effect; what gains
far more may be one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import BASE, adopted_names, loaded, scenario, survey_file, suspects, verdict_of
from scipy.stats import ncx2

from magtensor import close_loop
from magtensor.error_models.terms import joined
from magtensor.loop.evidence.assessment import estimated
from magtensor.loop.fitting.log_noise import white_noise
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.gates import gained_of_a_log
from magtensor.loop.searching.several_logs import of_another_log
from magtensor.registry import Registry


@pytest.mark.parametrize("log_noise", [1.0, 30.0, 300.0])
@pytest.mark.parametrize("coefficients", [3, 12])
def test_noise_seldom_gains_more_and_an_effect_beside_it_does(log_noise: float, coefficients: int) -> None:
    limit = gained_of_a_log(log_noise, coefficients)
    assert ncx2.sf(limit, coefficients, log_noise) < 0.02
    assert ncx2.sf(limit, coefficients, 2.0 * log_noise + 100.0) > 0.99


def test_without_noise_nothing_is_gained() -> None:
    assert gained_of_a_log(0.0, 12) == 0.0


def test_what_is_on_or_off_has_no_noise_and_a_coarse_reading_has() -> None:
    run, switch = np.zeros(400, dtype=int), (np.arange(400) // 17 % 2).astype(float)
    np.testing.assert_array_equal(white_noise(np.column_stack([switch, 3.3 * switch]), run), 0.0)
    np.testing.assert_allclose(white_noise(21.0 + switch, run), 1.0 / np.sqrt(12.0))


def test_levels_that_were_set_are_exact_and_those_of_a_rounded_course_are_not() -> None:
    rng, every = np.random.default_rng(8), 40
    run = np.zeros(60 * every, dtype=int)
    stage = np.zeros(60, dtype=int)
    for i in range(1, len(stage)):  # a heater of three stages, switched to any of the others
        stage[i] = (stage[i - 1] + rng.integers(1, 3)) % 3
    heater = 0.8 * np.repeat(stage, every)
    wander = np.interp(np.arange(len(run)), np.arange(0, len(run), 300), np.cumsum(rng.normal(0.0, 1.5, 8)))
    heats = 20.0 + 30.0 * (1.0 - np.exp(-(np.arange(len(run)) // 300) / 2.0))  # read every 300 samples: jumps, once
    np.testing.assert_array_equal(white_noise(heater, run), 0.0)
    np.testing.assert_allclose(white_noise(np.round(wander), run), 1.0 / np.sqrt(12.0))
    assert white_noise(np.round(heats), run) >= 1.0 / np.sqrt(12.0)


@pytest.mark.long
def test_a_range_that_is_logged_changes_offset_and_scale_of_a_sensor(tmp_path: Path) -> None:
    """An offset beside a scale that follows the same bit is not explained by noise of a log that has none."""
    path = survey_file(tmp_path, scenario(72, channels={}), "ranged.h5")
    with h5py.File(path, "a") as file:
        raw, high = file["b_raw"][:], np.zeros(len(file["time"]))
        for i, largest in enumerate(np.abs(raw[:, 1]).max(axis=1)):
            high[i] = largest > 42e3 or (high[i - 1] and largest > 39e3)
        raw[:, 1] += high[:, None] * (np.array([3.0, -2.0, 4.0]) - 3e-4 * raw[:, 1])
        file["b_raw"][:] = raw
        file["range_2"] = high
        file["range_2"].attrs["units"] = "1"
    told = close_loop(path, search=["channel_response", "nonlinearity_cubic", "hysteresis"]).verdict
    assert {a["settings"]["times_field"] for a in told["adopted"]} == {True, False}
    assert [(a["sensors"], a["settings"]["channel"]) for a in told["adopted"]] == 2 * [(["S2"], "range_2")]
    assert not told["unexplained"]["present"], told["unexplained"]["description"]


def test_what_any_function_of_another_log_knows_of_that_noise_lies_along_the_vectors_of_the_first(
    tmp_path: Path,
) -> None:
    """A thermometer whose noise is half of its signal, and the square of another one: along the vectors that the first
    has, however much that is, it may be that noise, and along others it is not."""
    record = loaded(tmp_path, scenario(83, {"type": "temperature_offset", "rms_nT": 1.0}))
    true, rng = record.logged["temperature"], np.random.default_rng(2)
    noise = 0.5 * true.std() * rng.standard_normal(len(true))
    channels = {"temperature": true + noise, "temperature_air": rng.standard_normal(len(true))}
    record = replace(
        record, logged=channels, origins={name: np.asarray(0.0) for name in channels},
        units=dict.fromkeys(channels, "degC"),
    )  # fmt: skip
    model = Registry.load().find("error_model", "temperature_offset")
    settings = {"order": 1, "lag_s": 0.0, "delayed": False, "at_start": 0.0, "bends": ()}
    state = joint_state(record, [Adopted(model, settings | {"channel": "temperature"})], Fitting())
    for along in (True, False):
        second = Adopted(model, settings | {"channel": "temperature_air", "order": 2})
        terms = second.terms(state.excitation).at(state.residual.samples)
        both = estimated(state.residual, joined([state.terms, terms]), state.colours)
        theta = both.theta.copy()
        squares = np.array([name not in "xyz" for name in terms.names])
        assert squares.sum() == len(state.theta[0])
        theta[-terms.count :] = 0.0
        theta[-terms.count :][squares] = 1e3 * (state.theta[0] if along else rng.standard_normal(squares.sum()))
        gained = of_another_log(state, second, terms, replace(both, theta=theta))
        assert (gained > 0.0) is along


def on_a_bus(*effects: dict[str, Any], current_noise_A: float) -> dict[str, Any]:
    """A survey with two currents, and the voltage that sags under both."""
    switched = {"type": "switched", "levels": [0.0, 1.5], "log_noise": current_noise_A}
    channels = {
        "temperature": BASE["channels"]["temperature"],
        "current_motor": switched | {"mean_hold_s": 35.0},
        "current_pump": switched | {"mean_hold_s": 50.0},
        "supply_voltage": {
            "type": "supply", "resistance_ohm": 0.2, "loads": ["current_motor", "current_pump"],
            "wander_rms_V": 0.005, "log_noise": 0.003,
        },
    }  # fmt: skip
    return scenario(71, *effects, channels=channels)


OF_A_BUS = ["current_field", "supply_offset", "channel_response", "temperature_offset"]
MOTOR = {"type": "current_field", "channel": "current_motor", "rms_nT": 3.0}
PUMP = {"type": "current_field", "channel": "current_pump", "rms_nT": 2.0}
SUPPLY = {"type": "supply_offset", "rms_nT": 2.0}


@pytest.mark.long
def test_a_voltage_that_knows_the_currents_better_than_their_logs_is_no_third_effect(tmp_path: Path) -> None:
    told = verdict_of(tmp_path, on_a_bus(MOTOR, PUMP, current_noise_A=0.02), models=OF_A_BUS)
    channels = [(a["error_model"], a["settings"]["channel"]) for a in told["adopted"]]
    assert sorted(channels) == [("current_field", "current_motor"), ("current_field", "current_pump")]


@pytest.mark.long
def test_an_effect_of_the_voltage_beside_that_of_a_noisy_current_is_found(tmp_path: Path) -> None:
    survey = on_a_bus(MOTOR, SUPPLY, current_noise_A=0.02)
    survey["channels"]["supply_voltage"]["wander_rms_V"] = 0.1  # else the pump's current is as good
    told = verdict_of(tmp_path, survey, models=OF_A_BUS)
    assert adopted_names(told) == {"current_field", "supply_offset"}


@pytest.mark.long
def test_of_two_logs_of_one_cause_the_noisier_is_named_as_a_rival(tmp_path: Path) -> None:
    survey = on_a_bus(MOTOR, current_noise_A=0.03)
    survey["channels"]["supply_voltage"]["loads"] = ["current_motor"]
    told = verdict_of(tmp_path, survey, models=OF_A_BUS)
    assert len(told["adopted"]) == 1
    assert "current_field" in suspects(told)


@pytest.mark.long
@pytest.mark.parametrize(("log_noise", "rms_nT"), [(0.005, 3.0), (0.015, 0.5)])
def test_a_noisy_log_takes_no_name_away(log_noise: float, rms_nT: float, tmp_path: Path) -> None:
    """Through a lag a log has less noise, so that a response to any channel, which may lag, seemed to do better."""
    survey = scenario(81, {"type": "supply_offset", "channel": "supply", "rms_nT": rms_nT})
    supply = {"type": "supply", "discharge_V_per_h": 0.1, "wander_rms_V": 0.05, "wander_time_s": 20.0}
    survey["channels"] = survey["channels"] | {"supply": supply | {"log_noise": log_noise}}
    told = verdict_of(tmp_path, survey, None, ["supply_offset", "channel_response", "supply_scale", "offset_drift"])
    assert adopted_names(told) == {"supply_offset"}
    assert told["adopted"][0]["settings"]["smooth"]
    assert suspects(told) == {"supply_offset", "channel_response"}
