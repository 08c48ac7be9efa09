"""Surveys worked through in windows give what the whole gives, and what cannot be done in windows is refused."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner

from magtensor import long_survey
from magtensor.cli import cli
from magtensor.errors import MagtensorError

SAMPLES, SENSORS = 30_000, 4
RECIPE = """
title: in windows
stages:
  - load
  - detrend_diurnal: {uncovered: mask}
  - calibrate_joint
  - assemble_tensor
  - qc
"""


def written(path: Path, seed: int, spikes: int = 0) -> Path:
    """A canonical survey of a tumbling cross of four sensors, its reference ten seconds short of the end."""
    rng = np.random.default_rng(seed)
    time = np.arange(SAMPLES) / 10.0
    own = np.random.default_rng(1)  # the same array in every survey
    forward = np.eye(3) + 0.02 * own.standard_normal((SENSORS, 3, 3))
    offset = 100.0 * own.standard_normal((SENSORS, 3))
    phase = np.cumsum(rng.standard_normal((SAMPLES, 3)), axis=0) * 0.05
    axis = np.column_stack([np.cos(phase[:, 0]) * np.cos(phase[:, 1]), np.sin(phase[:, 0]), np.sin(phase[:, 1])])
    total_field = 50_000.0 + 10.0 * np.sin(time / 500.0)
    field = axis / np.linalg.norm(axis, axis=1, keepdims=True) * total_field[:, None]
    raw = np.einsum("sij,nj->nsi", forward, field) + offset + 0.2 * rng.standard_normal((SAMPLES, SENSORS, 3))
    raw[rng.choice(29_000, spikes, replace=False), 1] += 800.0
    with h5py.File(path, "w") as file:
        for name, values, units in (
            ("time", time, "seconds since 2026-01-01T00:00:00Z"),
            ("b_raw", raw, "nT"),
            ("position", 0.25 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0.0]]), "m"),
            ("reference/time", time[:-100:20], "seconds since 2026-01-01T00:00:00Z"),
            ("reference/total_field", total_field[:-100:20], "nT"),
        ):
            file[name] = values
            file[name].attrs["units"] = units
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("long")
    (place / "recipe.yaml").write_text(RECIPE)
    written(place / "a.h5", 2, spikes=40)
    written(place / "b.h5", 3)
    return place


@pytest.fixture(autouse=True)
def small_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(long_survey, "LEAST_ROWS", 7_000)


def magtensor(*arguments: object) -> str:
    done = CliRunner().invoke(cli, [str(a) for a in arguments], standalone_mode=False)
    if done.exception:
        raise done.exception
    return done.output


def opened(path: Path) -> xr.DataTree:
    with xr.open_datatree(path, engine="h5netcdf", decode_times=False) as tree:
        return tree.load()


def test_a_run_in_windows_gives_what_the_whole_gives(folder: Path) -> None:
    told = [
        magtensor("run", folder / "recipe.yaml", "--input", folder / "a.h5", "--output", folder / name, *more)
        for name, more in (("whole", ()), ("parts", ("--memory", 0.1)))
    ]
    assert told[0].splitlines()[-1].split(";")[0] == told[1].splitlines()[-1].split(";")[0]
    whole, parts = (opened(folder / name / "result.nc") for name in ("whole", "parts"))
    for path in ("calibration/matrix", "calibration/offset", "calibration/covariance", "calibrated/b"):
        np.testing.assert_array_equal(parts[path], whole[path])
    for path in ("calibrated/good", "calibrated/time", "residual/total_field", "residual/contrast"):
        np.testing.assert_array_equal(parts[path], whole[path])
    bad = ~np.asarray(parts["calibrated/good"], dtype=bool)
    assert 40 <= bad[:29_500].sum() <= 42
    assert bad[-90:].all()  # the reference ends early
    for name in ("total_field", "total_field_std"):
        np.testing.assert_allclose(parts[f"detrended/{name}"], whole[f"detrended/{name}"], rtol=1e-12)
    # the noise is that of a selection
    np.testing.assert_allclose(parts["calibrated/tensor"], whole["calibrated/tensor"], atol=0.05)
    for name in ("calibration.nc", "verdict.json", "report.html"):
        assert (folder / "parts" / name).is_file()
    assert "spread evenly over the 30000 of the survey" in (folder / "parts" / "report.html").read_text()
    assert not [p for p in (folder / "parts").iterdir() if p.name.startswith((".", "tmp"))]


@pytest.mark.long
def test_windows_of_which_one_holds_filled_in_rows(folder: Path, tmp_path: Path) -> None:
    """No calibration is fitted to them, in windows or on the whole."""
    survey = written(tmp_path / "c.h5", 4)
    with h5py.File(survey, "r+") as file:
        held = np.repeat(file["b_raw"][20_000::2], 2, axis=0)
        file["b_raw"][20_000:] = held[: SAMPLES - 20_000]
    found = {}
    for name, options in (("windows", ["--memory", "0.01"]), ("whole", [])):
        magtensor("run", folder / "recipe.yaml", "--input", survey, "--output", tmp_path / name, *options)
        found[name] = opened(tmp_path / name / "calibration.nc")["calibration"]
    assert (found["windows"]["noise_std"].values < 0.25).all()
    np.testing.assert_allclose(found["windows"]["matrix"], found["whole"]["matrix"], atol=2e-6)


@pytest.mark.long
def test_a_result_made_in_windows_is_made_again_in_windows(folder: Path) -> None:
    first = ("run", folder / "recipe.yaml", "--input", folder / "a.h5", "--output", folder / "first")
    assert "--memory 0.1 cannot be kept to" in magtensor(*first, "--memory", 0.1)
    told = magtensor("run", folder / "first" / "result.nc", "--output", folder / "again")
    assert "reproduced bit for bit" in told


def test_apply_in_windows_gives_the_same_bits(folder: Path) -> None:
    magtensor("run", folder / "recipe.yaml", "--input", folder / "a.h5", "--output", folder / "made")
    told = [
        magtensor("apply", folder / "made" / "calibration.nc", folder / "b.h5", "--output", folder / name, *more)
        for name, more in (("one.nc", ()), ("many.nc", ("--memory", 0.1)))
    ]
    assert told[0].splitlines()[-1] == told[1].splitlines()[-1]
    assert ["--memory 0.1 cannot be kept to" in words for words in told] == [False, True]
    one, many = (opened(folder / name) for name in ("one.nc", "many.nc"))
    assert one["provenance"].attrs["content_sha256"] == many["provenance"].attrs["content_sha256"]
    np.testing.assert_array_equal(one["calibrated/tensor"], many["calibrated/tensor"])


@pytest.mark.parametrize(
    ("stages", "told"),
    [
        ("[load, detrend_diurnal, close_loop]", "close_loop needs the whole survey.*calibrate_joint"),
        ("[load, detrend_diurnal, calibrate_scalar, align]", "calibrate_scalar needs the whole survey"),
        (
            "[load, detrend_diurnal: {uncovered: mask}, calibrate_joint: {error_models: {offset_drift: {}}}]",
            "error_models.*whole survey",
        ),
        ("[load, detrend_diurnal]", "calibrates nothing"),
        ("[load: {window_s: [0, 10]}, detrend_diurnal, calibrate_joint]", "window_s"),
    ],
)
def test_what_needs_the_whole_survey_is_refused(folder: Path, tmp_path: Path, stages: str, told: str) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(f"title: t\nstages: {stages}\n")
    with pytest.raises(MagtensorError, match=told) as refused:
        magtensor("run", recipe, "--input", folder / "b.h5", "--output", tmp_path / "out", "--memory", 1)
    assert refused.value.exit_status == 2
    assert not (tmp_path / "out").exists()


def test_a_table_of_text_is_not_read_in_windows(tmp_path: Path) -> None:
    (tmp_path / "survey.csv").write_text("t,x,y,z\n0,1,2,3\n")
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(
        "title: t\nsurvey: {file: survey.csv, reader: text, time: {from: t}, sensors: {S1: {from: [x, y, z]}}}\n"
        "stages: [load, detrend_diurnal: {uncovered: mask}, calibrate_joint]\n"
    )
    with pytest.raises(MagtensorError, match="read in windows"):
        magtensor("run", recipe, "--output", tmp_path / "out", "--memory", 1)


def test_times_that_step_back_between_windows_are_refused(folder: Path, tmp_path: Path) -> None:
    path = written(tmp_path / "back.h5", 4)
    with h5py.File(path, "r+") as file:
        file["time"][15_000:] -= 1.0
    with pytest.raises(MagtensorError, match=r"move on|steps back"):
        magtensor("run", folder / "recipe.yaml", "--input", path, "--output", tmp_path / "out", "--memory", 0.1)


def test_error_blocks_of_windows_are_put_together() -> None:
    blocks = [
        (
            n,
            {
                "total_field_rms_nT": {"S1": a, "all": a},
                "tensor_rms_nT_per_m": None,
                "invariant_rms": None,
                "samples": n,
            },
        )
        for n, a in ((100, 1.0), (300, 2.0))
    ]
    found = long_survey.combined([*blocks, (0, None)])
    assert found is not None
    assert found["total_field_rms_nT"]["S1"] == pytest.approx(np.sqrt((100 + 300 * 4) / 400))
    assert found["tensor_rms_nT_per_m"] is None and found["samples"] == 400
    assert long_survey.combined([(0, None)]) is None
