"""A scale factor that changes, with the offset or without it: all of the output is scaled, or the field in it alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import BASE, loaded, scenario, suspects, verdict_of

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.adopting import polished
from magtensor.registry import Registry

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


@pytest.mark.long
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


def test_the_form_is_asked_again_when_what_is_beside_it_has_moved(tmp_path: Path) -> None:
    """Iron with too short a time constant leaves so much that its wrong form seems to suit the scale factor."""
    effects: list[dict[str, Any]] = [
        {"type": "temperature_scale", "rms_nT": 10.0, "lag_s": 12.0},  # simulated of the field
        {"type": "viscous_magnetisation", "rms_nT": 10.0, "tau_s": 5.0},
    ]
    survey = scenario(51, *effects, rate_Hz=4.0, motion=BASE["motion"] | {"duration_s": 450.0})
    survey["instrument"]["errors"]["bias_nT"] = 1500.0
    record = loaded(tmp_path, survey)
    settings = {
        "temperature_scale": {"channel": "temperature", "lag_s": 10.0, "of_field": False},
        "viscous_magnetisation": {"tau_s": 3.0},
    }
    registry, models = Registry.load(), []
    for name, given in settings.items():
        component = registry.find("error_model", name)
        plain = {n: p.default for n, p in component.parameters.items()}
        models.append(Adopted(component, plain | given, tuple(record.sensors)))
    how = Fitting()
    state = polished(record, joint_state(record, models, how), how)
    scale, iron = state.adopted
    assert scale.settings["of_field"]
    assert scale.settings["lag_s"] == pytest.approx(12.0, abs=1.5)
    assert iron.settings["tau_s"] == pytest.approx(5.0, rel=0.02)
