"""What is left along the vector of an adopted effect is left by its law, and is no noise of the sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import flicker, synthetic
from numpy.typing import NDArray

from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.remainder.along_an_effect import along_an_effect_words
from magtensor.registry import Registry

Array = NDArray[np.float64]
SAMPLES = 1600
VECTOR = np.array([0.6, -0.5, 0.62])


def wandering(seed: int) -> Array:
    """A thermometer that comes and goes, within some minutes."""
    rng, time = np.random.default_rng(seed), np.arange(SAMPLES)
    out: Array = sum(np.sin(time / period + rng.uniform(0.0, 6.3)) for period in (31.0, 44.0, 67.0))  # type: ignore[assignment]
    return out


def play(course: Array, half_width: float) -> Array:
    """What follows a course through a play, as a gear does."""
    out, now = np.empty(len(course)), course[0]
    for i, value in enumerate(course):
        now = min(max(now, value - half_width), value + half_width)
        out[i] = now
    return out


def fitted(seed: int, course: Array, added: Array, noise: Array | None = None) -> State:
    """A survey in which the first sensor adds a series (N,) along a vector, and noise (N, 3); the fit with what is in
    proportion to a logged course."""
    record: Record = synthetic(seed, SAMPLES)
    raw = record.raw.copy()
    raw[:, 0] += np.multiply.outer(added, VECTOR) + (0.0 if noise is None else noise)
    logged = {"temperature": course}
    record = replace(record, raw=raw, logged=logged, units={"temperature": "degC"}, origins={"temperature": 0.0})
    model = Registry.load().find("error_model", "channel_response")
    settings = {"channel": "temperature", "power": 1, "times_field": False}
    return joint_state(record, [Adopted(model, settings, ("S1",))], Fitting())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_a_law_leaves_is_told(seed: int) -> None:
    course = wandering(seed)
    (words,) = along_an_effect_words(fitted(seed, course, 4.0 * play(course, 1.0)))
    assert words.startswith("what is left of S1 lies along the vector that channel_response has there")


@pytest.mark.parametrize("what", ["nothing", "slow noise", "one axis", "another vector", "noise of the log"])
def test_noise_is_not(what: str) -> None:
    """Slow noise of all axes, of one of them, along a vector of its own; and what a noisy log brings in, which is
    quick."""
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        noise = np.zeros((SAMPLES, 3))
        slow = 3.0 * flicker(rng, (SAMPLES, 3))
        course = wandering(seed)
        logged = course.copy()
        if what == "slow noise":
            noise = slow
        elif what == "one axis":
            noise[:, 1] = slow[:, 1]
        elif what == "another vector":
            noise = np.multiply.outer(slow[:, 0], [0.5, 0.8, -0.3])
        elif what == "noise of the log":
            logged = course + 0.3 * rng.standard_normal(SAMPLES)
        assert along_an_effect_words(fitted(seed, logged, 4.0 * course, noise)) == []


def test_of_one_sensor_nothing_is_known() -> None:
    state = fitted(5, wandering(5), 4.0 * play(wandering(5), 1.0))
    alone = replace(state, residual=replace(state.residual, across=None))
    assert along_an_effect_words(alone) == []
