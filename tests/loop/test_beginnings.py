"""A response that lags, and began out of equilibrium: on the survey, and on another one that it is applied to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import BASE, lasting_effects, linear_state, loaded, scenario, survey_file, synthetic, verdict_of

from magtensor import close_loop
from magtensor.calibration.types import ArrayCalibration
from magtensor.error_models.example import example_survey
from magtensor.loop.correcting.another_survey import as_begun_here
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.searching.beginnings import at_its_limit
from magtensor.loop.searching.outcome import described
from magtensor.loop.searching.search import search
from magtensor.registry import Registry

TAU_S = 150.0
PER_DEGREE = np.array([[0.3, -0.1, 0.2], [0.15, 0.3, -0.2], [-0.2, 0.1, 0.3], [0.05, -0.3, 0.15]])  # nT/degC

COUPLING = 1e-5 * np.array(
    [np.zeros((3, 3)), [[2, -1, 0], [-1, 1, 2], [0, 2, -2]], np.zeros((3, 3)), [[-1, 0, 2], [0, 2, 1], [1, 1, -1]]]
)


def warmed(folder: Path, seed: int, first_degC: float, *, difference: bool = False) -> Path:
    """A survey whose offsets follow a body behind the thermometer, at the start so much warmer than that; or what the
    thermometer shows less that body."""
    path = survey_file(folder, scenario(seed), f"{seed}.h5")
    with h5py.File(path, "a") as file:
        time, air = file["time"][:], file["temperature"][:]
        body = np.empty_like(air)
        body[0] = air[0] + first_degC
        for i in range(1, len(air)):  # Euler's steps, a hundredth of the lag or shorter
            body[i] = body[i - 1] + (time[i] - time[i - 1]) / TAU_S * (air[i - 1] - body[i - 1])
        file["b_raw"][:] = file["b_raw"][:] + (air - body if difference else body)[:, None, None] * PER_DEGREE
    return path


def stood_elsewhere(folder: Path, seed: int, before_nT: tuple[float, float, float] | None) -> Path:
    """A survey with iron beside two sensors that follows the field late, and comes from rest in another field; without
    one it comes from rest in the first sample's."""
    path = survey_file(folder, scenario(seed, truth=True), f"{seed}.h5")
    with h5py.File(path, "a") as file:
        time, field = file["time"][:], file["truth/b_true"][:, 0]
        iron = np.empty_like(field)
        iron[0] = field[0] if before_nT is None else before_nT
        for i in range(1, len(field)):  # the trapezium rule
            half = (time[i] - time[i - 1]) / (2 * TAU_S)
            iron[i] = ((1 - half) * iron[i - 1] + half * (field[i - 1] + field[i])) / (1 + half)
        file["b_raw"][:] = file["b_raw"][:] + np.einsum("sij,nj->nsi", COUPLING, iron)
        del file["truth"]
    return path


def test_a_lagged_channel_begins_where_it_is_said_to() -> None:
    x = example_survey(Registry.load().find("error_model", "temperature_offset"))
    rest, warm = (x.channel("temperature", 60.0, at_start=v) for v in (0.0, 2.5))
    np.testing.assert_allclose(warm - rest, 2.5 * np.exp(-(x.time - x.time[0]) / 60.0), rtol=1e-9, atol=1e-12)
    for unmoved in ({"delayed": True, "at_start": 2.5}, {"delayed": True}):
        np.testing.assert_array_equal(
            x.channel("temperature", 60.0, **unmoved), x.later(x.channel("temperature"), 60.0)
        )
    np.testing.assert_array_equal(x.channel("temperature", 60.0, at_start=np.nan), rest)


