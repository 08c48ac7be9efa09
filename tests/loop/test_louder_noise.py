"""Noise that is louder for a while is noise: no disturbance and no effect. A calibration is better without it only
where it is much louder, and the quieter samples determine one."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import BASE, Array, adopted_names, linear_state, loaded, scenario, synthetic, verdict_of

from magtensor.loop.evidence.stretches import louder_in, too_loud_in
from magtensor.loop.fitting.model import Fitting
from magtensor.loop.fitting.refit import disturbed, joint_state, loud_stretches
from magtensor.loop.remainder.loud import louder_words

MODELS = ["offset_step", "passing_source", "eddy_current", "temperature_offset", "offset_drift", "scale_step"]


def directions(rng: np.random.Generator, count: int) -> Array:
    """(count, 4), (u, 1) of random directions u."""
    u = rng.standard_normal((count, 3))
    return np.column_stack([u / np.linalg.norm(u, axis=1)[:, None], np.ones(count)])


def louder(sd_nT: float, begin: float, until: float) -> Callable[[Path], None]:
    """Adds noise to all sensors in a part of a survey's file."""

    def change(path: Path) -> None:
        rng = np.random.default_rng(9)
        with h5py.File(path, "a") as file:
            raw = file["b_raw"][:]
            part = slice(int(begin * len(raw)), int(until * len(raw)))
            raw[part] += rng.normal(0.0, sd_nT, raw[part].shape)
            file["b_raw"][:] = raw

    return change


def test_louder_noise_is_kept_and_neither_a_spike_nor_what_passes_by() -> None:
    rng = np.random.default_rng(5)
    n = 4000
    values = rng.standard_normal((n, 9))
    values[2000:] *= 4.0
    values[500:503] += 20.0  # a spike
    values[1000:1200] += 8.0 * np.sin(np.pi * np.arange(200) / 200)[:, None]  # something passes
    square = np.sum(values**2, axis=1)
    found = louder_in(square < 45.0, [(9, values)])
    assert found[2000:].mean() > 0.99
    assert not found[500:503].any()
    assert not found[1050:1150].any()


@pytest.mark.parametrize("samples", [200, 1000, 4000])
def test_even_noise_is_nowhere_too_loud(samples: int) -> None:
    rng = np.random.default_rng(samples)
    for _ in range(100):
        assert not too_loud_in(rng.standard_normal((samples, 12)), directions(rng, samples)).any()


@pytest.mark.parametrize(("times", "part", "without"), [(1.5, 0.3, False), (4.0, 0.3, True), (4.0, 0.03, False)])
def test_a_fit_is_better_without_what_is_much_louder_for_long(times: float, part: float, without: bool) -> None:
    """Of two fits of a straight line to values of known noise, the one with the smaller error."""
    rng = np.random.default_rng(3)
    n, trials = 2000, 400
    sd = np.ones(n)
    sd[900 : 900 + int(part * n)] = times
    z = directions(rng, n)
    loud = too_loud_in(rng.standard_normal((n, 12)) * sd[:, None], z)
    assert loud.any() == without
    noise = rng.standard_normal((n, trials)) * sd[:, None]
    every = z @ np.linalg.lstsq(z, noise)[0]
    quiet = z @ np.linalg.lstsq(z[sd == 1.0], noise[sd == 1.0])[0]
    assert (np.mean(quiet**2) < 0.5 * np.mean(every**2)) == without


def test_what_only_the_loud_samples_have_seen_stays() -> None:
    rng = np.random.default_rng(4)
    z, sd = directions(rng, 2000), np.ones(2000)
    sd[1000:] = 4.0
    z[:1000, :3] = [0.0, 0.6, 0.8] + 0.02 * rng.standard_normal((1000, 3))  # the quiet half was hardly turned
    assert not too_loud_in(rng.standard_normal((2000, 12)) * sd[:, None], z).any()


@pytest.mark.long
def test_a_survey_whose_second_half_is_louder_is_calibrated_with_the_first(tmp_path: Path) -> None:
    told = verdict_of(tmp_path, scenario(81), louder(0.6, 0.5, 1.0), MODELS)
    assert told["adopted"] == []
    description = told["unexplained"]["description"]
    assert "fit no calibration" not in description and "are so loud have no part in the calibration" in description
    # |b| - F of the quiet half: 0.15 nT of white noise of a sensor, 0.1 nT of the base station between its readings
    assert 0.9 < told["error"]["held_out"]["after"]["total_field_rms_nT"]["all"] / np.hypot(0.15, 0.1) < 1.15


