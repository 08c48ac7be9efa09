"""What a single sensor's slow noise explains at one time is compared with what it explains at others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, linear_state, synthetic

from magtensor.loop.evidence.other_times import moved
from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.fitting.model import Record, State
from magtensor.registry import Registry

MODEL = Registry.load().find("error_model", "offset_while")
SAMPLES, LASTS_S = 2000, 140.0


def that_walks(seed: int, size_nT: float) -> Record:
    """A single sensor that turns within some seconds and whose offset walks, on a walk of its own."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(np.cumsum(rng.standard_normal((SAMPLES, 3)), axis=0) / 50.0, axis=0)
    walk -= walk.mean(axis=0)
    return synthetic(seed, SAMPLES, 1, 0.2, added=size_nT * (walk / walk.std(axis=0))[:, None], turning_s=3.0)


def p_of(state: State, since_s: float) -> float:
    terms = MODEL.function(state.excitation, time_s=since_s, until_s=since_s + LASTS_S)
    return OwnNoise(state.residual, None).by_score(terms.at(state.residual.samples))


def test_no_time_is_unlikely_where_a_single_sensor_walks() -> None:
    rng = np.random.default_rng(5)
    found = []
    for seed in range(5):
        state = linear_state(that_walks(seed, 20.0))
        found += [p_of(state, since) for since in rng.uniform(0.0, SAMPLES - LASTS_S, 12)]
    assert np.mean(np.array(found) < 1e-3) <= 2 / 60  # the heavy tail of a walk; a score alone gives nearly all
    assert np.median(found) > 0.1


@pytest.mark.parametrize("size_nT", [1.0, 5.0])
def test_what_is_there_for_a_while_is_unlikely(size_nT: float) -> None:
    record = synthetic(3, SAMPLES, 1, 0.5, turning_s=3.0)
    while_ = (record.time >= 700.0) & (record.time < 700.0 + LASTS_S)
    added = size_nT * while_[:, None, None] * np.array([0.6, -0.6, 0.5])
    state = linear_state(replace(record, raw=record.raw + added))
    assert p_of(state, 700.0) < 1e-9
    assert p_of(state, 1500.0) > 1e-3


def test_a_course_that_is_moved_comes_back() -> None:
    series: Array = np.arange(10.0)[:, None]
    np.testing.assert_array_equal(moved(series, 0.0), series)
    np.testing.assert_array_equal(moved(series, 0.5), series[::-1])
    np.testing.assert_array_equal(moved(series, 0.1)[:, 0], [1, 0, 0, 1, 2, 3, 4, 5, 6, 7])
