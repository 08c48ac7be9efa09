"""A late sensor on a platform that turns too far from one sample to the next for any delay to be tested."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, linear_state, synthetic

from magtensor.loop.fitting.model import Record
from magtensor.loop.remainder.turned_too_far import turned_too_far_words

SAMPLES, STEP_S = 2400, 0.05
WAVES = 12


def directions(time: Array, rng: np.random.Generator) -> Array:
    """(N, 3) unit vectors that wander over the sphere, by starts and fits: up to a radian in 50 ms, then hardly."""
    own = time + 2.0 * np.sin(2.0 * np.pi * time / 12.0) / (2.0 * np.pi / 12.0) * 0.45  # goes on 0.1 to 1.9 as fast
    frequency, phase = rng.uniform(0.2, 2.2, (WAVES, 3)), rng.uniform(0.0, 2.0 * np.pi, (WAVES, 3))
    vectors = np.sum(np.sin(2.0 * np.pi * frequency * own[:, None, None] + phase), axis=1)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def tossed(seed: int, late_s: float) -> Record:
    """Four sensors with white noise, S2 late."""
    time = STEP_S * np.arange(SAMPLES)
    late = np.array([0.0, late_s, 0.0, 0.0])
    each = [directions(time - own, np.random.default_rng(seed)) for own in late]
    noise = 0.15 * np.random.default_rng(100 + seed).standard_normal((SAMPLES, 4, 3))
    raw, total = 50_000.0 * np.stack(each, axis=1) + noise, np.full(SAMPLES, 50_000.0)
    return replace(synthetic(seed, SAMPLES), time=time, raw=raw, total_field=total, quiet_field=total)


@pytest.mark.parametrize("late_s", [0.002, 0.0])
def test_what_grows_with_the_turn_between_samples_is_told(late_s: float) -> None:
    state = linear_state(tossed(3, late_s))
    assert state.excitation.turns_unseen  # a delay is not even tested
    words = turned_too_far_words(state)
    assert bool(words) is (late_s > 0)
    if words:
        assert "how far the field turns from one sample to the next" in words[0]


@pytest.mark.parametrize("seed", range(6))
def test_nothing_is_told_of_noise(seed: int) -> None:
    """White, in static postures, and slow."""
    assert turned_too_far_words(linear_state(tossed(seed, 0.0))) == []
    walk = np.cumsum(np.random.default_rng(seed).standard_normal((SAMPLES, 4, 3)), axis=0) / 20.0
    record = tossed(seed, 0.0)
    assert turned_too_far_words(linear_state(replace(record, raw=record.raw + walk))) == []
