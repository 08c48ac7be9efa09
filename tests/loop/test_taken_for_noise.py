"""A slow effect that is far larger than the noise, fitted from nothing: until some of it is taken off it looks like
slow noise of the sensor, and in noise like that hardly any of it would be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import synthetic

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.registry import Registry

POSTURES, ROWS, NOISE_NT, SIZE_NT = 100, 22, 0.2, 4.0


@pytest.mark.parametrize("sensors", [1, 4])
@pytest.mark.parametrize(("seed", "when"), [(3, 0.5), (4, 0.7), (0, 0.5)])
def test_a_declared_effect_is_fitted_in_full(seed: int, when: float, sensors: int) -> None:
    """Rows at rest in many postures, and a channel that goes from one level to another in the course of the survey."""
    rng = np.random.default_rng(seed)
    count = POSTURES * ROWS
    time = np.arange(float(count))
    level = np.tanh((time / count - when) / 0.15)
    level = (level - level.mean()) / level.std()
    true = rng.standard_normal((sensors, 3))
    true *= SIZE_NT / np.linalg.norm(true, axis=1, keepdims=True)
    at_rest = synthetic(seed, POSTURES, sensors, noise_nT=0.0)
    raw = np.repeat(at_rest.raw, ROWS, axis=0) + level[:, None, None] * true
    raw += NOISE_NT * rng.standard_normal(raw.shape)
    total = np.repeat(at_rest.total_field, ROWS) if at_rest.total_field is not None else None
    none = np.zeros(count, dtype=int)
    record = replace(
        at_rest, time=time, raw=raw, total_field=total, quiet_field=total, run=none, segment=none,
        samples=np.arange(count), logged={"level": level}, units={"level": "1"},
    )  # fmt: skip
    component = Registry.load().find("error_model", "channel_response")
    settings = {name: p.default for name, p in component.parameters.items()} | {"channel": "level"}
    state = joint_state(record, [Adopted(component, settings, record.sensors)], Fitting())
    np.testing.assert_allclose(state.theta[0], true.ravel(), atol=0.08)  # eight standard errors of a mean
    assert state.residual.noise.max() < 1.2 * NOISE_NT
