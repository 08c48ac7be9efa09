"""Samples that an effect made look wrong before it had a name are believed once it has one, if they fit with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, synthetic
from scipy.spatial.transform import Rotation

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state, settled
from magtensor.registry import Registry

SAMPLES = 2000
TAU_S = 2.0
FINE = 20  # steps of the memory's equation to a sample
TURN = 1000  # a quick turn begins here


def turned_once(seed: int) -> Array:
    """(N, 3) nT, a field whose direction wanders slowly, but for one quick turn."""
    rng = np.random.default_rng(seed)
    bell = np.exp(-0.5 * (np.arange(-160, 161) / 40.0) ** 2)
    slow = np.column_stack([np.convolve(rng.standard_normal(SAMPLES + 320), bell, mode="valid") for _ in range(3)])
    angle = np.clip((np.arange(SAMPLES) - TURN) / 2.0, 0.0, 1.0) * 2.8
    turn = Rotation.from_rotvec(np.multiply.outer(angle, [0.6, 0.0, 0.8]))
    return np.asarray(turn.apply(slow / np.linalg.norm(slow, axis=1, keepdims=True)) * 50_000.0)


def remembered(field: Array) -> Array:
    """(N, ...) what follows a field with a time constant, stepped through in time, one sample a second."""
    out = np.empty_like(field)
    out[0] = now = field[0].copy()
    for i in range(1, len(field)):
        for k in range(FINE):
            now = now + (field[i - 1] + (field[i] - field[i - 1]) * (k + 0.5) / FINE - now) / FINE / TAU_S
        out[i] = now
    return out


@pytest.mark.parametrize("seed", range(3))
def test_a_quick_turn_is_believed_and_a_spike_is_not(seed: int) -> None:
    field = turned_once(seed)
    rng = np.random.default_rng(seed + 50)
    forward = np.eye(3) + 0.01 * rng.standard_normal((4, 3, 3))
    iron = 1e-4 * rng.uniform(0.5, 1.5, (4, 1, 1)) * (np.eye(3) + 0.3 * rng.standard_normal((4, 3, 3)))
    raw = np.einsum("sij,nj->nsi", forward, field) + np.einsum("sij,nj->nsi", iron, remembered(field))
    raw += 0.15 * rng.standard_normal(raw.shape)
    raw[600, 2] += [80.0, -60.0, 50.0]
    total = np.full(SAMPLES, 50_000.0)
    record = replace(synthetic(seed, SAMPLES), raw=raw, total_field=total, quiet_field=total)
    model = Adopted(Registry.load().find("error_model", "viscous_magnetisation"), {"tau_s": TAU_S})
    found = joint_state(record, [model], replace(Fitting(), searching=True))
    last = settled(record, found, Fitting())
    assert np.flatnonzero(~np.asarray(last.fit.keep)).tolist() == [600]
    assert last.residual.square() < 1.1
