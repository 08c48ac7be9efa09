"""A sensor that is wrong too often for spikes is told, and noise of whatever kind is not."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import Array, flicker, linear_state, loaded, scenario, synthetic, verdict_of

from magtensor.loop.fitting.model import Fitting, Record
from magtensor.loop.fitting.refit import disturbed, settled
from magtensor.loop.remainder.outlying import Outlying, outlying_words, spike_words

TOLD = (
    r"(.+) is off by more than 5 times its noise in (\d+) samples \(([\d.]+)%\), ([\d.]+) nT rms there, too often for "
    r"spikes: (\w+) of them pass for noise and have a part in the calibration"
)
SIZE = 40.0  # nT, of a wrong reading, and times the noise of `synthetic`


def found_in(record: Record) -> tuple[Outlying, Array]:
    """What is outlying at the end of a search that adopts nothing, and the samples that are left out then."""
    last = settled(record, linear_state(record), Fitting())
    return Outlying.of(last, record), disturbed(record, last, Fitting())


def directions(rng: np.random.Generator, count: int) -> Array:
    """(count, 3) random unit vectors."""
    u = rng.standard_normal((count, 3))
    return np.asarray(u / np.linalg.norm(u, axis=1, keepdims=True))


@pytest.mark.parametrize("sensors", [2, 3, 4])
@pytest.mark.parametrize("samples", [136, 2400])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_noise_is_not_told(sensors: int, samples: int, seed: int) -> None:
    """136 postures in any order, or a course of 2400 samples."""
    rng = np.random.default_rng(seed)
    shape = (samples, sensors, 3)
    wandering, louder = np.zeros(shape), np.zeros(shape)
    wandering[:, 1] = 0.3 * np.cumsum(rng.standard_normal((samples, 3)), axis=0)
    for_a_while = slice(samples // 3, samples // 3 + samples // 20)
    louder[for_a_while, 1] = 15.0 * rng.standard_normal(louder[for_a_while, 1].shape)
    for added in (None, flicker(rng, shape), wandering, louder):
        record = synthetic(seed, samples, sensors, added=added, turning_s=4.0 if samples > 1000 else 0.0)
        found, left_out = found_in(record)
        assert outlying_words(found, left_out)[0] == []
        assert found.too_often() == [] or (samples == 136 and added is louder)  # of six in a row, all left out


@pytest.mark.parametrize("sensors", [2, 3, 4])
def test_a_clean_survey_of_the_simulator_has_none(tmp_path: Path, sensors: int) -> None:
    places = [[0.2, 0.0, 0.0], [-0.1, 0.2, 0.0], [-0.1, -0.2, 0.0], [0.0, 0.0, 0.3]][:sensors]
    survey = scenario(31)
    survey["instrument"] = survey["instrument"] | {"array": {"positions_m": places}}
    found, left_out = found_in(loaded(tmp_path, survey))
    assert found.too_often() == [] and spike_words(found, left_out) == []


@pytest.mark.parametrize(("sensors", "name"), [(2, "S1 or S2"), (3, "S2"), (4, "S2")])
@pytest.mark.parametrize("share", [0.05, 0.2])
def test_how_often_and_by_how_much_a_sensor_is_wrong(sensors: int, name: str, share: float) -> None:
    rng = np.random.default_rng(7)
    bad = rng.random(1200) < share
    added = np.zeros((1200, sensors, 3))
    added[bad, 1] = SIZE * directions(rng, int(bad.sum()))
    found, left_out = found_in(synthetic(8, 1200, sensors, added=added, turning_s=4.0))
    words, told = outlying_words(found, np.zeros(1200, dtype=bool))
    said = re.fullmatch(TOLD, words[0])
    assert len(words) == 1 and said and said[1] == name and said[5] == "all"
    assert int(said[2]) == told.sum() and float(said[3]) == pytest.approx(100.0 * told.mean(), abs=0.05)
    assert not told[~bad].any() and told[bad].mean() > 0.95
    # on each axis a third of the square, and the noise of what the others say of it
    assert float(said[4]) == pytest.approx(np.hypot(SIZE / np.sqrt(3.0), np.sqrt(sensors / (sensors - 1.0))), rel=0.03)
    assert outlying_words(found, bad)[0] == []  # these are spikes, and told as such
    assert left_out[~bad].sum() == 0


def test_what_all_sensors_have_now_and_then_is_no_single_ones() -> None:
    rng = np.random.default_rng(9)
    bad = rng.random(1200) < 0.1
    added = np.zeros((1200, 4, 3))
    added[bad] = SIZE * rng.standard_normal((int(bad.sum()), 4, 3))
    found, _ = found_in(synthetic(9, 1200, added=added, turning_s=4.0))
    assert found.wrong.sum() > 50 and found.too_often() == []


@pytest.mark.parametrize(("times", "told"), [(SIZE, True), (8.0, False)])
def test_few_spikes_are_told_where_no_tail_of_noise_reaches(times: float, told: bool) -> None:
    rng = np.random.default_rng(17)
    added = np.zeros((1200, 4, 3))
    added[100:1100:200, 1] = times * directions(rng, 5)
    found, left_out = found_in(synthetic(18, 1200, added=added, turning_s=4.0))
    assert left_out.sum() <= 0.01 * len(left_out)
    words = spike_words(found, left_out)
    assert bool(words) is told
    assert not told or ("5 samples (0.4%)" in words[0] and "on S2" in words[0])


def test_where_what_is_slow_goes_furthest_is_no_spike() -> None:
    """A sensor that moves by up to twenty times its noise within some dozen samples, where two of them are left out."""
    sensor = np.zeros((1200, 4, 3))
    sensor[:, 2] = 3.5 * np.sin(2.0 * np.pi * np.arange(1200) / 120.0)[:, None] ** 9
    found, _ = found_in(synthetic(18, 1200, added=sensor, turning_s=4.0))
    left_out = np.zeros(1200, dtype=bool)
    left_out[30::120] = True
    left_out[31::120] = True
    left_out[33::120] = True
    (words,) = spike_words(found, left_out)
    assert words.startswith("single samples: 30 samples") and "on S3, and their neighbours are off nearly" in words


def test_spikes_of_the_total_field_are_no_sensors() -> None:
    record = synthetic(10, 1200, turning_s=4.0)
    assert record.total_field is not None
    at = np.arange(20, 1180, 40)
    total = record.total_field.copy()
    total[at] += 60.0
    found, left_out = found_in(replace(record, total_field=total))
    assert np.flatnonzero(left_out).tolist() == at.tolist() and not found.wrong.any()
    (words,) = spike_words(found, left_out)
    size = re.match(
        r"spikes: 29 samples \(2\.4%\) fit no calibration, by ([\d.]+) nT in the median, on \|b\| - F", words
    )
    assert size and float(size[1]) == pytest.approx(60.0, abs=0.5)


def test_a_register_whose_low_bits_are_wrong_now_and_then(tmp_path: Path) -> None:
    """A fifth of the readings of a sensor are off by some 40 times its noise."""

    def spoilt(path: Path) -> None:
        rng = np.random.default_rng(3)
        with h5py.File(path, "a") as file:
            raw = file["b_raw"][:]
            wrong = rng.random(len(raw)) < 0.2
            raw[wrong, 1] += rng.normal(0.0, 6.0, (int(wrong.sum()), 3))
            file["b_raw"][:] = raw

    left = verdict_of(tmp_path, scenario(32), spoilt, ["offset_step"])["unexplained"]
    said = re.search(TOLD.replace("(.+) is", r"(\S+) is"), left["description"])
    assert left["present"] and said and said[1] == "S2", left["description"]
    assert 17.0 < float(said[3]) < 22.0 and float(said[4]) == pytest.approx(6.0, rel=0.1)
    assert left["description"].count("spikes") == 1