@pytest.mark.long
@pytest.mark.parametrize(("first", "second"), [(-20.0, -6.0), (0.0, 9.0)])  # degC; the thermometer moves by seven
def test_what_the_sensors_had_from_before_is_no_second_effect(first: float, second: float, tmp_path: Path) -> None:
    survey, other = warmed(tmp_path, 61, first), warmed(tmp_path, 62, second)
    told = close_loop(survey, verify=other, search=lasting_effects()).verdict
    assert [a["error_model"] for a in told["adopted"]] == ["temperature_offset"], told["unexplained"]["description"]
    # beside smooth courses of time the thermometer shows nothing: it is chosen, and what would do is named
    assert "warm_up" in told["adopted"][0]["indistinguishable_from"]
    settings = told["adopted"][0]["settings"]
    assert settings["lag_s"] == pytest.approx(TAU_S, rel=0.1)
    # what dies away shows well, what a degree does less so, and their ratio as that does
    assert settings["at_start"] == pytest.approx(first, rel=0.2, abs=0.6)
    before, after = (told["error"]["verify"][k]["tensor_rms_nT_per_m"]["all"] for k in ("before", "after"))
    here = told["error"]["held_out"]["after"]["tensor_rms_nT_per_m"]["all"]
    assert after < 1.1 * here and after < 0.7 * before


@pytest.mark.long
def test_a_core_that_was_warmer_than_its_skin_at_the_start(tmp_path: Path) -> None:
    survey, other = (warmed(tmp_path, s, first, difference=True) for s, first in ((61, 5.0), (62, -4.0)))
    told = close_loop(survey, verify=other, search=lasting_effects()).verdict
    assert [a["error_model"] for a in told["adopted"]] == ["temperature_rate"], told["unexplained"]["description"]
    settings = told["adopted"][0]["settings"]
    assert settings["tau_s"] == pytest.approx(TAU_S, rel=0.1)
    assert settings["at_start"] == pytest.approx(5.0, rel=0.2)
    before, after = (told["error"]["verify"][k]["tensor_rms_nT_per_m"]["all"] for k in ("before", "after"))
    here = told["error"]["held_out"]["after"]["tensor_rms_nT_per_m"]["all"]
    assert after < 1.1 * here and after < 0.7 * before


@pytest.mark.long
def test_evidence_stays_with_a_model_whose_form_has_moved(tmp_path: Path) -> None:
    told = close_loop(warmed(tmp_path, 61, 3.0), search=["temperature_offset", "channel_response"]).verdict
    (adopted,) = told["adopted"]
    assert adopted["settings"]["at_start"] != 0.0
    assert adopted["evidence"]["z"] > 4


@pytest.mark.long
@pytest.mark.parametrize("before", [(30e3, -20e3, -30e3), None])
def test_iron_that_stood_in_another_field_before_is_no_second_effect(
    before: tuple[float, float, float] | None, tmp_path: Path
) -> None:
    survey, other = stood_elsewhere(tmp_path, 63, before), stood_elsewhere(tmp_path, 64, (-40e3, 10e3, 20e3))
    models = [
        "viscous_magnetisation",
        "hysteresis",
        "warm_up",
        "offset_drift",
        "channel_response",
        "temperature_offset",
    ]
    told = close_loop(survey, verify=other, search=models).verdict
    assert [a["error_model"] for a in told["adopted"]] == ["viscous_magnetisation"], told["unexplained"]["description"]
    settings = told["adopted"][0]["settings"]
    assert settings["tau_s"] == pytest.approx(TAU_S, rel=0.1)
    began = np.array([settings[f"at_start_{axis}_nT"] for axis in "xyz"])
    if before is None:
        np.testing.assert_array_equal(began, 0.0)
    else:
        assert np.linalg.norm(began) > 20e3
    after = told["error"]["verify"]["after"]["tensor_rms_nT_per_m"]["all"]
    assert after < 1.1 * told["error"]["held_out"]["after"]["tensor_rms_nT_per_m"]["all"]


