"""Refinement by likelihood from a simulated file through `magtensor` to an applied calibration."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from magtensor.cli import status_of
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import read_plan
from magtensor.recipe.source import load_yaml
from magtensor.runner import run
from magtensor.simulate import Simulated, simulate, write
from magtensor.tensor.elements import five, full, rotation_of_five
from magtensor.tensor.refinement import nearest_in_gauge
from magtensor_stages.refine import _noise_covariance

RECIPES = Path(__file__).parents[2] / "recipes"
COMPONENTS = ("xx", "xy", "xz", "yy", "yz")


def scenario(name: str) -> dict:
    return load_yaml(RECIPES / "scenarios" / f"{name}.yaml").value


def magtensor(*arguments: object) -> int:
    return status_of([str(a) for a in arguments])


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def read(made: Simulated) -> np.ndarray:
    return np.stack([made.channels[f"gradient_{c}"][0] for c in COMPONENTS], axis=1)


@pytest.fixture(scope="module")
def surveys(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Simulated, Simulated]:
    """The paper's instrument turned 300 times 20 m above the dipole, and on the line."""
    folder = tmp_path_factory.mktemp("surveys")
    near = scenario("sui2017")
    near["field"]["dipoles"][0]["position_m"] = [0.0, 0.0, -20.0]
    near["motion"]["count"] = 300
    turned, line = simulate(near), simulate(scenario("sui2017_line"))
    write(turned, folder / "turned.h5")
    write(line, folder / "line.h5")
    return folder, turned, line


@pytest.mark.parametrize("recipe", ["sui2017_likelihood", "sui2017_constancy"])
def test_from_file_to_applied_calibration(surveys: tuple[Path, Simulated, Simulated], recipe: str) -> None:
    folder, turned, line = surveys
    out = folder / recipe
    known = recipe == "sui2017_likelihood"
    i1, i2 = -4.5 * 5.0**8, 3.5797280657408055 * 5.0**12  # the recipe's, 100 m to 20 m: gradients fall as r^-4
    sets = [f"stages.refine_invariants.invariant_{k}={v}" for k, v in ((1, i1), (2, i2))] if known else []
    options = [part for one in sets for part in ("--set", one)]
    source = ("--input", folder / "turned.h5", "--output", out, *options)
    assert magtensor("run", RECIPES / "papers" / f"{recipe}.yaml", *source) == 0
    assert magtensor("apply", out / "calibration.nc", folder / "line.h5", "--output", out / "line.nc") == 0

    assert turned.truth.gradiometers is not None
    true_matrix = np.linalg.inv(turned.truth.gradiometers.matrix)
    with xr.open_dataset(out / "result.nc", group="calibration", engine="h5netcdf") as calibration:
        matrix = calibration["tensor_matrix"].values
        facts = calibration["tensor_matrix"].attrs
        covariance = calibration["tensor_covariance"].values
        names = list(calibration["coefficient"].values)
    assert names[0] == "H_xx_xx" and names[-1] == "D_yz" and covariance.shape == (30, 30)
    words = json.loads(facts["verdict"])
    assert (int(facts["rank"]), int(facts["nullity"]), len(words)) == ((27, 3, 1) if known else (26, 4, 2))
    scale = 1.0 if known else abs(np.linalg.det(true_matrix) / np.linalg.det(matrix)) ** 0.2
    assert (abs(scale - 1) < 1e-9) == known
    turn = scale * rotation_of_five(nearest_in_gauge(matrix, true_matrix)[0])
    for name, made in (("result.nc", turned), ("line.nc", line)):
        with xr.open_dataset(out / name, group="calibrated", engine="h5netcdf", decode_times=False) as calibrated:
            tensor, std = calibrated["tensor"].values, calibrated["tensor_std"].values
            strength = calibrated["invariants"].values[:, 2], calibrated["invariants_std"].values[:, 2]
        error = full(five(tensor) @ turn.T) - made.truth.tensor
        true_strength = np.linalg.norm(made.truth.tensor, axis=(1, 2))
        small = true_strength < 2000  # where the turned deviations are those of the unturned components
        assert 0.8 < rms(error[small]) / rms(std[small]) < 1.25
        assert 0.8 < rms((scale * strength[0] - true_strength) / strength[1]) < 1.25
    before = rms(np.linalg.norm(full(read(line)), axis=(1, 2)) - true_strength)
    after = rms(scale * strength[0] - true_strength)
    assert after < 0.15 < 5 < before  # METHODS B3: 21.5 before and .082 after, for another instrument

    with xr.open_dataset(out / "result.nc", group="qc", engine="h5netcdf") as qc:
        told = dict(zip(qc["metric"].values.tolist(), qc["words"].values.tolist(), strict=True))
    assert ("scale of the corrected tensor is unidentified" in told["refinement_unidentified"]) == (not known)
    assert "refinement_unidentified" in (out / "report.html").read_text("utf-8")


