"""Sensors whose noise is a per cent of the field, as in a telephone: no regressor may hold the noise it explains."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from loop_cases import linear_state, scenario, survey_file, synthetic, verdict_of

import magtensor
from magtensor.loop.evidence.estimate import symmetric_eigen
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.contribution import eliminate, removal
from magtensor.registry import Registry

OF_THE_FIELD = ["hysteresis", "bandwidth", "viscous_magnetisation", "nonlinearity_cubic", "scale_step", "cross_field"]


@pytest.mark.parametrize(("sensors", "noise_nT"), [(1, 700.0), (1, 150.0), (3, 700.0)])
def test_clean_ones_are_not_accused(tmp_path: Path, sensors: int, noise_nT: float) -> None:
    """Quick turns between rests, 20 Hz: in the rests a play operator knows the noise best."""
    survey = scenario(21, rate_Hz=20.0)
    places = [[0.2, 0.0, 0.0], [-0.1, 0.2, 0.0], [-0.1, -0.2, 0.0]][:sensors]
    noise = {"white_sd_nT": noise_nT, "flicker_nT_per_rtHz": 0.0}
    survey["instrument"] = survey["instrument"] | {"array": {"positions_m": places}, "noise": noise}
    survey["motion"] = survey["motion"] | {"duration_s": 240.0, "rate_rms_deg_s": 30.0}
    told = verdict_of(tmp_path, survey, models=OF_THE_FIELD)
    assert told["adopted"] == []
    assert not told["unexplained"]["present"], told["unexplained"]


def test_models_see_the_field_at_the_length_that_is_known() -> None:
    record = synthetic(3, sensors=1, noise_nT=500.0)
    state = linear_state(record)
    assert record.total_field is not None
    np.testing.assert_allclose(np.linalg.norm(state.excitation.field[:, 0], axis=1), record.total_field, rtol=1e-12)


def test_a_single_model_that_raises_the_error_on_blocks_is_dropped() -> None:
    """A random channel in white noise: its twelve coefficients are fitted to noise."""
    clean = synthetic(4)
    pump = np.random.default_rng(8).standard_normal(len(clean.time))
    record = type(clean)(**{**vars(clean), "logged": {"pump": pump}, "units": {"pump": "A"}})
    model = Adopted(Registry.load().find("error_model", "channel_response"), {"channel": "pump"})
    state = joint_state(record, [model], Fitting())
    before, after = removal(state, 0)
    last, dropped = eliminate(record, state, Fitting(), 0)
    assert after > before
    assert dropped == ("channel_response",) and len(last.adopted) == 0


def test_a_matrix_that_lapack_gives_up_on(monkeypatch: pytest.MonkeyPatch) -> None:
    real = np.linalg.eigh

    def eigh(m: np.ndarray, UPLO: str = "L") -> object:
        if UPLO == "L":
            raise np.linalg.LinAlgError("Eigenvalues did not converge")
        return real(m, UPLO)

    half = np.random.default_rng(1).standard_normal((5, 4, 4))
    matrices = half @ half.transpose(0, 2, 1)
    expected = real(matrices)[0]
    monkeypatch.setattr(np.linalg, "eigh", eigh)
    np.testing.assert_allclose(symmetric_eigen(matrices)[0], expected)


def test_a_recording_faster_than_its_sensor(tmp_path: Path) -> None:
    """Readings at 20 Hz, filled in to 60 Hz by straight lines: the noise has a colour, and every regressor holds it."""
    survey = scenario(23, rate_Hz=20.0)
    noise = {"white_sd_nT": 700.0, "flicker_nT_per_rtHz": 0.0}
    survey["instrument"] = survey["instrument"] | {"array": {"positions_m": [[0.0, 0.0, 0.0]]}, "noise": noise}
    survey["motion"] = survey["motion"] | {"duration_s": 120.0, "rate_rms_deg_s": 30.0}
    groups = dict(xr.open_groups(survey_file(tmp_path, survey), decode_times=False))
    time = groups["/"]["time"]
    rows = np.linspace(0, len(time) - 1, 3 * (len(time) - 1) + 1)
    between = xr.DataArray(np.interp(rows, np.arange(len(time)), time.values), dims="time", attrs=time.attrs)
    groups["/"] = groups["/"][["b_raw"]].interp(time=between)
    groups["/"]["b_raw"].attrs["units"] = "nT"
    done = magtensor.close_loop({name: groups[name] for name in ("/", "/reference")}, search=OF_THE_FIELD)
    assert done.verdict["adopted"] == []
    assert done.verdict["noise_floor_nT"] == pytest.approx(700.0, rel=0.1)
