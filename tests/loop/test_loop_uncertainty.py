"""What the loop does not know of the coefficients it adopts, and where that goes."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import scenario, survey_file

import magtensor
from magtensor.applying import apply_to
from magtensor.effect_errors import COVARIANCE
from magtensor.loop.evidence.estimate import Estimate
from magtensor.loop.fitting.refit import without_noise
from magtensor.result import open_result
from magtensor.survey.model import without_variables


@pytest.mark.long
def test_errors_of_the_coefficients_go_with_the_calibration(tmp_path: Path) -> None:
    """Far from the mean of the calibration's current, its coefficients' errors are part of the tensor's."""
    effects = (
        {"type": "current_field", "rms_nT": 3.0, "channel": "current_heater"},
        {"type": "site_gradient", "rms_nT": 1.0},
    )
    changes = {"logging": {"attitude": True}, "motion": scenario()["motion"] | {"duration_s": 300.0}}
    survey = survey_file(tmp_path, scenario(5, *effects, **changes))
    found = magtensor.close_loop(survey, search=["current_field", "site_gradient"])
    assert {a["error_model"] for a in found.verdict["adopted"]} == {"current_field", "site_gradient"}
    found.save(tmp_path / "out")
    stored = open_result(tmp_path / "out" / "calibration.nc")
    names = [str(n) for n in stored.values("calibration/joint_parameter")]
    std = dict(zip(names, np.sqrt(np.diag(stored.values(COVARIANCE))), strict=True))
    told = {
        (a["error_model"], c["sensor"], c["name"]): c["std"]
        for a in found.verdict["adopted"]
        for c in a["coefficients"]
    }
    assert len(std) == 48 + len(told)
    for (model, sensor, name), value in told.items():
        assert std[":".join(p for p in (model, sensor, name) if p)] == value

    current = next(a for a in found.verdict["adopted"] if a["error_model"] == "current_field")
    per_ampere = np.array([c["value"] for c in current["coefficients"]]).reshape(4, 3)

    # a site is left behind with the place: another survey need not log what it follows
    second = survey_file(tmp_path, scenario(6, effects[0], **changes), "other.h5")
    with h5py.File(second, "r+") as file:
        del file["attitude"]
        file["current_heater"][:] = file["current_heater"][:] + 100.0
        file["b_raw"][:] = file["b_raw"][:] + 100.0 * per_ampere  # or its own lengths would refute the effect
    planned = found.computed.planned
    with_errors, without = (
        apply_to(given, second, planned).values("calibrated/tensor_std")
        for given in (stored, without_variables(stored, COVARIANCE))
    )
    assert np.isfinite(with_errors).all()
    assert (with_errors > 1.2 * without).any() and (with_errors >= 0.999 * without).all()


@pytest.mark.parametrize(("common", "stays"), [(4.8, False), (100.0, True)])
def test_what_the_data_hardly_show_stays_zero_until_it_is_significant(common: float, stays: bool) -> None:
    # drifts of four clocks: what they have in common is a turn of the field, seen in the second order only
    ones = np.full((4, 4), 0.25)
    normal = 2500.0 * (np.eye(4) - ones) + 0.018 * ones  # standard deviation of the mean: 3.7
    apart = np.array([2.4, 2.4, 2.4, -7.2])
    estimate = Estimate(apart + common, np.linalg.inv(normal), normal, 4)
    found = without_noise(apart + common, estimate)
    np.testing.assert_allclose(found, apart + common if stays else apart, atol=1e-9)
