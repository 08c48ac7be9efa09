"""calibrate_joint with a C that changes with the date, from files to files: the result, and apply at another date."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from test_joint_options import FORWARD, NOISE_NT, OFFSET, SENSORS, command, matrix_of, run, written

DATES = ("2024-01-10", "2024-07-01", "2025-02-01", "2025-08-15")
RATE = 3e-4 * np.random.default_rng(7).standard_normal((SENSORS, 3, 3))  # of C, a year of 365.25 days
LATER = "2026-08-15"


def year(date: str) -> float:
    return float((np.datetime64(date) - np.datetime64(DATES[0])) / np.timedelta64(1, "D")) / 365.25


def at(date: str) -> np.ndarray:
    return FORWARD + year(date) * RATE


def surveys(folder: Path) -> str:
    """Files of all dates and of a later one; the line of the recipe that names the further ones."""
    for seed, date in enumerate((*DATES, LATER)):
        name = f"{'abcde'[seed]}.h5"
        written(folder / name, 10 + seed, samples=800, reference=True, forward=at(date), date=date)
    return ", with: [b.h5, c.h5, d.h5]"


def length_error(matrix: np.ndarray, date: str) -> float:
    """Largest relative error of |b|, of any sensor in any direction."""
    return float(abs(np.linalg.svd(matrix @ at(date), compute_uv=False) - 1.0).max())


STAGES = "[load, detrend_diurnal, calibrate_joint: {{{}}}, assemble_tensor, qc]"


def test_a_later_survey_is_calibrated_for_its_date(tmp_path: Path) -> None:
    further = surveys(tmp_path)
    done = run(tmp_path, STAGES.format("matrices: linear, offsets: common"), further=further)
    assert done.exit_code == 0, done.output
    assert "a rotation that all sensors share between surveys" in done.output
    assert "with the date: C changes by up to" in done.output
    assert "disagree about C" not in done.output
    calibration = tmp_path / "out/calibration.nc"
    tree, matrix = matrix_of(calibration)
    assert length_error(matrix, DATES[0]) < 3e-5 < length_error(matrix, LATER)
    facts = json.loads(tree["calibration/matrix"].attrs["diagnostics"])
    assert "the surveys want the change" in facts["change"] and "The line explains" in facts["change"]
    off = tree["calibration/rate"].values - RATE @ np.linalg.inv(FORWARD)
    turns = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(0, 2, 1)
    common = np.stack([(FORWARD @ turn @ np.linalg.inv(FORWARD)).ravel() for turn in turns], axis=1)
    visible = np.linalg.svd(common)[0][:, 3:].T  # a rotation that all share, no scalar can see
    at_rates = [12 * SENSORS + 12 * s + i for s in range(SENSORS) for i in range(9)]
    covariance = tree["calibration/change_covariance"].values[np.ix_(at_rates, at_rates)]
    off = visible @ off.ravel()
    square = off @ np.linalg.solve(visible @ covariance @ visible.T, off) / len(off)
    assert square == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / len(off)))
    assert tree["calibration/rate_std"].values.max() < 0.01 * abs(RATE).max()
    assert list(tree["calibration/survey_date"].values) == [f"{d}T00:00:00Z" for d in DATES]
    applied = command("apply", calibration, tmp_path / "e.h5", "--save-calibration", tmp_path / "saved.nc")
    assert applied.exit_code == 0, applied.output
    assert f"of {LATER}, extrapolated: 1.00 years after the last survey" in applied.output
    with xr.open_datatree(tmp_path / "e.calibrated.nc", engine="h5netcdf", decode_times=False) as found:
        b, tensor = found["calibrated/b"].values, found["calibrated/tensor"].values
        tensor_std = found["calibrated/tensor_std"].values
    with h5py.File(tmp_path / "e.h5") as raw:
        size = np.repeat(raw["reference/total_field"][:], 10)[: len(b)]
    residual = np.linalg.norm(b, axis=2) - size[:, None]
    assert np.sqrt(np.mean(residual**2)) < 3.0 * NOISE_NT  # 50 000 nT times the change of two and a half years: 20 nT
    assert 0.5 < np.sqrt(np.mean(tensor**2 / tensor_std**2)) < 1.6
    between = command("apply", calibration, tmp_path / "b.h5")
    assert between.exit_code == 0 and "between the surveys of the fit" in between.output
    windows = command("apply", calibration, tmp_path / "e.h5", "--memory", 0.5, "--output", tmp_path / "w.nc")
    assert windows.exit_code == 0, windows.output
    with xr.open_datatree(tmp_path / "w.nc", engine="h5netcdf", decode_times=False) as found:
        np.testing.assert_array_equal(found["calibrated/b"].values, b)
    again = command("run", tmp_path / "out/result.nc", "--output", tmp_path / "again")
    assert again.exit_code == 0 and "reproduced bit for bit" in again.output, again.output


def test_surveys_of_an_ageing_c_are_said_to_disagree_about_one(tmp_path: Path) -> None:
    for seed, date in enumerate(DATES):
        forward = FORWARD + 0.1 * year(date) * RATE
        written(tmp_path / f"{'abcd'[seed]}.h5", 10 + seed, samples=400, reference=True, forward=forward, date=date)
    done = run(tmp_path, STAGES.format("offsets: own"), further=", with: [b.h5, c.h5, d.h5]")
    assert done.exit_code == 0, done.output
    assert "the surveys disagree about C" in done.output and "`matrices: linear`" in done.output
    tree, _ = matrix_of(tmp_path / "out/calibration.nc")
    assert "disagree" in json.loads(tree["calibration/matrix"].attrs["diagnostics"])["disagreement"]


def test_offsets_that_drift(tmp_path: Path) -> None:
    drift = 40.0 * np.random.default_rng(8).standard_normal((SENSORS, 3))
    for seed, date in enumerate((*DATES, LATER)):
        offset = OFFSET + year(date) * drift
        written(tmp_path / f"{'abcde'[seed]}.h5", 10 + seed, samples=600, reference=True, offset=offset, date=date)
    done = run(tmp_path, STAGES.format("offsets: linear"), further=", with: [b.h5, c.h5, d.h5]")
    assert done.exit_code == 0, done.output
    tree, _ = matrix_of(tmp_path / "out/calibration.nc")
    assert "the offsets change by up to" in json.loads(tree["calibration/matrix"].attrs["diagnostics"])["change"]
    off = (tree["calibration/offset_rate"].values - drift).ravel()
    at_rates = [12 * SENSORS + 12 * s + 9 + i for s in range(SENSORS) for i in range(3)]
    covariance = tree["calibration/change_covariance"].values[np.ix_(at_rates, at_rates)]
    assert off @ np.linalg.solve(covariance, off) / len(off) == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / len(off)))
    assert not tree["calibration/rate"].values.any()
    applied = command("apply", tmp_path / "out/calibration.nc", tmp_path / "e.h5")
    assert applied.exit_code == 0, applied.output
    rms = float(applied.output.split("|b| - F: ")[1].split()[0])
    assert rms < 2.0 * NOISE_NT


@pytest.mark.parametrize(
    ("options", "further", "status", "said"),
    [
        ("matrices: linear", "", 2, "matrices: linear needs further surveys"),
        ("offsets: linear", "", 2, "offsets: linear needs further surveys"),
        ("matrices: linear, total_field: per_survey", ", with: b.h5", 2, "needs a measured total field"),
        ("matrices: linear, offsets: linear, offset_of: mean", ", with: b.h5", 2, "with offsets of their own"),
        ("matrices: linear", ", with: b.h5", 3, "have one date"),
        ("matrices: linear", ", with: c.h5", 3, "its clock does not tell the date"),
    ],
)
def test_mistakes(tmp_path: Path, options: str, further: str, status: int, said: str) -> None:
    for name, seed, date in (("a", 3, "2026-01-01"), ("b", 4, "2026-01-01"), ("c", 5, "1970-01-01")):
        written(tmp_path / f"{name}.h5", seed, samples=400, reference=True, date=date)
    done = run(tmp_path, STAGES.format(options), further=further)
    assert done.exit_code == status and said in done.output and "Traceback" not in done.output, done.output