@pytest.mark.long
@pytest.mark.parametrize("seed", [7, 12])
def test_what_dies_away_is_no_response_to_the_temperature_that_began_with_it(seed: int, tmp_path: Path) -> None:
    """A response with a beginning does as well: the beginning was fitted to the folds that should judge it."""
    effect = {"type": "warm_up", "tau_s": 150.0, "rms_nT": 1.0, "sensors": ["S1", "S4"]}
    variation = {"diurnal": {"amplitude_nT": [5.0, -20.0, 8.0]}, "irregular": {"rms_nT": 1.5, "time_s": 400.0}}
    changes: dict[str, Any] = {
        "rate_Hz": 5.0,
        "instrument": BASE["instrument"] | {"seed": seed + 900},
        "field": BASE["field"] | {"variation": variation},
    }
    models = ["warm_up", "temperature_rate", "temperature_offset", "offset_drift"]
    (adopted,) = verdict_of(tmp_path, scenario(seed, effect, **changes), models=models)["adopted"]
    assert adopted["error_model"] == "warm_up" and adopted["sensors"] == ["S1", "S4"]
    assert adopted["settings"]["tau_s"] == pytest.approx(150.0, rel=0.1)


@pytest.mark.long
def test_a_start_of_another_form_is_no_response_to_a_board_that_warms_up(tmp_path: Path) -> None:
    """What dies away from a free beginning and the course of a board that warms up together bend like a bump."""
    path = survey_file(tmp_path, scenario(21), "bump.h5")
    per_nT = np.zeros((4, 3))
    per_nT[[1, 3]] = [[3.0, 1.6, 3.4], [3.6, -2.8, -2.0]]
    with h5py.File(path, "a") as file:
        since = file["time"][:] - file["time"][0]
        scale_s = since[-1] / 15.0
        file["temperature"][:] = 35.0 - 12.0 * np.exp(-since / (4.0 * scale_s))
        bump = since / scale_s * np.exp(1.0 - since / scale_s)
        file["b_raw"][:] = file["b_raw"][:] + bump[:, None, None] * per_nT
    told = close_loop(path, search=["temperature_offset", "temperature_rate", "warm_up", "offset_drift"]).verdict
    assert not told["adopted"] and told["unexplained"]["present"]


@pytest.mark.parametrize(("part", "limit"), [(1.0, True), (-1.0, True), (0.9, False), (0.0, False)])
def test_a_beginning_at_its_limit_is_none(part: float, limit: bool, tmp_path: Path) -> None:
    x = linear_state(loaded(tmp_path, scenario(65))).excitation
    model = Registry.load().find("error_model", "temperature_offset")
    widest = 10.0 * float(np.ptp(x.logged["temperature"]))  # as docs/loop_steps.md says
    settings = {"order": 1, "channel": "temperature", "lag_s": 60.0, "delayed": False, "at_start": part * widest}
    assert at_its_limit(model, settings, x) is limit
    assert not at_its_limit(model, settings | {"lag_s": 5.0, "delayed": True}, x)  # a delay has no beginning


