"""Error models declared beside C and o: the joint covariance of everything, and what it does to another survey."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from joint_cases import Array, Drawn, directions, drawn

from magtensor.applying import apply_to
from magtensor.calibration.joint import calibrated, fit_joint, nearest_frame
from magtensor.cli import status_of
from magtensor.components import component_of
from magtensor.effect_errors import COVARIANCE, WithCoefficients, with_coefficients
from magtensor.loop.fitting.model import Adopted, Fitting, State
from magtensor.loop.fitting.record import record_of
from magtensor.loop.fitting.refit import joint_state
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import read_plan
from magtensor.session import compute
from magtensor.survey.model import Survey, without_variables
from magtensor_effects import reference, temperature

NOISE_NT, PER_DEGREE = 0.5, 2.0
RECIPE = """
title: t
survey: a.h5
stages:
  - load
  - detrend_diurnal
  - calibrate_joint: {error_models: {temperature_offset: {}}}
  - assemble_tensor
"""
POSITION = 0.25 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0.0]])


def warmed(seed: int, count: int, sensors: int = 4, tilt_deg: float | None = 40.0) -> tuple[Drawn, Array, Array]:
    """A survey whose offsets follow a drifting, wandering temperature (N,) by coefficients (S, 3) nT/degC."""
    survey = drawn(seed, count, sensors=sensors, tilt_deg=tilt_deg, noise_nT=NOISE_NT)
    rng = np.random.default_rng(seed + 90_000)
    time = np.arange(count) / count
    degrees = 20.0 + 5.0 * time + np.sin(9.0 * time + rng.uniform(0, 6))
    per_degree = PER_DEGREE * rng.standard_normal((sensors, 3))
    survey.raw[:] += per_degree * (degrees - degrees.mean())[:, None, None]
    return survey, degrees, per_degree


def fitted(survey: Drawn, degrees: Array, *models: object) -> State:
    count, sensors = survey.raw.shape[:2]
    held = Survey.build(
        {
            "time": (("time",), np.arange(count) * 1.0, {"units": "seconds since 2026-01-01T00:00:00Z"}),
            "sensor": (("sensor",), np.array([f"S{k}" for k in range(sensors)]), {}),
            "axis": (("axis",), np.array(list("xyz")), {}),
            "b_raw": (("time", "sensor", "axis"), survey.raw, {"units": "nT"}),
            "total_field": (("time",), survey.total_field, {"units": "nT"}),
            "temperature": (("time",), degrees, {"units": "degC"}),
        }
    )
    adopted = [Adopted(found, {}) for m in models if (found := component_of(m)) is not None]
    return joint_state(record_of(held), adopted, Fitting(worst_error=1.0, searching=False))


def error_of(found: WithCoefficients, survey: Drawn, theta: Array) -> Array:
    matrix = np.linalg.inv(survey.forward @ nearest_frame(survey.forward))
    off = [(a - b).ravel() for a, b in zip(found.calibration.matrix, matrix, strict=True)]
    shift = found.calibration.offset - survey.offset
    own = np.concatenate([np.concatenate([m, o]) for m, o in zip(off, shift, strict=True)])
    return np.concatenate([own, found.values - theta])


@pytest.mark.parametrize(("sensors", "count"), [(4, 600), pytest.param(1, 800, marks=pytest.mark.long)])
def test_joint_covariance_is_that_of_the_errors(sensors: int, count: int) -> None:
    pooled, squares = [], []
    for seed in range(40):
        survey, degrees, per_degree = warmed(seed, count, sensors)
        found = with_coefficients(fitted(survey, degrees, temperature.temperature_offset))
        error = error_of(found, survey, per_degree.ravel())
        std = np.sqrt(np.diag(found.covariance))
        values, vectors = np.linalg.eigh(found.covariance / np.outer(std, std))
        seen = values > 1e-9 * values[-1]
        assert seen.sum() == 15 * sensors - 3 and found.open == 0
        pooled.append(error / std)
        squares.append(np.sum((vectors[:, seen].T @ pooled[-1]) ** 2 / values[seen]) / seen.sum())
    assert np.mean(np.square(pooled)) == pytest.approx(1.0, abs=0.25)
    assert 0.91 < np.mean(np.abs(pooled) < 1.96) < 0.985
    # the noise is found from the data, and its colour: a few per cent
    assert np.mean(squares) == pytest.approx(1.0, abs=0.15)


def test_slope_of_c_and_o_is_that_of_refits() -> None:
    """A tenth of a unit more of a coefficient, taken off the outputs by hand."""
    survey, degrees, _ = warmed(3, 500)
    state = fitted(survey, degrees, temperature.temperature_scale, reference.reference_scale)
    each = [a.terms(state.excitation) for a in state.adopted]
    found = with_coefficients(state)
    slope = found.covariance[:48, 48:] @ np.linalg.inv(found.covariance[48:, 48:])
    noise = state.fit.plane.noise.reshape(4, 3)

    def refitted(theta: Array) -> Array:
        parts = np.split(theta, [each[0].count])
        taken = sum(e.contribution(t, 12).reshape(-1, 4, 3) for e, t in zip(each, parts, strict=True))
        field = survey.total_field - sum(e.on_reference(t) for e, t in zip(each, parts, strict=True))
        fit = calibrated(fit_joint(survey.raw - taken, field, noise=noise, keep=np.asarray(state.fit.keep)))
        return np.concatenate([np.concatenate([m.ravel(), o]) for m, o in zip(fit.matrix, fit.offset, strict=True)])

    at, count = found.values, len(found.values)
    scale = np.tile([1.0] * 9 + [50_000.0] * 3, 4)
    for k in range(count):
        step = np.eye(count)[k] * (10.0 if k < 12 else 1e-3)
        numeric = (refitted(at + step) - refitted(at - step)) / (2 * np.linalg.norm(step))
        wrong = np.abs(slope[:, k] - numeric) / scale
        # the slope is that of a fit without noise, and noise is a hundredth of what a unit here does
        assert wrong.max() < 0.02 * np.abs(numeric / scale).max() + 1e-12


def written(path: Path, survey: Drawn, degrees: Array) -> None:
    time, epoch = np.arange(len(degrees)) * 1.0, "seconds since 2026-01-01T00:00:00Z"
    with h5py.File(path, "w") as file:
        for name, values, units in (
            ("time", time, epoch), ("b_raw", survey.raw, "nT"), ("position", POSITION, "m"),
            ("temperature", degrees, "degC"),
            ("reference/time", time, epoch), ("reference/total_field", survey.total_field, "nT"),
        ):  # fmt: skip
            file[name] = values
            file[name].attrs["units"] = units


def test_from_files_to_a_colder_survey(tmp_path: Path) -> None:
    """Thirty degrees away from the calibration, the coefficients' errors are most of the tensor's."""
    recipe = tmp_path / "r.yaml"
    recipe.write_text(RECIPE)
    squares, alone = [], []
    for seed in range(12):
        survey, degrees, per_degree = warmed(seed, 500)
        written(tmp_path / "a.h5", survey, degrees)
        rng = np.random.default_rng(500 + seed)
        field = 50_000.0 * directions(rng, 200, 40.0)
        cold = np.linspace(-12.0, -8.0, 200)
        raw = np.einsum("sij,nj->nsi", survey.forward, field) + survey.offset
        raw += per_degree * (cold - degrees.mean())[:, None, None]
        raw += NOISE_NT * rng.standard_normal(raw.shape)
        written(tmp_path / "b.h5", Drawn(survey.forward, survey.offset, field, np.full(200, 50_000.0), raw), cold)
        planned = read_plan(recipe)
        done = compute(planned, empty_survey(planned))
        assert done.outcome["declared"] == ["linear", "temperature_offset"]
        names = done.survey.values("calibration/joint_parameter")
        assert names[-1] == "temperature_offset:S4:z" and len(names) == 60
        for stored, into in ((done.survey, squares), (without_variables(done.survey, COVARIANCE), alone)):
            found = apply_to(stored, tmp_path / "b.h5", planned)
            into.append(np.mean((found.values("calibrated/tensor") / found.values("calibrated/tensor_std")) ** 2))
    # the true tensor is zero; the errors of one calibration are shared by all samples: five components a survey
    assert np.mean(squares) == pytest.approx(1.0, abs=3.5 * np.sqrt(2.0 / 60))
    assert np.mean(alone) > 1.4


def test_the_joint_covariance_is_stored(tmp_path: Path) -> None:
    survey, degrees, _ = warmed(2, 300)
    written(tmp_path / "a.h5", survey, degrees)
    recipe = tmp_path / "r.yaml"
    recipe.write_text(RECIPE)
    assert status_of(["run", str(recipe), "--output", str(tmp_path / "out")]) == 0
    with xr.open_datatree(tmp_path / "out/calibration.nc", engine="h5netcdf", decode_times=False) as tree:
        joint = tree[COVARIANCE].values
        np.testing.assert_array_equal(joint[:48, :48], tree["calibration/covariance"].values)
    assert joint.shape == (60, 60) and (np.diag(joint)[48:] > 0).all()
    assert status_of(["apply", str(tmp_path / "out/calibration.nc"), str(tmp_path / "a.h5")]) == 0


@pytest.mark.parametrize(
    ("joint", "status", "said"),
    [
        ("{error_models: [current_field]}", 3, "needs current_*"),
        ("{error_models: [temperature_ofset]}", 2, "did you mean temperature_offset"),
        ("{error_models: [temperature_offset], matrices: linear}", 2, "needs further surveys"),
        ("{error_models: [reference_scale], total_field: constant}", 3, "no measured total field"),
        ("{error_models: [latent_source]}", 3, "needs waveform"),
    ],
)
def test_mistakes(tmp_path: Path, capsys: pytest.CaptureFixture[str], joint: str, status: int, said: str) -> None:
    survey, degrees, _ = warmed(1, 200)
    written(tmp_path / "a.h5", survey, degrees)
    recipe = tmp_path / "r.yaml"
    recipe.write_text(f"title: t\nsurvey: a.h5\nstages: [load, detrend_diurnal, calibrate_joint: {joint}]\n")
    assert status_of(["run", str(recipe), "--output", str(tmp_path / "out")]) == status
    assert said in capsys.readouterr().err
