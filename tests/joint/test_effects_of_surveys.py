"""`calibrate_joint: {error_models: ...}` from files to files: further surveys, an unknown field, an attitude."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from joint_cases import Array, array

from magtensor.applying import apply_to
from magtensor.cli import status_of
from magtensor.effect_errors import COVARIANCE
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import read_plan
from magtensor.session import compute
from magtensor.survey.model import Survey, without_variables

NOISE_NT, PER_DEGREE_NT, SAMPLES = 0.5, 2.0, 400
POSITION = 0.25 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0.0]])
WORLD_NT = 48_500.0 * np.array([0.36, 0.0, np.sqrt(1 - 0.36**2)])
WORLD = f"reference: {{world_field: {{value: {WORLD_NT.tolist()}, units: nT}}}}"


class Bench:
    """An array whose offsets follow its temperature, by coefficients (S, 3) nT/degC."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.forward, self.offset = array(self.rng, 4)
        self.per_degree = PER_DEGREE_NT * self.rng.standard_normal((4, 3))
        # the sensitivity is nominal, as is assumed where no total field tells it
        self.forward /= np.exp(np.mean(np.linalg.slogdet(self.forward)[1]) / 3)

    def written(
        self, path: Path, degrees: Array, *, size: float = 1.0, reference: bool = False, date: str = "2026-01-01"
    ) -> None:
        """A survey at temperatures (N,), whose attitude is known to 0.2 deg, in a field of so many times the usual."""
        count = len(degrees)
        q = np.cumsum(0.1 * self.rng.standard_normal((count, 4)), axis=0) + self.rng.standard_normal(4)
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        field = size * in_platform(q, WORLD_NT)
        raw = np.einsum("sij,nj->nsi", self.forward, field) + self.offset
        raw += self.per_degree * (degrees - 20.0)[:, None, None]
        raw += NOISE_NT * self.rng.standard_normal(raw.shape)
        measured = q + np.radians(0.1) * self.rng.standard_normal(q.shape)
        epoch = f"seconds since {date}T00:00:00Z"
        time = (np.arange(count) * 1.0, epoch)
        content = {"time": time, "b_raw": (raw, "nT"), "position": (POSITION, "m"), "temperature": (degrees, "degC")}
        content["attitude"] = (measured / np.linalg.norm(measured, axis=1, keepdims=True), "1")
        if reference:
            total = np.full(count, size * np.linalg.norm(WORLD_NT))
            content |= {"reference/time": time, "reference/total_field": (total, "nT")}
        with h5py.File(path, "w") as file:
            for name, (values, units) in content.items():
                file[name] = values
                file[name].attrs["units"] = units


def in_platform(q: Array, vector: Array) -> Array:
    """(N, 3): a vector of the world turned by the inverse of quaternions (N, 4), scalar last."""
    axis, scalar = -q[:, :3], q[:, 3:]
    once = np.cross(axis, vector)
    out: Array = vector + 2.0 * (scalar * once + np.cross(axis, once))
    return out


def course(seed: int, middle: float) -> Array:
    time = np.linspace(0.0, 1.0, SAMPLES)
    return middle + 5.0 * time + np.sin(9.0 * time + seed)


def recipe(folder: Path, survey: str, stages: str) -> Path:
    path = folder / "r.yaml"
    path.write_text(f"title: t\nsurvey: {{file: a.h5{survey}}}\nstages: [load, {stages}]\n")
    return path


def computed(path: Path) -> Survey:
    planned = read_plan(path)
    return compute(planned, empty_survey(planned)).survey


CASES = {
    "surveys": (", with: b.h5", "detrend_diurnal, calibrate_joint: {%s, offsets: common}"),
    "unknown fields": (", with: b.h5", "calibrate_joint: {%s, offsets: common, total_field: per_survey}"),
    "attitude": (f", {WORLD}", "calibrate_joint: {%s, vector_reference: true}"),
}


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_on_a_colder_survey(tmp_path: Path, case: str) -> None:
    """Thirty degrees away the effect is taken off, and the coefficients' errors are most of the tensor's."""
    survey, stages = CASES[case]
    joint = stages % "error_models: {temperature_offset: {}}"
    squares, alone = [], []
    for seed in range(8):
        bench = Bench(seed)
        bench.written(tmp_path / "a.h5", course(seed, 20.0), reference=True)
        size = 1.004 if case == "unknown fields" else 1.0
        bench.written(tmp_path / "b.h5", course(seed + 3, 23.0), size=size, reference=True, date="2026-02-01")
        bench.written(tmp_path / "c.h5", np.linspace(-12.0, -8.0, 200), reference=True, date="2026-03-01")
        path = recipe(tmp_path, survey, f"{joint}, assemble_tensor")
        done = computed(path)
        assert done.values("calibration/joint_parameter")[-1] == "temperature_offset:S4:z"
        for stored, into in ((done, squares), (without_variables(done, COVARIANCE), alone)):
            found = apply_to(stored, tmp_path / "c.h5", read_plan(path))
            into.append(np.mean((found.values("calibrated/tensor") / found.values("calibrated/tensor_std")) ** 2))
    # the true tensor is zero; the errors of one calibration are shared by all samples: five components a survey
    assert np.mean(squares) == pytest.approx(1.0, abs=3.5 * np.sqrt(2.0 / 40))
    assert np.mean(alone) > 1.25 * np.mean(squares)


