"""From simulated files to a tensor in a gradient: the common rotation fixed by a recipe, refined by `apply`."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

from magtensor.calibrated import restored
from magtensor.cli import status_of
from magtensor.errors import DataError, NotEnoughData, UsageError
from magtensor.platform_frame import as_fitted
from magtensor.result import open_result
from magtensor.simulate import simulate, write

RECIPE = Path(__file__).parents[2] / "recipes" / "common_rotation.yaml"

# rad; all sensors are turned by some ten degrees together, and by some tenths of a degree against each other
ANGLES = [[0.12, -0.08, 0.10], [0.13, -0.075, 0.105], [0.118, -0.082, 0.094], [0.124, -0.078, 0.102]]
SENSORS = [
    {
        "scale": [1.01 - 0.004 * i, 0.995, 1.0 + 0.003 * i],
        "bias_nT": [60.0 - 30 * i, 40.0 * i, -50.0],
        "angles": {"convention": "chi2017", "psi_rad": 0.005, "phi_rad": -0.004 * i, "theta_rad": 0.006}
        | dict(zip(("alpha_rad", "beta_rad", "gamma_rad"), ANGLES[i], strict=True)),
    }
    for i in range(4)
]

TUMBLING: dict[str, Any] = {
    "title": "calibration in a uniform field",
    "seed": 3,
    "rate_Hz": 5.0,
    "instrument": {
        "seed": 12,
        "array": {"shape": "cross", "baseline_m": 0.5},
        "errors": SENSORS,
        "noise": {"white_sd_nT": 0.15},
    },
    "motion": {"type": "tumbling", "duration_s": 300.0, "rate_rms_deg_s": 15.0, "rate_time_s": 5.0},
    "field": {"earth": {"total_field_nT": 49500.0, "inclination_deg": 66.0, "declination_deg": 4.0}},
    "base_station": {"rate_Hz": 0.5, "noise_sd_nT": 0.1},
    "logging": {"attitude": True, "attitude_noise_deg": 0.1},
}
LINES: dict[str, Any] = copy.deepcopy(TUMBLING) | {
    "title": "lines past two dipoles",
    "seed": 4,
    "motion": {
        "type": "survey_lines", "lines": 6, "length_m": 24.0, "spacing_m": 1.5, "speed_m_s": 1.0, "height_m": 2.0,
        "azimuth_deg": 20.0, "turn_s": 8.0, "wobble_deg": 3.0, "wobble_time_s": 2.0,
    },
    "field": TUMBLING["field"] | {
        "dipoles": [
            {"position_m": [5.0, 7.0, -1.5], "moment_Am2": [3.0, 20.0, -40.0]},
            {"position_m": [9.0, 16.0, -2.0], "moment_Am2": [30.0, -20.0, -30.0]},
        ]
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with surveys, and with calibrations made with and without an attitude."""
    folder = tmp_path_factory.mktemp("rotation")
    write(simulate(TUMBLING), folder / "attitude.h5")
    write(simulate(TUMBLING | {"logging": {}}), folder / "plain.h5")
    write(simulate(LINES | {"logging": {}}), folder / "lines.h5")
    for name in ("attitude", "plain"):
        made = ["run", str(RECIPE), "--input", str(folder / f"{name}.h5"), "--output", str(folder / name)]
        assert status_of(made) == 0
    return folder


def applied(folder: Path, calibration: Path, name: str, *options: str) -> xr.Dataset:
    output = folder / f"{name}.nc"
    assert status_of(["apply", str(calibration), str(folder / "lines.h5"), "--output", str(output), *options]) == 0
    with xr.open_dataset(output, group="calibrated", engine="h5netcdf") as found:
        return found.load()


def tensor_error(folder: Path, found: xr.Dataset) -> tuple[float, float]:
    """Relative rms error of the tensor, and its ratio to what `tensor_std` claims, where the field is no noise."""
    with h5py.File(folder / "lines.h5") as file:
        true = file["truth/tensor_true"][:]
    # far enough for the array to be small: the finite baseline is another error
    size = np.sqrt(np.sum(true**2, axis=(1, 2)))
    at = (size > 50.0) & (size < 300.0)
    miss = found["tensor"].values[at] - true[at]
    return float(np.sqrt(np.mean(miss**2) / np.mean(true[at] ** 2))), float(
        np.sqrt(np.mean(miss**2) / np.mean(found["tensor_std"].values[at] ** 2))
    )


