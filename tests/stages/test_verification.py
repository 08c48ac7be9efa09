"""A verification survey: looked at before the fit, recorded with the result, and used again when that is run again."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from magtensor import close_loop, provenance
from magtensor.applying import apply
from magtensor.batch.freshness import why_run
from magtensor.cli import status_of
from magtensor.errors import DataError
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import read_plan
from magtensor.session import compute, run_recipe
from magtensor.simulate import simulate, write
from magtensor.survey.canonical import read_canonical
from magtensor.survey.in_memory import given_survey
from magtensor.verdict_words import sentence

SCENARIO: dict[str, Any] = {
    "title": "a cross of four sensors, tumbled",
    "rate_Hz": 10.0,
    "instrument": {
        "seed": 7,
        "array": {"shape": "cross", "baseline_m": 0.5},
        "errors": {"scale": 0.01, "non_orthogonality_deg": 0.5, "misalignment_deg": 1.0, "bias_nT": 100.0},
        "noise": {"white_sd_nT": 0.2},
    },
    "motion": {"type": "tumbling", "duration_s": 60.0, "rate_rms_deg_s": 40.0, "rate_time_s": 3.0},
    "field": {"earth": {"total_field_nT": 49500.0, "inclination_deg": 66.0, "declination_deg": 4.0}},
    "base_station": {"rate_Hz": 1.0, "noise_sd_nT": 0.1, "resolution_nT": 0.01},
}
RECIPE = """title: calibrated and verified
survey: survey.h5
stages: [load, detrend_diurnal: {uncovered: mask}, calibrate_joint]
"""


@pytest.fixture(scope="module")
def surveys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("surveys")
    for seed, name in enumerate(("survey", "verify", "other")):
        write(simulate(SCENARIO | {"seed": seed}), folder / f"{name}.h5")
    return folder


@pytest.fixture
def folder(surveys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # no time for pictures
    for file in surveys.iterdir():
        shutil.copy(file, tmp_path)
    (tmp_path / "recipe.yaml").write_text(RECIPE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def verified(folder: Path, name: str) -> dict[str, Any] | None:
    """The verdict's block `verify`."""
    found: dict[str, Any] | None = json.loads((folder / name / "verdict.json").read_text())["error"].get("verify")
    return found


def run(*arguments: str) -> int:
    return status_of(["run", *arguments])


