"""How much of what an output does an adopted model is: what sensors near nominal cannot have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import synthetic

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.contribution import share_of_the_field
from magtensor.registry import Registry


def test_a_coefficient_that_is_a_share_of_the_field_and_one_that_is_not() -> None:
    record = synthetic(31, turning_s=40.0)
    registry = Registry.load()
    viscous = Adopted(
        registry.find("error_model", "viscous_magnetisation"),
        {"tau_s": 1.0, "at_start_x_nT": 0.0, "at_start_y_nT": 0.0, "at_start_z_nT": 0.0},
    )
    drift = Adopted(registry.find("error_model", "offset_drift"), {"order": 1, "span_s": 1199.0})
    state = joint_state(record, [viscous, drift], Fitting())

    large = np.zeros(state.theta[0].shape)
    large[3] = -0.9e6  # ppm: a time of 0.9 s in disguise, and no iron
    assert share_of_the_field(replace(state, theta=(large, state.theta[1])), 0) == pytest.approx(0.9)
    small = share_of_the_field(replace(state, theta=(0.001 * large, state.theta[1])), 0)
    assert small == pytest.approx(0.0009)

    assert share_of_the_field(replace(state, theta=(large, 1e6 + state.theta[1])), 1) == 0.0, "these are nT"