@pytest.mark.long
def test_a_survey_line_refines_the_rotation_that_was_left_free(files, capsys):
    calibration, refined = files / "plain" / "calibration.nc", files / "refined.nc"
    before, claimed = tensor_error(files, applied(files, calibration, "before"))
    capsys.readouterr()
    found = applied(files, calibration, "after", "--refine-rotation", "--save-calibration", str(refined))
    said = capsys.readouterr().out
    after, _ = tensor_error(files, found)
    assert before > 0.03  # the calibration left the array turned by degrees,
    assert claimed > 2  # and its covariance knows nothing of that
    assert after < before / 4
    assert "determined by symmetry" in said
    assert found["b"].attrs["rotation_refined"] in said
    assert found["b"].attrs["frame"].startswith("platform (by symmetry")
    capsys.readouterr()
    again = applied(files, refined, "again", "--refine-rotation")
    assert "no significant turn" in capsys.readouterr().out
    assert again["tensor"].values == pytest.approx(found["tensor"].values, abs=1e-9, nan_ok=True)


def test_an_attitude_ties_the_frame(files, capsys):
    calibration = files / "attitude" / "calibration.nc"
    stored = open_result(calibration)
    matrix, tie = stored["calibration/matrix"].attrs, stored["calibration/common_rotation"].attrs
    assert matrix["frame"].startswith("platform (by attitude")
    assert "one rotation" not in matrix["unobservable"]
    assert "determined by attitude" in matrix["common_rotation"]
    # 0.1 deg of white noise in 1500 samples, the field in all directions: 3/2 of the variance a fixed frame would leave
    assert tie["std_deg"] == pytest.approx([0.1 * np.sqrt(1.5 / 1500)] * 3, rel=0.25)
    error, claimed = tensor_error(files, applied(files, calibration, "by_attitude"))
    free, _ = tensor_error(files, applied(files, files / "plain" / "calibration.nc", "free"))
    assert error < free / 4
    assert claimed < 2
    with xr.open_dataset(files / "attitude" / "result.nc", group="qc", engine="h5netcdf") as qc:
        assert "common_rotation std" in qc["metric"].values


def test_what_is_left_free_is_said(files):
    matrix = open_result(files / "plain" / "calibration.nc")["calibration/matrix"].attrs
    assert matrix["common_rotation"].startswith("left free: the common rotation is not determined")
    assert "one rotation" in matrix["unobservable"]


def test_the_frames_of_two_sources_agree(files):
    """By attitude and by symmetry: two independent estimates of one rotation, within their standard deviations."""
    by_attitude, refined = files / "attitude" / "calibration.nc", files / "by_symmetry.nc"
    plain = files / "plain" / "calibration.nc"
    applied(files, plain, "symmetry", "--refine-rotation", "--save-calibration", str(refined))
    one, two = (open_result(p)["calibration/common_rotation"] for p in (by_attitude, refined))
    apart = np.degrees(Rotation.from_matrix(one.values @ two.values.T).as_rotvec())
    assert (np.abs(apart) < 4 * np.hypot(one.attrs["std_deg"], two.attrs["std_deg"])).all()


def test_a_refinement_without_gradients_is_refused(files, capsys):
    """Status 3: the data are not enough for what was asked; nothing is written."""
    output = files / "none.nc"
    arguments = ["apply", str(files / "plain" / "calibration.nc"), str(files / "plain.h5"), "--output", str(output)]
    assert status_of([*arguments, "--refine-rotation"]) == 3
    assert "too small or too few" in capsys.readouterr().err
    assert not output.exists()
    # what is known already is not lost by a survey that adds nothing
    arguments[1] = str(files / "attitude" / "calibration.nc")
    assert status_of([*arguments, "--refine-rotation"]) == 0
    assert "no significant turn" in capsys.readouterr().out


