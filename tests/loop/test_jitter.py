"""A sensor whose samples are taken early or late at random: no regressor follows it, and it is told."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import BASE, linear_state, loaded, scenario, verdict_of

from magtensor.loop.remainder.jitter import jitter_words

EFFECTS: dict[str, list[dict[str, Any]]] = {
    "clean": [],
    "a delay": [{"type": "sampling_lag", "rms_nT": 0.5}],
    "a loop": [{"type": "hysteresis", "half_width_nT": [5000.0], "rms_nT": 0.5}],
    "a temperature": [{"type": "temperature_offset", "rms_nT": 2.0}],
}


@pytest.mark.parametrize("seed", [101, 102, 103])
def test_it_is_found_with_its_size(seed: int, tmp_path: Path) -> None:
    effect = {"type": "jitter", "rms_nT": 0.3, "sensors": ["S2"]}
    (words,) = jitter_words(linear_state(loaded(tmp_path, scenario(seed, effect))))
    found = re.fullmatch(r"the noise of (S\d) grows .* by ([\d.]+) nT rms, .* by ([\d.]+) ms at random", words)
    assert found is not None and found[1] == "S2"
    # the samples that it throws furthest off are flagged: what is left of them scatters by a tenth less
    assert float(found[2]) == pytest.approx(0.3, rel=0.25)


@pytest.mark.parametrize("sensors", [["S2"], ["S1", "S2", "S3", "S4"]])
def test_of_all_sensors_none_is_singled_out(sensors: list[str], tmp_path: Path) -> None:
    effects = [{"type": "jitter", "rms_nT": 0.3, "sensors": [sensor]} for sensor in sensors]
    (words,) = jitter_words(linear_state(loaded(tmp_path, scenario(102, *effects))))
    assert words.startswith("the noise of all sensors grows" if len(sensors) > 1 else "the noise of S2 grows")


@pytest.mark.parametrize("what", EFFECTS)
@pytest.mark.parametrize("seed", [101, 102, 103])
def test_nothing_else_is_taken_for_it(what: str, seed: int, tmp_path: Path) -> None:
    assert jitter_words(linear_state(loaded(tmp_path, scenario(seed, *EFFECTS[what])))) == []


@pytest.mark.parametrize("seed", [3, 4])
def test_noise_that_is_nearly_all_slow_has_no_scatter(seed: int, tmp_path: Path) -> None:
    """A random walk of 0.3 nT beside white noise of 0.005: what turns it makes some of that grow with the turning."""

    def wandering(path: Path) -> None:
        with h5py.File(path, "r+") as survey:
            raw = survey["b_raw"]
            walk = np.cumsum(np.random.default_rng(seed).standard_normal(raw.shape), axis=0)
            raw[...] = raw[:] + 0.3 * walk / walk.std()

    quiet = BASE["instrument"] | {"noise": {"white_sd_nT": 0.005}}
    motion = BASE["motion"] | {"duration_s": 600.0}
    survey = scenario(seed, instrument=quiet, rate_Hz=10.0, motion=motion)
    assert jitter_words(linear_state(loaded(tmp_path, survey, wandering))) == []


def with_two_ranges(path: Path) -> None:
    """S2 reads a nT more on x, and less on y, where its output is beyond 25 000 nT."""
    with h5py.File(path, "r+") as survey:
        raw = survey["b_raw"][:]
        raw[:, 1] += (np.abs(raw[:, 1]) > 25_000.0) * np.array([1.0, -1.0, 0.5])
        survey["b_raw"][...] = raw


def test_a_law_that_the_field_sweeps_through_is_no_scatter(tmp_path: Path) -> None:
    """What its outputs predict is none of its noise, however fast the field takes it from one end to the other."""
    survey = scenario(101, motion=BASE["motion"] | {"rate_rms_deg_s": 30.0, "rate_time_s": 4.0})
    assert jitter_words(linear_state(loaded(tmp_path, survey, with_two_ranges)))
    told = verdict_of(tmp_path, survey, with_two_ranges, [])["unexplained"]["description"]
    assert "can be predicted" in told and "early or late" not in told
