"""What a waveform that nobody logged goes like."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, synthetic

from magtensor.loop.searching.likeness import (
    _correlations,
    course_words,
    followed,
    followed_by_a_product,
    followed_in_part,
)

SAMPLES = 1200


def telegraph(rng: np.random.Generator, dwell_s: float) -> Array:
    """(N,) 0 or 1, random switchings."""
    return np.asarray(np.cumsum(rng.random(SAMPLES) < 1.0 / dwell_s) % 2, dtype=float)


def smooth(rng: np.random.Generator, width: float) -> Array:
    bell = np.exp(-0.5 * (np.arange(-4 * width, 4 * width + 1) / width) ** 2)
    return np.convolve(rng.standard_normal(SAMPLES), bell, mode="same")


@pytest.mark.parametrize(("begins", "words"), [(True, "heater from 480 s on"), (False, "heater until 480 s")])
def test_a_channel_that_acts_in_a_part_of_the_survey_is_named_with_it(begins: bool, words: str) -> None:
    rng = np.random.default_rng(2)
    record = synthetic(1, SAMPLES)
    heater = telegraph(rng, 30.0)
    record = replace(record, logged={"rain": smooth(rng, 20.0), "heater": heater})
    acts = (record.time >= 480.0) == begins
    waveform = heater * acts + 0.1 * rng.standard_normal(SAMPLES)
    assert followed_in_part(record.time, waveform, record) == words
    assert followed_in_part(record.time, heater + 0.1 * rng.standard_normal(SAMPLES), record) == ""  # it acts always


def test_few_switchings_are_enough_where_nothing_else_is_in_the_waveform() -> None:
    rng = np.random.default_rng(4)
    record = synthetic(1, SAMPLES)
    pump = np.searchsorted([100, 210, 390, 500, 710, 800, 950, 1060], record.time) % 2 * 1.0
    record = replace(record, logged={"rain": smooth(rng, 20.0), "pump": pump})
    waveform = pump * (record.time > 600.0)
    words = followed_in_part(record.time, waveform + 0.02 * rng.standard_normal(SAMPLES), record)
    assert words.startswith("pump from ") and 500.0 < float(words.split()[2]) <= 710.0
    assert followed_in_part(record.time, waveform + 0.2 * rng.standard_normal(SAMPLES), record) == ""


@pytest.mark.parametrize("seed", range(20))
def test_what_has_nothing_to_do_with_a_source_is_not_named(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    channels = {f"c{k}": (telegraph if k % 2 else smooth)(rng, 20.0 * 2.0 ** (k % 4)) for k in range(12)}
    record = replace(synthetic(1, SAMPLES), logged=channels)
    for source in (telegraph(rng, 60.0), smooth(rng, 40.0), telegraph(rng, 300.0)):
        assert followed_in_part(record.time, source, record) == ""
        assert followed_by_a_product(record.time, source, record) == ""


def test_the_product_of_two_channels_is_named_as_that() -> None:
    """A current whose field the temperature of a core makes stronger and weaker."""
    rng = np.random.default_rng(2)
    temperature, heater = smooth(rng, 20.0), telegraph(rng, 30.0)
    record = replace(synthetic(1, SAMPLES), logged={"rain": smooth(rng, 30.0), "heater": heater, "core": temperature})
    product = (temperature / temperature.std() + 0.3) * heater + 0.2 * rng.standard_normal(SAMPLES)
    assert followed_by_a_product(record.time, product, record) == "heater times core"
    alone = 2.0 * heater + temperature / temperature.std() + 0.2 * rng.standard_normal(SAMPLES)
    assert followed_by_a_product(record.time, alone, record) == ""  # the sum of both
    powers = np.column_stack([np.ones(SAMPLES), heater, temperature, temperature**2])
    left = product - powers @ np.linalg.lstsq(powers, product, rcond=None)[0]  # by the laws of both, once adopted
    assert followed_by_a_product(record.time, left, record) == "heater times core"
    bent = (temperature / temperature.std()) ** 2 + heater + 0.2 * rng.standard_normal(SAMPLES)
    assert followed_by_a_product(record.time, bent, record) == ""  # a law of one of them


@pytest.mark.parametrize("lag", [0, 7])
def test_the_rate_of_a_channel_is_named_as_that(lag: int) -> None:
    """A pick-up loop beside a current, whose log is noisy: faster than the means that slow courses are compared by."""
    rng = np.random.default_rng(3)
    samples, step = 9000, 0.1
    current = np.convolve(rng.standard_normal(samples + lag + 40), np.hanning(21), mode="valid")[: samples + lag]
    rate = np.gradient(current, step)[:samples]
    logged = {"other": rng.standard_normal(samples), "current": current[lag:] + 0.02 * rng.standard_normal(samples)}
    record = replace(synthetic(1, samples), time=step * np.arange(samples), logged=logged)
    found = followed(record.time, rate / rate.std() + 0.1 * rng.standard_normal(samples), record)
    assert found is not None and found.words == "the rate of channel current" and found.course == "current (its rate)"
    assert found.lag_s == pytest.approx(lag * step, abs=1.01 * step) and abs(found.correlation) > 0.9


def test_correlations_are_those_of_what_two_series_have_in_common() -> None:
    rng = np.random.default_rng(4)
    late, early = np.cumsum(rng.standard_normal((2, 300)), axis=1)
    shifts = np.array([0, 3, -3, 29, -29])
    for shift, c in zip(shifts, _correlations(late, early, shifts), strict=True):
        later, sooner = max(shift, 0), max(-shift, 0)
        assert c == pytest.approx(np.corrcoef(late[later : 300 - sooner], early[sooner : 300 - later])[0, 1], abs=1e-9)
    assert _correlations(late, np.full(300, 2.0), shifts).tolist() == [0.0] * 5


def test_when_a_source_acts_is_said() -> None:
    elapsed = np.arange(1000) / 2.0
    assert course_words(elapsed, np.where(elapsed > 120.0, 1.0, -0.3)) == "switches at 120.5 s"
    thrice = np.searchsorted([40.25, 100.25, 300.25], elapsed) % 2 * 1.0
    assert course_words(elapsed, thrice) == "switches 3 times, first at 40.5 s and last at 300.5 s"
    for_a_while = np.where((elapsed > 200.0) & (elapsed < 300.0), np.sin(elapsed), 0.0)
    found = course_words(elapsed, for_a_while).split()
    assert found[:2] == ["acts", "from"] and 200.0 < float(found[2]) < 206.0 and 294.0 < float(found[4]) < 300.0
    assert course_words(elapsed, np.sin(elapsed)) == "" == course_words(elapsed, np.zeros(1000))
