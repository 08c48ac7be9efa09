"""A platform that stands still, with noise or without: little can be found, and nothing breaks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import synthetic

from magtensor.calibration.nominal import Nominal
from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.on_fewer_sensors import sensors_showing
from magtensor.loop.searching.search import search
from magtensor.registry import Registry

SAMPLES = 600


def still(seed: int, postures: int, noise_nT: float, sensors: int = 4) -> Record:
    """A survey in few postures, held by turns, in a field that moves by some nT; without noise, not even so."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((postures, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    total = 50_000.0 + 5.0 * (postures > 1 or noise_nT > 0.0) * np.sin(7.0 * np.arange(SAMPLES) / SAMPLES)
    total = total + 0.25 * noise_nT * rng.standard_normal(SAMPLES)
    field = direction[(np.arange(SAMPLES) * 6 // SAMPLES) % postures] * total[:, None]
    forward = np.eye(3) + 0.01 * rng.standard_normal((sensors, 3, 3))
    raw = np.einsum("sij,nj->nsi", forward, field) + 100.0 * rng.standard_normal((sensors, 3))
    raw += noise_nT * rng.standard_normal(raw.shape)
    return replace(synthetic(seed, SAMPLES, sensors), raw=raw, total_field=total, quiet_field=total)


def test_what_follows_a_field_that_does_not_turn_is_shown_by_no_sensor() -> None:
    """What it would add is next to nothing, and so is what is known of it beside what the other sensors would."""
    model = Registry.load().find("error_model", "viscous_magnetisation")
    settings = {"tau_s": 5.0, "at_start_x_nT": 0.0, "at_start_y_nT": 0.0, "at_start_z_nT": 0.0}
    for seed in range(12):
        state = joint_state(still(seed, 1, 0.2), [Adopted(model, settings)], Fitting(nominal=Nominal()))
        assert not sensors_showing(state, 0)


@pytest.mark.parametrize(("seed", "postures", "noise_nT", "sensors"), [(1, 1, 0.0, 6), (1, 3, 0.0, 3), (2, 1, 0.2, 4)])
def test_a_search_ends(seed: int, postures: int, noise_nT: float, sensors: int) -> None:
    models = [c for (kind, _, _), c in Registry.load().components.items() if kind == "error_model"]
    found = search(still(seed, postures, noise_nT, sensors), models, Fitting(nominal=Nominal()))
    assert found.last.adopted == ()
