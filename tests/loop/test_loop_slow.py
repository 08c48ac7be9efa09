"""What is slow: noise that looks like an effect, effects that look like noise, and logs with noise of their own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import adopted_names, lasting_effects, loaded, scenario, suspects, verdict_of
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import norm

from magtensor.calibration.joint import calibrated
from magtensor.error_models.smoothing import smoothed
from magtensor.loop.correcting.another_survey import tone_here
from magtensor.loop.correcting.correction import corrected_raw
from magtensor.loop.evidence.colour import Colour, colour_of
from magtensor.loop.evidence.multiplicity import effective_tests
from magtensor.loop.evidence.scoring import rarity
from magtensor.loop.evidence.turned import SlowModes, TurnedColour, excess_of, excess_of_one
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.registry import Registry

Array = NDArray[np.float64]


def test_tests_that_are_one_and_the_same_count_once_and_unrelated_ones_each() -> None:
    assert effective_tests([], 0.01) == 1.0
    assert effective_tests([1.0] * 9, 0.01) == pytest.approx(1.0)
    assert effective_tests([0.0] * 9, 0.01) == pytest.approx(10.0, rel=2e-3)


@pytest.mark.parametrize("r", [0.5, 0.9, 0.99])
def test_a_chain_of_dependent_tests_keeps_its_level(r: float) -> None:
    alpha, count, trials = 0.05, 20, 20_000
    rng = np.random.default_rng(31)
    drive = rng.standard_normal((count, trials)) * np.sqrt(1 - r**2)
    drive[0] /= np.sqrt(1 - r**2)
    chain = lfilter([1.0], [1.0, -r], drive, axis=0)
    limit = norm.isf(alpha / effective_tests([r] * (count - 1), alpha) / 2)
    alarms = float(np.mean(np.abs(chain).max(axis=0) > limit))
    assert alarms < alpha + 3 * np.sqrt(alpha / trials)
    bonferroni = float(np.mean(np.abs(chain).max(axis=0) > norm.isf(alpha / count / 2)))
    assert alarms > bonferroni


def test_the_rarity_of_chi_square_has_no_seam_where_its_tail_underflows() -> None:
    assert rarity(3.841459, 1) == pytest.approx(-np.log(0.05), rel=1e-6)
    for rank in (1, 3, 12):
        values = [rarity(x, rank) for x in np.arange(1000.0, 1400.0, 5.0)]
        steps = np.diff(values)
        assert np.all(steps > 2.3) and np.all(steps < 2.6)  # half of each 5, and a little more
    assert rarity(13361.0, 11) > rarity(7621.0, 3)


def turning(rng: np.random.Generator, n: int) -> Array:
    """(N, 3) unit vectors that tumble."""
    angles = np.cumsum(0.1 + 0.03 * rng.standard_normal((n, 2)), axis=0)
    polar, azimuth = np.pi / 2 + 0.9 * np.sin(0.7 * angles[:, 0]), angles[:, 1]
    return np.column_stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])


def slow_noise(rng: np.random.Generator, n: int, columns: int) -> Array:
    """White noise and a random walk, (N, columns)."""
    return rng.standard_normal((n, columns)) + 0.05 * np.cumsum(rng.standard_normal((n, columns)), axis=0)


@pytest.mark.parametrize("single", [False, True])
def test_slow_noise_of_a_turning_sensor_is_not_mistaken_for_a_slow_effect(single: bool) -> None:
    """Three trends turned with the platform explain three of chi-square, if the noise's covariance is right."""
    n, trials = 2000, 40
    explained: dict[str, list[float]] = {"turned": [], "stationary": []}
    for trial in range(trials):
        rng = np.random.default_rng(500 + trial)
        u = turning(rng, n)
        along = np.sum(u * slow_noise(rng, n, 3), axis=1)
        modes = SlowModes(u)
        plain = colour_of(along[:, None])
        if single:
            excess = excess_of_one(modes, along, plain.white)
        else:  # nine other values with the same noise, as the contrasts of four sensors are
            excess = excess_of(colour_of(slow_noise(rng, n, 9)), modes.most)
        turned = TurnedColour(modes, np.repeat(excess / plain.white, 3), Colour(None, 1.0))
        turned = TurnedColour(modes, turned.variance, colour_of(turned.still(along)[:, None]))
        trend = u * np.linspace(-1, 1, n)[:, None]
        for name, colour in (("turned", turned), ("stationary", plain)):
            a, r = colour.whiten(np.column_stack([trend, u])), colour.whiten(along)
            a = a[:, :3] - a[:, 3:] @ np.linalg.lstsq(a[:, 3:], a[:, :3], rcond=None)[0]
            explained[name].append(float(r @ a @ np.linalg.solve(a.T @ a, a.T @ r)))
    assert np.mean(explained["stationary"]) > 30  # what it is about
    # 3 with a standard error of 0.4 for 40 trials; the slowest mode's own power is known to a factor of its chi-square
    assert np.mean(explained["turned"]) < (9.0 if single else 6.0)