def test_a_degenerate_file_is_refused_with_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    on_axis = scenario("sui2017")
    on_axis["motion"]["count"] = 60
    on_axis["field"]["dipoles"][0]["position_m"] = [-15.0, -15.0, 21.213203]
    write(simulate(on_axis), tmp_path / "s.h5")
    recipe = RECIPES / "papers" / "sui2017_constancy.yaml"
    assert magtensor("run", recipe, "--input", tmp_path / "s.h5", "--output", tmp_path / "out") == 3
    said = capsys.readouterr().err
    assert "axisymmetric" in said and "Traceback" not in said
    assert not (tmp_path / "out").exists()


def test_an_array_of_sensors_is_refined_with_the_noise_of_its_sensors(tmp_path: Path) -> None:
    """No linear correction of the five components, fitted to the truth itself, does much better."""
    scene = {
        "title": "a cross turned near a dipole",
        "seed": 3,
        "rate_Hz": 1.0,
        "instrument": {
            "seed": 4,
            "array": {"shape": "cross", "baseline_m": 0.5},
            "errors": {"scale": 0.01, "non_orthogonality_deg": 0.5, "misalignment_deg": 1.0, "bias_nT": 100.0},
            "noise": {"white_sd_nT": 0.05},
        },
        "motion": {"type": "random_attitudes", "count": 300},
        "field": {
            "earth": {"total_field_nT": 50000.0, "inclination_deg": 60.0},
            "dipoles": [{"position_m": [0.0, -25.0, -40.0], "moment_Am2": [250000.0, 250000.0, -353553.39]}],
        },
        "base_station": {"rate_Hz": 0.5, "noise_sd_nT": 0.0},
    }
    made = simulate(scene)
    write(replace(made, position=made.position * [1.3, 1.0, 1.0]), tmp_path / "s.h5")  # one arm is not what it is said
    recipe = tmp_path / "r.yaml"
    stages = ["load", "detrend_diurnal", "calibrate_joint: {robust: false}", "assemble_tensor"]
    refine = "refine_invariants: {method: orbit_likelihood}"
    errors = []
    for last in ([], [refine]):
        recipe.write_text("\n  - ".join(["title: t\nstages:", *stages, *last]) + "\n")
        plan = read_plan(recipe, survey=tmp_path / "s.h5")
        survey = run(plan, empty_survey(plan)).survey
        errors.append(_errors(five(survey.values("calibrated/tensor")), five(made.truth.tensor)))
    noise = _noise_covariance(survey)
    assert noise is not None and (np.linalg.eigvalsh(noise) > 0).all()
    (before, best_before), (after, best) = errors
    assert best == pytest.approx(best_before, rel=1e-6)  # H is linear
    assert after < 1.1 * best < 0.8 * before


def _errors(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Of tensors set right in frame and scale, which are open; and after the best affine map."""
    with_one = np.column_stack([found, np.ones(len(found))])
    best = np.linalg.lstsq(with_one, truth, rcond=None)[0]
    scale = abs(np.linalg.det(best[:5])) ** 0.2
    turn = scale * rotation_of_five(nearest_in_gauge(np.eye(5), best[:5].T / scale)[0])
    return rms(found @ turn.T - truth), rms(with_one @ best - truth)
