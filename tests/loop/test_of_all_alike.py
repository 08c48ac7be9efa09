"""What all sensors show alike: nothing but another reference would tell it from a drift of the base station."""

from __future__ import annotations

import numpy as np
import pytest
from loop_cases import synthetic

from magtensor.loop.contribution import of_all_alike
from magtensor.loop.model import Adopted, Fitting, joint_state
from magtensor.registry import Registry


@pytest.mark.parametrize(("sensors", "alike"), [((0, 1, 2, 3), True), ((1,), False), ((0, 1, 2), False)])
def test_scale_factors_that_drift_together_and_apart(sensors: tuple[int, ...], alike: bool) -> None:
    field = synthetic(21, turning_s=4.0).raw
    added = np.zeros_like(field)
    for number in sensors:  # 100 ppm: 5 nT
        added[:, number] = 1e-4 * np.linspace(-1.0, 1.0, len(field))[:, None] * (field[:, number] - field.mean((0, 1)))
    record = synthetic(21, turning_s=4.0, added=added)
    model = Adopted(Registry.load().find("error_model", "scale_drift"), {"order": 1, "span_s": 1199.0})
    state = joint_state(record, [model], Fitting())
    assert of_all_alike(state, 0) is alike


def test_one_offset_of_all_sensors_is_a_field_that_drifts() -> None:
    added = np.zeros((1200, 4, 3))
    added += np.linspace(-2.0, 2.0, 1200)[:, None, None]
    record = synthetic(22, turning_s=4.0, added=added)
    model = Adopted(Registry.load().find("error_model", "offset_drift"), {"order": 1, "span_s": 1199.0})
    state = joint_state(record, [model], Fitting())
    own = joint_state(record, [], Fitting())
    assert state.residual.square() < own.residual.square()
    assert of_all_alike(state, 0)