def test_of_no_regressors_none_are_left_beside_turned_noise() -> None:
    """What died away before the first sample that is believed has none."""
    modes = SlowModes(turning(np.random.default_rng(500), 300))
    turned = TurnedColour(modes, np.ones(3 * modes.most), Colour(None, 1.0))
    assert turned.whiten(np.zeros((300, 0))).shape == (300, 0)


SECONDS = np.arange(3600) / 2.0
BENDS = 1e-4  # degC a sample^2, white: an integrated random walk


def heated(rng: np.random.Generator, samples: int) -> Array:
    """degC, (N,), two a second: switched on at the first sample, on a day with clouds."""
    clouds = BENDS * np.cumsum(np.cumsum(rng.standard_normal(samples)))
    return 18.0 + 4.0 * (1.0 - np.exp(-np.arange(samples) / 480.0)) + clouds


@pytest.mark.parametrize("noise", [0.005, 0.02, 0.1])
def test_a_thermometer_without_the_noise_of_its_log(noise: float) -> None:
    rng = np.random.default_rng(8)
    true = heated(rng, 3600)
    error = smoothed(SECONDS, true + noise * rng.standard_normal(3600)) - true
    # the best that is possible, knowing noise and bends: noise^2 times the mean of 1 / (1 + (noise / BENDS)^2 w^4) over
    # all frequencies w, which is (BENDS / noise)^(1/2) / 8^(1/2)
    best = noise * np.sqrt(np.sqrt(BENDS / noise) / np.sqrt(8.0))
    assert np.std(error) < 1.15 * best
    assert np.sqrt(np.mean(error[:60] ** 2)) < 3.0 * best  # where it warms up fastest, and has no past
    assert np.std(np.diff(error)) < 0.05 * noise  # what a rate of change is made of


def test_a_thermometer_may_go_anywhere_over_a_pause() -> None:
    rng = np.random.default_rng(10)
    true = heated(rng, 3600)
    before, after = np.arange(3600) < 1000, np.arange(3600) >= 2200
    used = before | after
    logged = true[used] + np.where(before, 0.0, 3.0)[used] + 0.02 * rng.standard_normal(used.sum())

    error = smoothed(SECONDS[used], logged) - true[used] - np.where(before, 0.0, 3.0)[used]

    best = 0.02 * np.sqrt(np.sqrt(BENDS / 0.02) / np.sqrt(8.0))  # as above
    assert np.std(error[940:1060]) < 3.0 * best


def test_a_log_without_noise_or_without_a_signal_is_used_as_it_is() -> None:
    rng = np.random.default_rng(9)
    true = heated(rng, 3600)
    np.testing.assert_allclose(smoothed(SECONDS, true), true, atol=1e-4 * np.ptp(true))
    line = np.linspace(20.0, 25.0, 60_000)
    stiffest = smoothed(np.arange(60_000.0), line)
    np.testing.assert_allclose(stiffest, line, atol=1e-6)  # and far from rounding
    rough = rng.standard_normal(4000)  # nothing slow in it: what is logged may be what there is
    np.testing.assert_array_equal(smoothed(np.arange(4000.0), rough), rough)
    rounded = np.round(true, 1)  # held in steps: no noise that second differences would show
    np.testing.assert_array_equal(smoothed(SECONDS, rounded), rounded)


