"""Spikes of single sensors: what follows how the field changes is found beside them."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import BASE, RECIPE, lasting_effects, scenario, survey_file, suspects, verdict_of

from magtensor.applying import apply_and_refine
from magtensor.loop.fitting.seen import over_disturbances
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import read_plan
from magtensor.runner import run
from magtensor.verdict import verdict
from magtensor.verdict_words import sentence

SPIKES = 25


def spiked(path: Path) -> None:
    """Single outputs that are off by thousands of nT, as a connector makes them."""
    rng = np.random.default_rng(9)
    with h5py.File(path, "a") as file:
        raw = file["b_raw"][:]
        at = rng.choice(len(raw), SPIKES, replace=False)
        raw[at, rng.integers(0, raw.shape[1], SPIKES), rng.integers(0, 3, SPIKES)] += 5000.0 * rng.standard_normal(
            SPIKES
        )
        file["b_raw"][:] = raw


@pytest.mark.long
def test_neither_blocks_held_out_nor_another_survey_see_them(tmp_path: Path) -> None:
    """Rows that are means over 0.15 s: what an effect makes of the field beside a spike would be off by thousands."""
    effect = {"type": "averaging", "spread_s2": [0.15**2 / 12.0] * 4}
    surveys = [survey_file(tmp_path, scenario(seed, effect), f"{seed}.h5") for seed in (52, 53)]
    for path in surveys:
        spiked(path)
    plan = read_plan(RECIPE, survey=surveys[0], overrides=["stages.close_loop.search=[averaging, bandwidth]"])
    made = run(plan, empty_survey(plan)).survey
    told = verdict(made)
    assert [a["error_model"] for a in told["adopted"]] == ["averaging"]
    assert told["error"]["held_out"]["after"]["total_field_rms_nT"]["all"] < 0.25
    other, _ = apply_and_refine(made, surveys[1], plan, tolerant=True, refine_rotation=False)
    for survey in (made, other):
        off = np.linalg.norm(survey.values("calibrated/b"), axis=2) - survey.values("total_field")[:, None]
        off = off[survey.good_by_sensor.all(axis=1)]
        assert len(off) > 2300 and np.sqrt(np.mean(off**2)) < 0.3 and np.abs(off).max() < 3.0


def test_the_phase_of_a_tone_is_not_theirs(tmp_path: Path) -> None:
    """A tone of one of three sensors, in another phase in another survey; only their differences show it."""
    three = BASE["instrument"] | {"array": {"shape": "triangle", "baseline_m": 0.5}}
    surveys = [survey_file(tmp_path, scenario(seed, instrument=three), f"{seed}.h5") for seed in (52, 53)]
    for path, phase in zip(surveys, (0.4, 2.0), strict=True):
        with h5py.File(path, "a") as file:
            tone = np.sin(2.0 * np.pi * 0.383 * file["time"][:] + phase)
            file["b_raw"][:, 1] += tone[:, None] * np.array([1.0, 2.0, -1.5])
        spiked(path)
    plan = read_plan(RECIPE, survey=surveys[0], overrides=["stages.close_loop.search=[periodic_interference]"])
    made = run(plan, empty_survey(plan)).survey
    assert [a["error_model"] for a in verdict(made)["adopted"]] == ["periodic_interference"]
    other, _ = apply_and_refine(made, surveys[1], plan, tolerant=True, refine_rotation=False)
    off = np.linalg.norm(other.values("calibrated/b"), axis=2) - other.values("total_field")[:, None]
    assert np.sqrt(np.mean(off[other.good_by_sensor.all(axis=1)] ** 2)) < 0.3


@pytest.mark.long
@pytest.mark.parametrize("name", ["averaging", "eddy_current", "hysteresis"])
def test_what_follows_the_turning_is_found_beside_spikes(tmp_path: Path, name: str) -> None:
    told = verdict_of(tmp_path, scenario(51, {"type": name, "rms_nT": 10.0}), spiked, lasting_effects())
    assert name in suspects(told) and len(told["adopted"]) == 1, told["unexplained"]["description"]
    assert told["adopted"][0]["evidence"]["held_out_rms_after_nT"] < 1.15 * told["noise_floor_nT"]


def test_the_field_is_seen_over_what_is_disturbed() -> None:
    rng = np.random.default_rng(2)
    time = np.cumsum(rng.uniform(0.45, 0.55, 600))
    run = (np.arange(600) >= 300).astype(int)
    field = 5e4 * np.stack([np.cos(0.3 * time), np.sin(0.3 * time), 0.2 * np.sin(0.1 * time)], axis=1)
    keep = np.ones(600, dtype=bool)
    keep[[50, 51, 120, 299, 450]] = False
    keep[200:220] = False  # too long to be known from its ends
    disturbed = field + 4000.0 * rng.standard_normal((600, 3)) * ~keep[:, None]
    seen = over_disturbances(disturbed, keep, time, run)
    assert (
        np.abs(seen - field)[[50, 51, 120, 450]].max() < 27.0
    )  # 5 h^4 / 384 of the fourth derivative, h three samples
    np.testing.assert_array_equal(seen[keep], field[keep])
    np.testing.assert_array_equal(seen[200:220], disturbed[200:220])
    np.testing.assert_array_equal(seen[299], disturbed[299])  # at the end of a run


def test_where_the_field_turns_fast_what_is_beside_tells_less_than_the_sample() -> None:
    """By 0.7 rad from sample to sample: a cubic over two such steps is off by a thousand nT."""
    time = np.arange(200) * 0.5
    angle = np.where(time < 50.0, 0.1 * time, 5.0 + 1.4 * (time - 50.0))
    field = 5e4 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    keep = np.ones(200, dtype=bool)
    keep[[40, 150]] = False
    spike = np.array([120.0, -60.0, 30.0])
    disturbed = field + spike * ~keep[:, None]
    off = 150.0 * ~keep  # of four sensors one that is off by four times as much in the mean
    seen = over_disturbances(disturbed, keep, time, np.zeros(200, dtype=int), off)
    assert np.abs(seen - field)[40].max() < 3.0
    np.testing.assert_array_equal(seen[150], disturbed[150])
    assert np.abs(over_disturbances(disturbed, keep, time, np.zeros(200, dtype=int)) - field)[150].max() > 450.0


def test_a_strong_filter_is_no_spike_where_the_field_turns_fastest(tmp_path: Path) -> None:
    """It is largest there, and flagged before it has a name: with the field as samples beside have it, a delay would
    explain more; and what an error of the rate leaves of it is no second effect."""
    motion = {"type": "limited_tilt", "duration_s": 1800.0, "tilt_deg": 40.0}
    survey = scenario(2000, {"type": "bandwidth", "rms_nT": 4.5}, motion=motion)
    told = verdict_of(tmp_path, survey, None, ["sampling_lag", "bandwidth", "eddy_current", "averaging"])
    assert len(told["adopted"]) == 1 and "bandwidth" in suspects(told)


@pytest.mark.parametrize(("count", "share"), [(60, "2.5%"), (20, "0.8%")])
def test_they_are_told_and_make_nothing_unexplained(tmp_path: Path, count: int, share: str) -> None:
    """One axis that is off by 400 nT in one sample of 40, or of 120."""

    def off(path: Path) -> None:
        with h5py.File(path, "a") as file:
            raw = file["b_raw"][:]
            raw[np.linspace(20, len(raw) - 20, count).astype(int), 2, 1] += 400.0
            file["b_raw"][:] = raw

    found = verdict_of(tmp_path, scenario(54), off, ["offset_step"])
    left = found["unexplained"]
    words = (
        f"spikes: {count} samples ({share}) fit no calibration, by 400 nT in the median, on S3: they are flagged and "
        "have no part in the calibration"
    )
    assert not left["present"]
    assert words in left["description"]
    assert f"noted: {words}" in sentence(found)
