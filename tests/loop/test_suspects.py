"""Events that are significant and predict nothing: under suspicion only where noise as it is there, or an error that
all sensors show alike, does not make them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from loop_cases import linear_state, looked_at, synthetic

from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.fitting.model import Adopted
from magtensor.loop.searching.suspects import seen_alike_alone, within_the_noise_there
from magtensor.registry import Registry

SAMPLES = 1500


def event(name: str, **settings: Any) -> Adopted:
    return Adopted(Registry.load().find("error_model", name), settings)


@pytest.mark.parametrize("jumped", [False, True])
@pytest.mark.parametrize("first", [40, 80])
def test_a_step_that_few_samples_tell_of_is_judged_by_their_noise(first: int, jumped: bool) -> None:
    """The first samples have twice the noise of the others; or C changes with them by 0.005 %."""
    rng = np.random.default_rng(first)
    added = np.zeros((SAMPLES, 4, 3))
    if not jumped:
        added[:first] = np.sqrt(3.0) * 0.2 * rng.standard_normal((first, 4, 3))
    clean = synthetic(first, SAMPLES, noise_nT=0.2, added=added)
    before = (np.arange(SAMPLES) < first)[:, None, None]
    record = replace(clean, raw=clean.raw * (1.0 + 5e-5 * before * jumped))
    state = linear_state(record)
    chosen = looked_at(state, event("calibration_step", time_s=float(first)), once=True)
    assert chosen.adjusted_own_p < 1e-6
    assert within_the_noise_there(chosen, state) is not jumped


@pytest.mark.parametrize("of_a_sensor", [False, True])
def test_what_moves_with_the_field_alone_is_no_event_of_a_sensor(of_a_sensor: bool) -> None:
    """The base station misses 1 nT of the field for a while; or the offset of a sensor is another one meanwhile."""
    rng = np.random.default_rng(5)
    meanwhile = (np.arange(SAMPLES) // 300 == 2).astype(float)
    added = np.zeros((SAMPLES, 4, 3))
    added[:, 1] = meanwhile[:, None] * rng.normal(0.0, 1.0, 3) * of_a_sensor
    made = synthetic(5, SAMPLES, turning_s=60.0, noise_nT=0.2, added=added)
    assert made.total_field is not None
    known = made.total_field - (0.0 if of_a_sensor else 1.0) * meanwhile
    state = linear_state(replace(made, total_field=known, quiet_field=known))
    chosen = looked_at(state, event("offset_while", time_s=600.0, until_s=900.0), once=True)
    assert OwnNoise(state.residual, None).p_value(chosen.terms) < 1e-6
    assert seen_alike_alone(chosen, state) is not of_a_sensor


def test_of_one_sensor_nothing_but_the_total_field_tells() -> None:
    rng = np.random.default_rng(6)
    added = np.zeros((SAMPLES, 1, 3))
    added[700:] = rng.normal(0.0, 1.0, 3)
    state = linear_state(synthetic(6, SAMPLES, sensors=1, noise_nT=0.2, added=added))
    chosen = looked_at(state, event("offset_step", time_s=700.0), once=True)
    assert chosen.adjusted_own_p < 1e-6
    assert not seen_alike_alone(chosen, state) and not within_the_noise_there(chosen, state)
