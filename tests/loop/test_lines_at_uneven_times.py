"""A tone is found where the samples lie at uneven times; noise that is slow has no line there either."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, flicker, lines_left, synthetic

from magtensor.loop.evidence.spectrum import transform
from magtensor.loop.fitting.model import Record

SAMPLES = 2400
FREQUENCY_HZ = 0.383  # where a sample late by 0.3 s has another phase


def uneven(seed: int, jitter_s: float) -> Array:
    """(N,) s, each within so much of its place on a grid of seconds."""
    time = np.arange(float(SAMPLES)) + np.random.default_rng(seed).uniform(-jitter_s, jitter_s, SAMPLES)
    return np.sort(time - time[0])


def at(time: Array, seed: int, added: Array) -> Record:
    """A survey of these times, with (N, S, 3) nT more."""
    return replace(synthetic(seed, SAMPLES, added=added), time=time)


@pytest.mark.parametrize("samples", [301, 1000])
def test_the_transform_is_the_sum_over_the_samples(samples: int) -> None:
    """Of an odd and an even number of places."""
    rng = np.random.default_rng(samples)
    places = np.sort(np.arange(samples) + rng.uniform(-0.3, 0.3, samples))
    places -= places[0]
    n = int(np.rint(places[-1])) + 1
    values = rng.standard_normal((samples, 3))
    angle = 2.0 * np.pi * np.outer(np.arange(n // 2 + 1), places) / n
    expected = np.exp(-1j * angle) @ values
    np.testing.assert_allclose(transform(values, places, n), expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("jitter_s", [0.15, 0.3, 0.45])
def test_a_tone_is_found(jitter_s: float) -> None:
    time = uneven(3, jitter_s)
    tone = np.sin(2.0 * np.pi * FREQUENCY_HZ * time + 0.4)
    record = at(time, 61, 0.4 * tone[:, None, None] * np.random.default_rng(5).standard_normal((4, 3)))
    frequency, rms, p = lines_left(record)[0]
    assert frequency == pytest.approx(FREQUENCY_HZ, abs=1.0 / SAMPLES)
    assert p < 1e-6
    assert 0.15 < rms < 0.45  # 0.4 / sqrt 2 on the average of the axes, a fourth of it common to all sensors


@pytest.mark.parametrize("slow", [False, True], ids=["white", "slow"])
def test_noise_has_none(slow: bool) -> None:
    """Noise that is slower than the turning is in C and o too."""
    smallest = []
    for seed in range(20):
        noise = flicker(np.random.default_rng(seed), (SAMPLES, 4, 3), 1.0) if slow else np.zeros((SAMPLES, 4, 3))
        record = replace(synthetic(70 + seed, SAMPLES, added=3.0 * noise, turning_s=4.0), time=uneven(seed, 0.3))
        smallest.append(lines_left(record)[0][2])
    assert min(smallest) > 1e-3  # of 20 the smallest is below that once in 50 times
    assert np.mean(np.array(smallest) < 0.05) <= 0.2


def test_missing_samples_make_a_tone_no_weaker() -> None:
    """A fifth of the survey is missing, and what is left lies on no grid."""
    time = uneven(3, 0.3)
    tone = np.sin(2.0 * np.pi * FREQUENCY_HZ * time + 0.4)
    record = at(time, 61, 3.0 * tone[:, None, None] * np.random.default_rng(5).standard_normal((4, 3)))
    some = record.at(np.flatnonzero((time < 900.0) | (time > 1380.0)))
    every, fewer = (lines_left(r)[0] for r in (record, some))
    assert fewer[0] == pytest.approx(FREQUENCY_HZ, abs=1.0 / SAMPLES)
    assert fewer[1] == pytest.approx(every[1], rel=0.05)


def test_too_few_samples_for_their_time_have_none() -> None:
    """A third of the survey is missing, and the rest lies on no grid."""
    time = uneven(3, 0.3)
    tone = np.sin(2.0 * np.pi * FREQUENCY_HZ * time)
    record = at(time, 61, tone[:, None, None] * np.random.default_rng(5).standard_normal((4, 3)))
    record = record.at(np.flatnonzero((time < 800.0) | (time > 1600.0)))
    assert lines_left(record) == []
