"""What a sensor remembers of where it was is told as following the field, also beside a model that takes a part."""

from __future__ import annotations

import numpy as np
from loop_cases import synthetic
from numpy.typing import NDArray

from magtensor.loop.fitting.model import Adopted, Fitting, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.remainder import predictable
from magtensor.registry import Registry


def played(values: NDArray[np.float64], half_width: float) -> NDArray[np.float64]:
    """A pin in a slot: it follows when the end of the slot is reached."""
    out = np.empty_like(values)
    at = values[0].copy()
    for row, value in enumerate(values):
        at = np.clip(at, value - half_width, value + half_width)
        out[row] = at
    return out


def beside_a_lag(added: NDArray[np.float64] | None) -> State:
    record = synthetic(11, 3000, noise_nT=0.15, turning_s=6.0, added=added)
    lags = Adopted(Registry.load().find("error_model", "bandwidth"), {"tau_s": 2.0})
    return joint_state(record, [lags], Fitting())


def test_the_rest_of_a_memory_beside_a_lag_is_told() -> None:
    field = synthetic(11, 3000, noise_nT=0.0, turning_s=6.0).raw
    share = np.random.default_rng(3).uniform(0.5, 1.5, field.shape[1:])
    state = beside_a_lag(1e-4 * share * (played(field, 4000.0) - field))
    assert predictable.predictable_from_direction(state) > 0.2  # nothing without the way it turns
    assert predictable.attitude_words(state)
    assert not predictable.attitude_words(beside_a_lag(None))
