"""What a waveform that nobody logged goes like."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, synthetic

from magtensor.loop.searching.likeness import followed_in_part

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


@pytest.mark.parametrize("seed", range(20))
def test_what_has_nothing_to_do_with_a_source_is_not_named(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    channels = {f"c{k}": (telegraph if k % 2 else smooth)(rng, 20.0 * 2.0 ** (k % 4)) for k in range(12)}
    record = replace(synthetic(1, SAMPLES), logged=channels)
    for source in (telegraph(rng, 60.0), smooth(rng, 40.0), telegraph(rng, 300.0)):
        assert followed_in_part(record.time, source, record) == ""