@pytest.mark.long
def test_what_is_shown_in_the_loud_part_alone_is_no_reason_to_leave_it_out(tmp_path: Path) -> None:
    """A pump that shakes everything while its current runs."""

    def pumping(path: Path) -> None:
        louder(0.6, 0.4, 0.8)(path)
        with h5py.File(path, "a") as file:
            raw = file["b_raw"][:]
            part = slice(int(0.4 * len(raw)), int(0.8 * len(raw)))
            current = file["current_heater"][:]
            current[: part.start], current[part.stop :] = 0.0, 0.0
            raw[part] += current[part, None, None] * np.random.default_rng(2).normal(0.0, 1.5, raw.shape[1:])
            file["current_heater"][:], file["b_raw"][:] = current, raw

    told = verdict_of(tmp_path, scenario(82), pumping, [*MODELS, "current_field"])
    assert adopted_names(told) == {"current_field"}
    assert "have no part in the calibration" not in told["unexplained"]["description"]


def test_of_the_loud_samples_those_that_even_this_noise_does_not_explain_are_flagged(tmp_path: Path) -> None:
    def spoilt(path: Path) -> None:
        louder(0.6, 0.5, 1.0)(path)
        with h5py.File(path, "a") as file:
            file["b_raw"][1800:1803, 2] += 30.0

    record = loaded(tmp_path, scenario(83), spoilt)
    first = joint_state(record, [], Fitting())
    (stretch,) = loud_stretches(record, first, Fitting())
    how = Fitting(searching=False, without=(stretch,))
    last = joint_state(record, [], how)
    assert not last.fit.keep[1250:].any() and last.fit.keep[:1150].mean() > 0.99
    found = np.flatnonzero(disturbed(record, last, how))
    assert found[np.abs(found - 1200) > 25].tolist() == [1800, 1801, 1802]  # its beginning may count as quiet


def test_an_even_survey_has_no_loud_stretches() -> None:
    record = synthetic(5, 1500, turning_s=4.0, noise_nT=0.15)
    assert loud_stretches(record, linear_state(record), Fitting()) == ()


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 5])
def test_events_within_the_noise_of_one_loud_sensor_are_not_told_of(seed: int, tmp_path: Path) -> None:
    def loud(path: Path) -> None:
        rng = np.random.default_rng(seed)
        with h5py.File(path, "a") as file:
            raw, since = file["b_raw"][:], file["time"][:] - file["time"][0]
            part = (since > 360.0) & (since < 390.0)
            raw[part, 1] += rng.normal(0.0, 1.8, raw[part, 1].shape)
            file["b_raw"][:] = raw

    survey = scenario(seed, rate_Hz=8.0, motion=BASE["motion"] | {"duration_s": 500.0})
    told = verdict_of(tmp_path, survey, loud, ["offset_while", "passing_source", "offset_step"])
    assert not told["adopted"] and not told["unexplained"]["present"], told["unexplained"]["description"]
    assert told["unexplained"]["looks_like"] == []
    assert "the noise of S2 is" in told["unexplained"]["description"]


@pytest.mark.parametrize(("times", "told"), [(4.0, True), (2.0, False)])
def test_a_sensor_that_is_far_louder_than_the_others_is_told(times: float, told: bool) -> None:
    added = np.zeros((1200, 4, 3))
    added[:, 2] = np.sqrt(times**2 - 1.0) * np.random.default_rng(33).standard_normal((1200, 3))
    record = synthetic(3, added=added)
    words = louder_words(linear_state(record), record)
    assert bool(words) is told
    if told:
        said = re.fullmatch(r"the noise of most sensors is ([\d.]+) nT an axis, that of S3 is ([\d.]+) nT", words[0])
        assert (
            said and float(said[1]) == pytest.approx(1.0, abs=0.05) and float(said[2]) == pytest.approx(4.0, rel=0.05)
        )


@pytest.mark.parametrize("step_nT", [2.0, 2.0**1.5])
def test_a_sensor_that_is_rounded_more_coarsely_than_the_others_is_told_with_its_steps(step_nT: float) -> None:
    record = synthetic(3, noise_nT=0.1)
    raw = record.raw.copy()
    raw[:, 2] = step_nT * np.round(raw[:, 2] / step_nT)
    record = replace(record, raw=raw)
    (words,) = louder_words(linear_state(record), record)
    assert words.endswith(f"nT, for its outputs come in steps of {step_nT:.3g} nT")
    assert float(words.split("that of S3 is ")[1].split()[0]) == pytest.approx(step_nT / 12**0.5, rel=0.05)