def test_what_is_stored(tmp_path: Path) -> None:
    """Own offsets, and those for a survey that was not in the fit: the joint covariance goes with the calibration's."""
    bench = Bench(1)
    bench.written(tmp_path / "a.h5", course(1, 20.0), reference=True)
    bench.offset += 20.0 * bench.rng.standard_normal(bench.offset.shape)
    bench.written(tmp_path / "b.h5", np.full(SAMPLES, 26.0), reference=True, date="2026-02-01")
    for offset_of in ("this", "mean"):
        joint = f"calibrate_joint: {{error_models: [temperature_offset], offset_of: {offset_of}}}"
        path = recipe(tmp_path, ", with: b.h5", f"detrend_diurnal, {joint}, assemble_tensor, qc")
        assert status_of(["run", str(path), "--output", str(tmp_path / offset_of)]) == 0
        file = tmp_path / offset_of / "calibration.nc"
        with xr.open_datatree(file, engine="h5netcdf", decode_times=False) as tree:
            joint_covariance, own = tree[COVARIANCE].values, tree["calibration/covariance"].values
            np.testing.assert_array_equal(joint_covariance[:48, :48], own)
            off = tree["calibration/joint_parameter"].attrs["value_of_coefficients"][48:] - bench.per_degree.ravel()
            assert np.abs(off / np.sqrt(np.diag(joint_covariance)[48:])).max() < 4.5
            assert tree["calibration/survey_offset"].shape == (2, 4, 3)
            first = tree["calibration/survey_covariance"].values[:36, :36]
            at = np.concatenate([12 * s + np.arange(9) for s in range(4)])
            np.testing.assert_allclose(first, own[np.ix_(at, at)], rtol=1e-6, atol=1e-14)
        assert status_of(["apply", str(file), str(tmp_path / "b.h5"), "--output", str(tmp_path / "b.nc")]) == 0


@pytest.mark.parametrize(
    ("survey", "joint", "status", "said"),
    [
        (", with: b.h5", "{error_models: [temperature_offset], matrices: linear}", 2, "together with matrices"),
        (", with: b.h5", "{error_models: [temperature_offset], offsets: linear}", 2, "together with offsets"),
        (", with: b.h5", "{error_models: [periodic_interference]}", 3, "a phase of its own in every survey"),
        (", with: b.h5", "{error_models: [reference_scale], total_field: constant}", 3, "no measured total field"),
        (f", {WORLD}", "{error_models: [latent_source], vector_reference: true}", 3, "needs waveform"),
        (", with: c.h5", "{error_models: [temperature_offset]}", 3, "c.h5: the error model temperature_offset needs"),
    ],
)
def test_mistakes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], survey: str, joint: str, status: int, said: str
) -> None:
    bench = Bench(2)
    for name, date in (("a", "2026-01-01"), ("b", "2026-02-01"), ("c", "2026-03-01")):
        bench.written(tmp_path / f"{name}.h5", course(2, 20.0), reference=True, date=date)
    with h5py.File(tmp_path / "c.h5", "r+") as file:
        del file["temperature"]
    path = recipe(tmp_path, survey, f"detrend_diurnal, calibrate_joint: {joint}")
    assert status_of(["run", str(path), "--output", str(tmp_path / "out")]) == status
    assert said in capsys.readouterr().err


def test_a_jump_is_one_of_the_time_in_all_surveys(tmp_path: Path) -> None:
    """In the second survey the first one's jump has happened: with common offsets both tell of it."""
    bench = Bench(3)
    jump = 30.0 * bench.rng.standard_normal((4, 3))
    bench.per_degree = jump
    bench.written(tmp_path / "a.h5", 20.0 + 1.0 * (np.arange(SAMPLES) >= 390), reference=True)
    bench.written(tmp_path / "b.h5", np.full(SAMPLES, 21.0), reference=True, date="2026-02-01")
    step = "error_models: {offset_step: {time_s: 389.5}}"
    stds = []
    for survey, joint in ((", with: b.h5", f"{{{step}, offsets: common}}"), ("", f"{{{step}}}")):
        done = computed(recipe(tmp_path, survey, f"detrend_diurnal, calibrate_joint: {joint}"))
        values = done["calibration/joint_parameter"].attrs["value_of_coefficients"][48:]
        stds.append(np.sqrt(np.diag(done.values(COVARIANCE))[48:]))
        assert np.abs((values - jump.ravel()) / stds[-1]).max() < 4.5
    assert (stds[0] < 0.8 * stds[1]).all()  # alone, ten samples tell of it