def test_effects_are_taken_off_in_the_frame_they_were_fitted_in(files):
    tied = open_result(files / "attitude" / "calibration.nc")
    plain = open_result(files / "plain" / "calibration.nc")
    assert as_fitted(tied, restored(tied)).matrix == pytest.approx(restored(plain).matrix, abs=1e-9)
    assert np.abs(restored(tied).matrix - restored(plain).matrix).max() > 0.01


@pytest.mark.parametrize(
    ("options", "kind", "said"),
    [
        ("source=attitude", NotEnoughData, "no attitude"),
        ("source=sensor", DataError, "no sensor is declared"),
        ("source=axis", DataError, "no turns are declared"),
        ("sensor=S9", DataError, "no sensor is called S9"),
        ("source=symmetry", NotEnoughData, "too small or too few"),
        ("turns={z: [7]}", DataError, r"turns about z are declared in segment 7, but the survey has no segment"),
        ("segments=[3]", DataError, "segments are named for the symmetry, but the survey has no segment"),
    ],
)
def test_mistakes_and_lacks_are_told(files, options, kind, said):
    from magtensor.session import run_recipe

    overrides = ["stages.fix_rotation.required=true", f"stages.fix_rotation.{options}"]
    with pytest.raises(kind, match=said):
        run_recipe(RECIPE, files / "refused", survey=files / "plain.h5", overrides=overrides)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"source": "attitude", "turns": {"z": []}}, "turns is declared, but source attitude leaves it out; name axis"),
        ({"source": ["axis"], "turns": {"z": []}, "sensor": "S1"}, "sensor is declared, but source axis"),
        ({"source": "attitude", "segments": [1]}, "segments are for the symmetry"),
    ],
)
def test_what_is_declared_is_not_left_out(files, given, said):
    from magtensor.session import run_recipe

    overrides = ["stages.fix_rotation.required=false", *(f"stages.fix_rotation.{k}={v}" for k, v in given.items())]
    with pytest.raises(UsageError, match=said):
        run_recipe(RECIPE, files / "refused", survey=files / "attitude.h5", overrides=overrides)


def test_why_declared_turns_could_not_be_used_is_printed(files):
    from magtensor.session import run_recipe

    overrides = ["stages.fix_rotation.required=false", "stages.fix_rotation.turns={z: [7]}"]
    done = run_recipe(RECIPE, files / "turns", survey=files / "plain.h5", overrides=overrides)
    words = (
        "not determined: the common rotation: turns about z are declared in segment 7, but the survey has no segment"
    )
    assert words in done.notes


def test_the_closed_loop_uses_an_attitude(files):
    """The frame is the platform's; the errors of a uniform field, before and after, are those of the untied frame."""
    from magtensor.session import run_recipe

    recipe = RECIPE.with_name("closed_loop.yaml")
    found = {
        name: run_recipe(
            recipe, files / f"loop_{name}", survey=files / f"{name}.h5", verify=files / f"{other}.h5",
            overrides=["stages.close_loop.search=[temperature_offset]"],
        )
        for name, other in (("attitude", "plain"), ("plain", "attitude"))
    }  # fmt: skip
    tied, free = (found[name].survey["calibration/matrix"].attrs["frame"] for name in ("attitude", "plain"))
    assert tied.startswith("platform (by attitude")
    assert not free.startswith("platform")
    for when in ("before", "after"):
        one, two = (found[name].outcome["error"]["verify"][when] for name in ("attitude", "plain"))
        for figure in ("total_field_rms_nT", "tensor_rms_nT_per_m"):
            assert one[figure]["all"] == pytest.approx(two[figure]["all"], rel=0.02)


def test_it_comes_before_the_tensor(files, tmp_path):
    from magtensor.session import run_recipe

    lines = RECIPE.read_text().split("  - fix_rotation")[0] + "  - assemble_tensor\n  - fix_rotation\n"
    (tmp_path / "late.yaml").write_text(lines)
    with pytest.raises(UsageError, match="before assemble_tensor"):
        run_recipe(tmp_path / "late.yaml", tmp_path / "out", survey=files / "attitude.h5")
