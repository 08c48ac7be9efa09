"""A scale factor that changes, with the offset or without it: all of the output is scaled, or the field in it alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import BASE, scenario, suspects, verdict_of

OFFSETS_NT = 3000.0
PPM = np.random.default_rng(51).uniform(20.0, 100.0, (4, 3)) * np.array([1.0, -1.0, 1.0])  # a degree, each axis


def scaled(of_field: bool) -> Callable[[Path], None]:
    """Add what a share of what passes each axis's amplifier makes of the outputs, in proportion to the temperature."""

    def change(path: Path) -> None:
        with h5py.File(path, "a") as file:
            warmer = file["temperature"][:] - file["temperature"][:].mean()
            outputs, offset = file["b_raw"], file["truth/offset"][:]
            driving = outputs[:] - offset if of_field else outputs[:]
            outputs[:] = outputs[:] + 1e-6 * PPM * warmer[:, None, None] * driving

    return change


@pytest.mark.long
@pytest.mark.parametrize("of_field", [False, True])
def test_a_scale_factor_takes_the_offset_with_it_or_not(of_field: bool, tmp_path: Path) -> None:
    instrument = BASE["instrument"] | {"errors": BASE["instrument"]["errors"] | {"bias_nT": OFFSETS_NT}}
    channels = {"temperature": BASE["channels"]["temperature"] | {"log_noise": 0.0}}
    survey = scenario(51, instrument=instrument, channels=channels)
    models = ["temperature_scale", "temperature_offset", "channel_response", "offset_drift"]
    told = verdict_of(tmp_path, survey, scaled(of_field), models)
    assert [a["error_model"] for a in told["adopted"]] == ["temperature_scale"], suspects(told)
    assert told["adopted"][0]["settings"]["of_field"] is of_field
    values = [c["value"] for c in told["adopted"][0]["coefficients"]]
    np.testing.assert_allclose(values, PPM.ravel(), atol=2.0)
    assert told["adopted"][0]["evidence"]["held_out_rms_after_nT"] < 1.1 * told["noise_floor_nT"]


def test_a_cubic_term_of_the_field(tmp_path: Path) -> None:
    def change(path: Path) -> None:
        with h5py.File(path, "a") as file:
            outputs, offset = file["b_raw"], file["truth/offset"][:]
            outputs[:] = outputs[:] + PPM / 5.0 * ((outputs[:] - offset) / 50000.0) ** 3

    instrument = BASE["instrument"] | {"errors": BASE["instrument"]["errors"] | {"bias_nT": OFFSETS_NT}}
    models = ["nonlinearity_cubic", "nonlinearity_quadratic", "cross_field", "hysteresis"]
    told = verdict_of(tmp_path, scenario(52, instrument=instrument), change, models)
    assert [a["error_model"] for a in told["adopted"]] == ["nonlinearity_cubic"], suspects(told)
    assert told["adopted"][0]["settings"]["of_field"]