def two_unlike(seed: int, *effects: dict[str, Any]) -> dict[str, Any]:
    """A good sensor and a bad one, as on a cheap payload, each with a noisy thermometer."""
    instrument = {
        "seed": 7,
        "array": {"positions_m": [[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]},
        "errors": {"scale": 0.03, "non_orthogonality_deg": 1.0, "misalignment_deg": 3.0, "bias_nT": 1000.0},
        "noise": {"white_sd_nT": [[10.0] * 3, [100.0] * 3]},
    }
    temperature = {
        "type": "temperature", "per_sensor": True, "trend_degC_per_h": -20.0, "wander_rms_degC": 3.0,
        "wander_time_s": 600.0, "self_heating_degC": 4.0, "tau_s": 240.0, "log_noise": 0.16,
    }  # fmt: skip
    motion = {"type": "tumbling", "duration_s": 3000.0, "rate_rms_deg_s": 15.0, "rate_time_s": 5.0}
    return scenario(seed, *effects, instrument=instrument, channels={"temperature": temperature}, motion=motion)


@pytest.mark.long
def test_a_strong_slow_effect_of_the_worse_of_two_sensors(tmp_path: Path) -> None:
    """Thirteen times its noise; in noise of the residual's own colour next to nothing of it is left."""
    coefficients = [[0.0, 0.0, 0.0], [-40.0, -330.0, 430.0]]
    effect = {"type": "temperature_offset", "lag_s": 0.0, "reference_degC": 20.0, "nT_per_degC": coefficients}
    found = verdict_of(tmp_path, two_unlike(2, effect), models=lasting_effects())
    assert adopted_names(found) == {"temperature_offset"}
    value = {(c["sensor"], c["name"]): c["value"] for c in found["adopted"][0]["coefficients"]}
    for axis, true in zip("xyz", coefficients[1], strict=True):
        assert value["S2", axis] == pytest.approx(true, rel=0.03, abs=5.0)
    # a lag of its own would be the noise of the log, smoothed
    assert found["adopted"][0]["settings"]["lag_s"] < 5.0
    before, after = (found["error"]["held_out"][k]["total_field_rms_nT"] for k in ("before", "after"))
    assert after["S2"] < 120.0 < 0.1 * before["S2"]
    assert after["S1"] < 1.1 * before["S1"]


@pytest.mark.parametrize(
    "noise",
    [
        pytest.param({"flicker_nT_per_rtHz": 0.1}, marks=pytest.mark.long),
        pytest.param({"flicker_nT_per_rtHz": 0.01, "flicker_exponent": 2.0}, marks=pytest.mark.long),
    ],
)
def test_strong_slow_noise_is_no_effect(tmp_path: Path, noise: dict[str, float]) -> None:
    instrument = scenario()["instrument"] | {"noise": {"white_sd_nT": 0.15} | noise, "seed": 101}
    found = verdict_of(tmp_path, scenario(101, instrument=instrument))
    assert found["adopted"] == []


@pytest.mark.parametrize(("strength", "turn"), [(1.0, 0.0), (0.8, 1.1), (0.0, 0.0)])
def test_a_tone_is_taken_off_with_the_phase_and_strength_it_has_here(
    tmp_path: Path, strength: float, turn: float
) -> None:
    record = loaded(tmp_path, scenario(22))
    calibration = calibrated(joint_state(record, [], Fitting()).fit)
    rng = np.random.default_rng(4)
    cosines, sines = rng.standard_normal((2, 4, 3))
    phase = 2 * np.pi * 0.23 * (record.time - record.start) + turn
    tone = np.cos(phase)[:, None, None] * cosines + np.sin(phase)[:, None, None] * sines
    disturbed = replace(record, raw=record.raw + strength * tone)
    model = Adopted(Registry.load().find("error_model", "periodic_interference"), {"frequency_Hz": 0.23})
    theta = np.concatenate([cosines.ravel(), sines.ravel()])
    raw = corrected_raw(disturbed, calibration, [model], [theta])
    # two numbers found from 32 000 contrasts with 0.15 nT of noise each
    assert np.std(raw - record.raw) < 0.01


def test_a_weak_tone_is_found_beside_a_strong_effect_and_not_said_to_stay(tmp_path: Path) -> None:
    """A drift of 20 nT hides a tone of 0.1 nT until it is taken off."""
    record = loaded(tmp_path, scenario(22))
    calibration = calibrated(joint_state(record, [], Fitting()).fit)
    rng = np.random.default_rng(4)
    cosines, sines = 0.1 * rng.standard_normal((2, 4, 3))
    phase = 2 * np.pi * 0.23 * (record.time - record.start) + 0.4
    tone = np.cos(phase)[:, None, None] * cosines + np.sin(phase)[:, None, None] * sines
    drift = 40.0 * rng.standard_normal((4, 3))
    course = (record.time - record.start) / (record.time[-1] - record.start)
    registry = Registry.load()
    span = float(record.time[-1] - record.start)
    models = [
        Adopted(registry.find("error_model", "offset_drift"), {"order": 1, "span_s": span}),
        Adopted(registry.find("error_model", "periodic_interference"), {"frequency_Hz": 0.23}),
    ]
    theta = [drift.ravel() / 2.0, np.concatenate([cosines.ravel(), sines.ravel()])]
    disturbed = replace(record, raw=record.raw + course[:, None, None] * drift + tone)
    every = list(zip(models, theta, strict=True))
    assert tone_here(disturbed, calibration, *every[1], None, every[1:]) is None
    assert tone_here(disturbed, calibration, *every[1], None, every) is not None
    raw = corrected_raw(disturbed, calibration, models, theta)
    left = (raw - record.raw) - (raw - record.raw).mean(axis=0)
    assert np.std(left) < 0.01


@pytest.mark.long
def test_a_lag_longer_than_the_survey_gives_way_to_a_drift(tmp_path: Path) -> None:
    """A thermometer through a lag of twenty minutes is as good a drift on this survey, and not on the next one."""
    drifting = scenario(8, {"type": "offset_drift", "rms_nT": 0.45})
    told = verdict_of(tmp_path, drifting, models=["offset_drift", "temperature_offset", "warm_up"])
    assert adopted_names(told) == {"offset_drift"}
    assert "temperature_offset" in suspects(told)
