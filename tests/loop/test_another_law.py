"""What has a law that no error model has is told, and is not called what resembles it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import adopted_names, scenario, verdict_of

MODELS = ["viscous_magnetisation", "latent_source", "eddy_current", "scale_drift", "offset_drift", "hysteresis"]


def magnetised(path: Path) -> None:
    """Iron that takes on the mean of all fields that it has seen, the more the longer it lies in them."""
    with h5py.File(path, "a") as file:
        time, field = file["time"][:], file["truth/b_true"][:, 0]
        grown = np.log1p((time - time[0]) / 10.0)[:, None]
        seen = np.cumsum(field, axis=0) / np.arange(1, len(field) + 1)[:, None] * grown
        coupling = 2e-5 * np.random.default_rng(5).standard_normal((file["b_raw"].shape[1], 3, 3))
        file["b_raw"][:] = file["b_raw"][:] + np.einsum("sij,nj->nsi", coupling, seen)
        del file["truth"]


@pytest.mark.long
@pytest.mark.parametrize("seed", [92, 93])
def test_iron_that_is_magnetised_is_not_slow_iron(seed: int, tmp_path: Path) -> None:
    motion = {"type": "tumbling", "duration_s": 150.0, "rate_rms_deg_s": 25.0, "rate_time_s": 3.0}
    survey = scenario(seed, motion=motion, rate_Hz=10.0, truth=True)
    told = verdict_of(tmp_path, survey, magnetised, MODELS)
    assert not adopted_names(told) & {"viscous_magnetisation", "latent_source"}
    assert told["unexplained"]["present"] and told["unexplained"]["excess_rms_nT"] > 0.1