@pytest.mark.parametrize("more", [(), ("--memory", "1")], ids=["whole", "windows"])
def test_a_result_run_again_is_verified_again(
    folder: Path, more: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("recipe.yaml", "--verify", "verify.h5", "--output", "out", *more) == 0
    inputs = provenance.read(folder / "out/result.nc").inputs
    assert [(Path(i["path"]).name, i.get("role")) for i in inputs] == [
        ("survey.h5", None), ("verify.h5", "verification"),
    ]  # fmt: skip
    assert inputs[1]["sha256"] == provenance.sha256(folder / "verify.h5")
    assert run("out/result.nc", "--output", "again") == 0
    assert "reproduced bit for bit" in capsys.readouterr().out
    assert verified(folder, "again") == verified(folder, "out")
    assert verified(folder, "out")["after"]["samples"] > 0  # type: ignore[index]
    assert (folder / "again/verdict.json").read_bytes() == (folder / "out/verdict.json").read_bytes()
    assert provenance.read(folder / "again/result.nc").inputs == inputs


def test_the_verification_survey_is_checked_by_its_hash(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("recipe.yaml", "--verify", "verify.h5", "--output", "out") == 0
    (folder / "verify.h5").rename(folder / "moved.h5")
    capsys.readouterr()
    assert run("out/result.nc", "--output", "again") == 3
    said = capsys.readouterr().err
    assert said.count("error: ") == 1 and "the verification survey of this result is no longer there" in said
    assert "verify.h5" in said and "name it with --verify" in said
    shutil.copy(folder / "other.h5", folder / "verify.h5")
    assert run("out/result.nc", "--output", "again") == 3
    said = capsys.readouterr().err
    assert said.count("error: ") == 1 and "this verification survey has changed since the result was made" in said
    assert run("out/result.nc", "--output", "again", "--input", "survey.h5") == 3  # also with another survey
    assert not (folder / "again").exists()
    capsys.readouterr()
    assert run("out/result.nc", "--output", "again", "--verify", "moved.h5") == 0
    assert "the verification survey was" not in capsys.readouterr().out  # the same bytes elsewhere
    assert verified(folder, "again") == verified(folder, "out")
    assert run("out/result.nc", "--output", "again", "--verify", "other.h5") == 0
    said = capsys.readouterr().out
    assert f"the verification survey was {folder / 'verify.h5'}, is {folder / 'other.h5'}" in said
    assert verified(folder, "again") != verified(folder, "out")
    assert run("out/result.nc", "--output", "again", "--set", "verify=null") == 0
    assert verified(folder, "again") is None


@pytest.mark.parametrize("memory", [None, 1.0], ids=["whole", "windows"])
def test_what_cannot_verify_is_found_before_the_fit(folder: Path, memory: float | None) -> None:
    (folder / "text.h5").write_text("no HDF5")
    with h5py.File(folder / "verify.h5", "r+") as file:
        del file["b_raw"]
    for name in ("nowhere.h5", "text.h5", "verify.h5"):
        begun: list[str] = []
        with pytest.raises(DataError, match=name):
            run_recipe(
                folder / "recipe.yaml", folder / "out", verify=folder / name, progress=begun.append, memory_GiB=memory
            )
        assert begun == [] and not (folder / "out").exists()


def test_a_recipe_names_its_verification_survey(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "deeper").mkdir()
    recipe = folder / "deeper/recipe.yaml"
    recipe.write_text(RECIPE.replace("survey.h5", "../survey.h5") + "verify: ../verify.h5\n")
    assert run("deeper/recipe.yaml", "--output", "named") == 0
    assert run("recipe.yaml", "--verify", "verify.h5", "--output", "given") == 0
    assert verified(folder, "named") == verified(folder, "given") is not None
    assert run("deeper/recipe.yaml", "--verify", "other.h5", "--output", "other") == 0
    assert verified(folder, "other") not in (None, verified(folder, "named"))
    assert run("deeper/recipe.yaml", "--set", "verify=null", "--output", "without") == 0
    assert verified(folder, "without") is None
    recipe.write_text(RECIPE + "verify: [a.h5, b.h5]\n")
    assert status_of(["validate", str(recipe)]) == 2
    assert f"{recipe}:4: verify: must be one file" in capsys.readouterr().err


def test_a_batch_verifies_again_when_the_verification_survey_changed(folder: Path) -> None:
    (folder / "recipe.yaml").write_text(RECIPE + "verify: verify.h5\n")
    assert status_of(["batch", "recipe.yaml", "survey.h5", "--output", "all", "--workers", "1"]) == 0
    assert verified(folder / "all", "survey") is not None
    planned = read_plan(folder / "recipe.yaml")
    assert why_run(folder / "all/survey", planned) == ""
    (folder / "verify.h5").rename(folder / "moved.h5")
    assert why_run(folder / "all/survey", read_plan(folder / "recipe.yaml", verify=folder / "moved.h5")) == ""
    assert "there is no such file" in why_run(folder / "all/survey", planned)
    shutil.copy(folder / "other.h5", folder / "verify.h5")
    assert why_run(folder / "all/survey", planned) == "input changed: verify.h5"


def test_a_verification_survey_in_memory_is_asked_for(folder: Path) -> None:
    planned = read_plan(folder / "recipe.yaml")
    held = given_survey(read_canonical(folder / "verify.h5"))
    compute(planned, empty_survey(planned), verify=held).write(folder / "out")  # type: ignore[arg-type]
    (role,) = [i for i in provenance.read(folder / "out/result.nc").inputs if "role" in i]
    assert role == held.facts() | {"role": "verification"}  # type: ignore[union-attr]
    with pytest.raises(DataError, match=r"(?s)the verification survey of this result.*--verify"):
        run_recipe(folder / "out/result.nc", folder / "again")
    run_recipe(folder / "out/result.nc", folder / "again", verify=folder / "verify.h5")
    assert verified(folder, "again") == verified(folder, "out")


@pytest.mark.long
def test_an_error_of_the_base_station_that_has_ended_is_not_taken_off(tmp_path: Path) -> None:
    # its clock was late during the survey, and right when the second one was recorded
    active = SCENARIO["field"] | {"variation": {"irregular": {"rms_nT": 20.0, "time_s": 40.0}}}
    survey = SCENARIO | {"rate_Hz": 4.0, "motion": SCENARIO["motion"] | {"duration_s": 400.0}, "field": active}
    late = {"type": "reference_clock", "offset_s": 9.0}
    for name, one in (
        ("late.h5", {"seed": 3, "effects": [late]}),
        ("right.h5", {"seed": 4}),
        ("too.h5", {"seed": 5, "effects": [late]}),
    ):
        write(simulate(survey | one), tmp_path / name)
    options = {"search": ["reference_clock", "reference_scale"]}
    found = close_loop(tmp_path / "late.h5", verify=tmp_path / "right.h5", **options)
    ended = found.verdict
    goes_on = close_loop(tmp_path / "late.h5", verify=tmp_path / "too.h5", **options).verdict
    for told in (ended, goes_on):
        assert [a["error_model"] for a in told["adopted"]] == ["reference_clock"]
        after = told["error"]["verify"]["after"]["total_field_rms_nT"]["all"]
        assert (
            after == pytest.approx(0.2, abs=0.06)
            and after < 0.5 * told["error"]["verify"]["before"]["total_field_rms_nT"]["all"]
        )
    assert ended["error"]["verify"]["total_field_as_read"] == "reference_clock"
    assert "judged as it was read" in sentence(ended)
    assert "total_field_as_read" not in goes_on["error"]["verify"]

    stored = found.calibration.save(tmp_path / "calibration.nc")
    right, too = (apply(stored, tmp_path / name) for name in ("right.h5", "too.h5"))
    assert any("as it was read" in note and "reference_clock" in note for note in right.notes)
    assert not any("as it was read" in note for note in too.notes)
    for one in (right, too):
        nT = float(one.sentence.split("|b| - F: ")[1].split()[0])
        assert nT == pytest.approx(0.2, abs=0.06)


@pytest.mark.parametrize(("change", "told"), [("noise", "noise or disturbances of its own"), ("offset", "changed")])
def test_a_survey_that_disagrees_says_whether_a_calibration_is_why(
    change: str, told: str, surveys: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other.h5"
    shutil.copy(surveys / "verify.h5", other)
    with h5py.File(other, "a") as file:
        raw = file["b_raw"][:]
        raw += 3.0 * np.random.default_rng(1).standard_normal(raw.shape) if change == "noise" else 5.0
        file["b_raw"][:] = raw
    found = close_loop(surveys / "survey.h5", search=[], verify=other).verdict
    error = found["error"]["verify"]
    assert error["after"]["total_field_rms_nT"]["all"] > 2.0
    assert error["left_by_any_calibration_nT"] == pytest.approx(3.0 if change == "noise" else 0.2, rel=0.15)
    assert told in sentence(found)


def test_samples_that_are_in_no_figure_are_said_to_be(surveys: Path, tmp_path: Path) -> None:
    """One row in ten has a kick of 500 nT on one sensor of four, and no figure shows it."""
    other = tmp_path / "other.h5"
    shutil.copy(surveys / "verify.h5", other)
    with h5py.File(other, "a") as file:
        raw = file["b_raw"][:]
        raw[::10, 0] += 500.0
        file["b_raw"][:] = raw
    kicked, alone = (
        close_loop(surveys / "survey.h5", search=[], verify=v).verdict for v in (other, surveys / "verify.h5")
    )
    for found, least in ((kicked, 0.1), (alone, 0.0)):
        share = found["error"]["verify"]["share_not_in_use"]
        assert least - 0.002 <= share <= least + 0.01
        assert (" of the verification survey's samples are flagged" in sentence(found)) is (least > 0)


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (["front", "left", "back", "right"], "or give the survey's sensors these names"),
        (
            ["S2", "S1", "S3", "S4"],
            "put the survey's sensors, with all that it holds of each, in the calibration's order",
        ),
    ],
)
def test_a_survey_that_cannot_verify_costs_no_result(
    names: list[str], told: str, surveys: Path, tmp_path: Path
) -> None:
    other = tmp_path / "renamed.h5"
    shutil.copy(surveys / "verify.h5", other)
    with h5py.File(other, "a") as file:
        file["sensor"][:] = names
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(RECIPE.replace("survey.h5", str(surveys / "survey.h5")))
    finished = run_recipe(recipe, tmp_path / "out", verify=other)
    error = json.loads((tmp_path / "out/verdict.json").read_text())["error"]
    assert error["verify"]["before"] is None and error["verify"]["after"] is None
    assert f"the survey has {', '.join(names)}" in error["verify"]["not_possible"]
    assert told in error["verify"]["not_possible"]
    assert "NOT verified: the calibration is for the sensors S1, S2, S3, S4" in finished.sentence
    assert "verification survey" not in finished.sentence and (tmp_path / "out/calibration.nc").exists()


def test_an_attitude_that_is_misread_is_in_the_verdict(tmp_path: Path) -> None:
    """The loop goes on without it, and the verdict alone would not say why there is no frame of the platform."""
    path = tmp_path / "inverse.h5"
    write(simulate(SCENARIO | {"seed": 1, "logging": {"attitude": True}}), path)
    with h5py.File(path, "a") as file:
        file["attitude"][:] *= [-1.0, -1.0, -1.0, 1.0]
    found = close_loop(path, search=[]).verdict
    words = found["attitude"]["description"]
    assert "the attitude does not go with the field" in words and "`maps: world to platform`" in words
    assert words in sentence(found)
