"""Outputs that come late by so much that a rate of change does not describe it: sensors read one after the other, a
stream that is one sample behind, or slips by one half way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import adopted_names, scenario, survey_file, verdict_of

import magtensor
from magtensor.error_models.delays import on_time, unseen
from magtensor.simulate import simulate, write

NOISE_NT = 0.15
HAND = {"type": "tumbling", "duration_s": 400.0, "rate_rms_deg_s": 40.0, "rate_time_s": 2.0}  # 350 nT for 10 ms
TILTED = {"type": "limited_tilt", "duration_s": 1800.0, "tilt_deg": 40.0}
TURNING = [
    "sampling_lag",
    "lag_step",
    "clock_drift",
    "eddy_current",
    "bandwidth",
    "viscous_magnetisation",
    "hysteresis",
]


def late(*lag_s: float, **more: Any) -> dict[str, Any]:
    """A delay of each sensor."""
    return {"type": "lag_step" if "time_s" in more else "sampling_lag", "lag_s": [[lag] * 3 for lag in lag_s], **more}


def test_a_band_limited_series_is_brought_back_to_its_time() -> None:
    time = np.sort(np.random.default_rng(1).uniform(-0.02, 0.02, 600) + 0.1 * np.arange(600))
    delays = np.array([0.003, 0.1, -0.22])

    def seen(when: np.ndarray) -> np.ndarray:
        return 1e4 * np.sin(0.9 * when + 0.3) + 3e3 * np.cos(1.7 * when)

    recorded = np.column_stack([seen(time - d) for d in delays])
    run = np.repeat([0, 1], 300)
    late_by = np.broadcast_to(delays, recorded.shape)
    found, lost = on_time(recorded, time, run, late_by), unseen(time, run, late_by)
    np.testing.assert_allclose(found[~lost], np.column_stack([seen(time)] * 3)[~lost], atol=0.5)  # 5e-5 of it
    assert lost.sum(axis=0).tolist() == [0, 2, 4]  # those of each run that were not recorded any more


def test_bad_samples_stay_and_spoil_no_others() -> None:
    time = 0.1 * np.arange(200)
    clean = np.sin(time)[:, None]
    spoiled = clean.copy()
    spoiled[70], spoiled[120] = 1e5, np.nan
    trusted = np.arange(200) != 70
    run, late_by = np.zeros(200, dtype=int), np.full((200, 1), 0.03)
    found = on_time(spoiled, time, run, late_by, trusted)
    rest = trusted & (np.arange(200) != 120)
    np.testing.assert_allclose(found[rest], np.sin(time + 0.03)[rest, None], atol=1e-6)
    assert found[70] == 1e5 and np.isnan(found[120])
    both = on_time(np.hstack([spoiled, clean]), time, run, late_by.repeat(2, axis=1), np.c_[trusted, trusted | True])
    np.testing.assert_array_equal(both[:, :1], found)
    np.testing.assert_allclose(both[:, 1], np.sin(time + 0.03), atol=1e-6)  # another output is there all the time


@pytest.mark.long
@pytest.mark.parametrize(
    ("rate_Hz", "lags"),
    [
        (20.0, (0.0, 0.005, 0.010, 0.015)),
        (10.0, (0.0, 0.02, 0.0, 0.0)),
        (10.0, (0.0, 0.0, 0.1, 0.0)),
    ],
    ids=["read one after the other", "a fifth of a sample", "a sample"],
)
def test_delays_of_sensors_are_found_to_all_orders(tmp_path: Path, rate_Hz: float, lags: tuple[float, ...]) -> None:
    survey = scenario(3, late(*lags), motion=HAND, rate_Hz=rate_Hz)
    told = verdict_of(tmp_path, survey, models=TURNING)
    assert adopted_names(told) == {"sampling_lag"} and len(told["adopted"]) == 1
    found = {c["sensor"]: c["value"] for c in told["adopted"][0]["coefficients"]}
    between = [found.get(f"S{k + 1}", 0.0) - found.get("S1", 0.0) for k in range(4)]
    np.testing.assert_allclose(between, lags, atol=2e-5)
    assert not told["unexplained"]["present"], told["unexplained"]
    assert told["adopted"][0]["evidence"]["held_out_rms_after_nT"] < 1.3 * NOISE_NT


@pytest.mark.long
def test_of_two_sensors_one_that_is_late_is_told_from_one_that_is_filtered(tmp_path: Path) -> None:
    """Before a delay is fitted the noise of two sensors seems larger, and models are compared across that."""
    pair = scenario(6, late(0.0, 0.006))
    pair["instrument"] = pair["instrument"] | {"array": {"positions_m": [[0.25, 0.0, 0.0], [-0.25, 0.0, 0.0]]}}
    told = verdict_of(tmp_path, pair, models=["sampling_lag", "bandwidth", "eddy_current"])
    assert adopted_names(told) == {"sampling_lag"}


@pytest.mark.long
@pytest.mark.parametrize("seed", [6, 7])
def test_of_three_sensors_filters_are_named_where_the_samples_are_too_far_apart_to_tell(
    seed: int, tmp_path: Path
) -> None:
    """To first order a filter is a delay of each axis. The noise of each axis is thought larger before the fit."""
    tilted = scenario(seed, {"type": "bandwidth", "rms_nT": 0.45}, motion=TILTED)
    tilted["instrument"] = tilted["instrument"] | {"array": {"shape": "triangle", "baseline_m": 0.5}}
    told = verdict_of(tmp_path, tilted, models=["sampling_lag", "bandwidth", "eddy_current"])
    (one,) = told["adopted"]
    assert {one["error_model"], *one["indistinguishable_from"]} >= {"bandwidth", "sampling_lag"}


@pytest.mark.parametrize("tau_s", [0.05, pytest.param(0.1, marks=pytest.mark.long)])
def test_a_filter_of_one_axis_is_no_conductor(tau_s: float, tmp_path: Path) -> None:
    """Hundreds of nT, of which the search for the filter's time constant finds a local best: at the conductor's it does
    as well. What the filter held before the first sample nobody knows."""
    turning = {"type": "tumbling", "duration_s": 200.0, "rate_rms_deg_s": 20.0, "rate_time_s": 4.0}
    filtered = {"type": "bandwidth", "tau_s": [[0.0] * 3, [tau_s, 0.0, 0.0], [0.0] * 3, [0.0] * 3]}
    survey = scenario(44, filtered, rate_Hz=20.0, motion=turning)
    told = verdict_of(tmp_path, survey, models=["sampling_lag", "bandwidth", "eddy_current", "viscous_magnetisation"])
    (one,) = told["adopted"]
    assert one["error_model"] == "bandwidth" and "eddy_current" in one["indistinguishable_from"]
    found = {(c["sensor"], c["name"]): c["value"] for c in one["coefficients"]}
    assert found.pop(("S2", "x")) == pytest.approx(tau_s, rel=0.01)
    assert max(abs(value) for value in found.values()) < 1e-3 * tau_s
    assert "popcorn" not in told["unexplained"]["description"]


@pytest.mark.long
def test_a_second_survey_is_brought_back_to_its_time(tmp_path: Path) -> None:
    """As if nothing were late, but for the last sample, which has not been recorded."""
    effect = late(0.0, 0.0, 0.1, 0.0)
    search = ["sampling_lag", "bandwidth"]
    found = magtensor.close_loop(
        survey_file(tmp_path, scenario(3, effect, motion=HAND, rate_Hz=10.0), "first.h5"), search=search
    )
    true = simulate(scenario(4, effect, motion=HAND, rate_Hz=10.0, truth=True))
    second = tmp_path / "second.h5"
    write(true, second)
    b = found.calibration.apply(second)["calibrated/b"].to_numpy()
    assert np.isnan(b[-1, 2]).all() and np.isfinite(b[:-1]).all()
    errors = np.linalg.norm(b, axis=2) - np.linalg.norm(true.truth.b, axis=-1).reshape(len(b), -1)
    assert np.sqrt(np.nanmean(errors**2, axis=0)).max() < 1.2 * NOISE_NT  # and what C and o are known to


@pytest.mark.long
def test_rows_that_repeat_a_reading_are_none_to_interpolate_from(tmp_path: Path) -> None:
    effect = late(0.0, 0.003, 0.0, 0.0)
    first, second = (
        survey_file(tmp_path, scenario(seed, effect, motion=HAND, rate_Hz=10.0, truth=True), f"{seed}.h5")
        for seed in (3, 4)
    )
    for path in (first, second):
        with h5py.File(path, "a") as file:
            raw = file["b_raw"][:]
            for row in np.flatnonzero(np.random.default_rng(5).random(len(raw)) < 0.25):
                raw[row] = raw[max(row - 1, 0)]
            file["b_raw"][:] = raw
            true, fresh = np.linalg.norm(file["truth/b_true"][:], axis=-1), np.any(np.diff(raw, axis=0), axis=(1, 2))
    found = magtensor.close_loop(first, search=["sampling_lag", "bandwidth"])
    assert adopted_names(found.verdict) == {"sampling_lag"}
    b = found.calibration.apply(second)["calibrated/b"].to_numpy()
    errors = (np.linalg.norm(b, axis=2) - true)[1:][fresh]
    assert np.sqrt(np.nanmean(errors**2, axis=0)).max() < 1.2 * NOISE_NT


@pytest.mark.long
def test_a_slip_by_a_sample_half_way(tmp_path: Path) -> None:
    survey = scenario(3, late(0.0, 0.1, 0.0, 0.0, time_s=210.0), motion=HAND, rate_Hz=10.0)
    told = verdict_of(tmp_path, survey, models=TURNING)
    assert adopted_names(told) == {"lag_step"} and len(told["adopted"]) == 1
    one = told["adopted"][0]
    assert one["settings"]["time_s"] == pytest.approx(210.0, abs=0.11)
    assert one["sensors"] == ["S2"]
    assert one["coefficients"][0]["value"] == pytest.approx(0.1, abs=1e-4)
    assert one["evidence"]["held_out_rms_after_nT"] < 1.3 * NOISE_NT