@pytest.mark.long
@pytest.mark.parametrize("sensors", [3, 4])
def test_what_is_taken_to_begin_in_equilibrium_is_told(sensors: int, tmp_path: Path) -> None:
    array = [[0.25, 0.0, 0.0], [-0.25, 0.0, 0.0], [0.0, 0.25, 0.0], [0.0, -0.25, 0.1]][:sensors]
    instrument = BASE["instrument"] | {"array": {"positions_m": array}}
    effect = {"type": "temperature_offset", "lag_s": TAU_S, "rms_nT": 3.0}
    first, second = (scenario(day, effect, instrument=instrument, start=f"2026-03-{day}T09:00:00Z") for day in (21, 22))
    done = close_loop(survey_file(tmp_path, first), search=["temperature_offset"])
    there = done.calibration.apply(survey_file(tmp_path, second, "second.h5"))["calibrated/b"].attrs
    assert there.get("in_equilibrium") == (None if sensors == 4 else "temperature_offset")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_beginning_that_another_survey_hardly_shows_is_no_impossible_field(seed: int) -> None:
    """Iron that does nearly the same to all sensors along one axis: what it came from there is known from so little
    that noise would make ten times the Earth's field of it."""
    rng = np.random.default_rng(seed)
    plain, tau = synthetic(seed, noise_nT=0.2, turning_s=20.0), 15.0
    place = 0.25 * np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    matrices = 30e-6 * rng.standard_normal((4, 3, 3))
    matrices[:, :, 0] = 30e-6 * (rng.standard_normal(3) + 0.003 * rng.standard_normal((4, 3)))
    came_from = rng.normal(0.0, 30e3, 3)
    forward = np.eye(3) + 0.01 * rng.standard_normal((4, 3, 3))
    field = plain.raw.mean(axis=1)
    lagging, keep = np.empty_like(field), np.exp(-1.0 / tau)
    lagging[0] = field[0] + came_from
    for k in range(1, len(field)):  # the field goes straight from one sample to the next
        slope = field[k] - field[k - 1]
        lagging[k] = field[k] - slope * tau + (lagging[k - 1] - field[k - 1] + slope * tau) * keep
    seen = np.einsum("sij,nsj->nsi", forward, field[:, None] + np.einsum("sij,nj->nsi", matrices, lagging - field))
    record = replace(plain, raw=seen + 0.2 * rng.standard_normal(seen.shape), position=place)
    calibration = ArrayCalibration(np.linalg.inv(forward), np.zeros((4, 3)), np.zeros((48, 48)), "sensor S1")
    names = [f"at_start_{axis}_nT" for axis in "xyz"]
    model = Adopted(
        Registry.load().find("error_model", "viscous_magnetisation"), {"tau_s": tau, **dict.fromkeys(names, np.nan)}
    )
    added = np.einsum("sij,sjk->sik", forward, matrices)  # the model's matrices act on the outputs
    ((found, _),) = as_begun_here(record, calibration, [(model, 1e6 * added.ravel())])
    began = np.array([found.settings[name] for name in names])
    print(began, came_from)
    assert np.linalg.norm(began[1:] - came_from[1:]) < 8e3
    assert abs(began[0] - came_from[0]) < 100e3  # twice the field


@pytest.mark.long
def test_what_each_sensor_began_with_is_said_to_be_no_warming_up_of_its_own() -> None:
    """Four thermometers, a lag of 60 s, and sensors that were all at 15 degC at the start: one number for all of them
    is not what they began with, and something dies away as fast as they lag."""
    samples, tau = 1500, 60.0
    rng = np.random.default_rng(23)
    bell = np.exp(-0.5 * (np.arange(-300, 301) / 75.0) ** 2)
    drawn = rng.standard_normal((samples + 600, 4))
    course = np.column_stack([np.convolve(column, bell / np.sqrt(np.sum(bell**2)), mode="valid") for column in drawn.T])
    thermometers = 15.0 + 4.0 * course
    felt = np.empty_like(thermometers)
    now = np.full(4, 15.0)
    for i in range(samples):
        felt[i] = now
        after = thermometers[min(i + 1, samples - 1)]
        for k in range(20):
            now = now + (thermometers[i] + (after - thermometers[i]) * (k + 0.5) / 20.0 - now) / tau / 20.0
    added = (felt - 15.0)[:, :, None] * rng.uniform(-1.0, 1.0, (4, 3))
    record = replace(
        synthetic(71, samples, noise_nT=0.15, turning_s=4.0, added=added),
        logged={"temperature": thermometers - thermometers.mean(axis=0)}, units={"temperature": "degC"},
        origins={"temperature": thermometers.mean(axis=0)},
    )  # fmt: skip
    registry = Registry.load()
    models = [registry.find("error_model", name) for name in ("temperature_offset", "warm_up")]
    told = described(search(record, models, Fitting()), record, 0)
    adopted = {a["error_model"]: a for a in told["adopted"]}
    assert adopted["temperature_offset"]["settings"]["lag_s"] == pytest.approx(tau, rel=0.05)
    assert "dies away as fast as temperature_offset lags" in adopted["warm_up"]["means"]
