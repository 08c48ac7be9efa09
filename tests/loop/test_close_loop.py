"""`magtensor.close_loop` from Python: the recipe's code and result, whatever form the survey is given in."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from loop_cases import RECIPE, scenario, survey_file

import magtensor
from magtensor import provenance
from magtensor.applying import apply
from magtensor.closed_loop import RECIPE as PACKAGED
from magtensor.closed_loop import ClosedLoop
from magtensor.result import FILES, open_result
from magtensor.session import run_recipe
from magtensor.sharing import PROCESSES
from magtensor.survey.canonical import read_canonical
from magtensor.survey.in_memory import Held, given_survey
from magtensor.survey.model import Survey

HEATER = {"type": "current_field", "rms_nT": 5.0, "channel": "current_heater"}
SEARCH = ["current_field", "temperature_offset", "offset_drift"]


@pytest.fixture(scope="module")
def surveys(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("surveys")
    shorter = scenario()["motion"] | {"duration_s": 600.0}
    first, second = (scenario(seed, HEATER, motion=shorter) for seed in (5, 6))
    return survey_file(folder, first), survey_file(folder, second, "other.h5")


@pytest.fixture(scope="module")
def found(surveys: tuple[Path, Path]) -> ClosedLoop:
    return magtensor.close_loop(surveys[0], search=SEARCH)


def content(of: ClosedLoop) -> str:
    return provenance.content_sha256(of.dataset)


def test_two_processes_find_the_same_bits_as_one(
    found: ClosedLoop, surveys: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PROCESSES, "2")
    assert content(magtensor.close_loop(surveys[0], search=SEARCH)) == content(found)


def test_the_packaged_recipe_is_the_one_of_the_contract() -> None:
    assert PACKAGED.read_bytes() == RECIPE.read_bytes()


@pytest.mark.long
def test_the_same_bits_as_the_recipe(tmp_path: Path, surveys: tuple[Path, Path]) -> None:
    survey, verify = surveys
    from_python = magtensor.close_loop(survey, verify=verify, search=SEARCH)
    from_python.save(tmp_path / "python")
    few = [f"stages.close_loop.search=[{', '.join(SEARCH)}]"]
    by_recipe = run_recipe(RECIPE, tmp_path / "recipe", survey=survey, verify=verify, overrides=few)
    assert content(from_python) == by_recipe.made_by.content_sha256
    verdicts = [(tmp_path / n / "verdict.json").read_text() for n in ("python", "recipe")]
    assert verdicts[0] == verdicts[1]
    assert json.loads(verdicts[0]) == from_python.verdict
    assert from_python.sentence == by_recipe.sentence
    assert {f.name for f in (tmp_path / "python").iterdir()} == set(FILES)
    assert from_python.computed.planned.resolved()["stages"] == by_recipe.made_by.recipe["stages"]


def test_steps_tell_the_search(found: ClosedLoop) -> None:
    first, last = found.steps
    assert first["adopted"] == "current_field" and last["adopted"] is None
    looked_at = {c["error_model"]: c for c in first["looked_at"]}
    assert looked_at["current_field"]["passes"] and looked_at["current_field"]["why"] == "adopted"
    assert not any(c["passes"] for c in last["looked_at"])


def test_summary_is_short_and_says_what_was_found(found: ClosedLoop) -> None:
    lines = repr(found).splitlines()
    assert len(lines) <= 6
    assert "current_field" in lines[1]
    assert any("adopted current_field" in line and "channel current_heater" in line for line in lines)


@pytest.mark.parametrize("form", ["groups", "decoded", "tree", "dataset"])
def test_a_survey_in_memory_is_the_one_of_the_file(form: str, surveys: tuple[Path, Path]) -> None:
    from_file = read_canonical(surveys[0])
    groups = xr.open_groups(surveys[0], decode_times=form == "decoded")
    reference = groups["/reference"].load().rename(time="reference_time")
    flat = {f"reference/{str(n).removeprefix('reference_')}": v for n, v in reference.variables.items()}
    given = {
        "groups": groups,
        "decoded": groups,
        "tree": from_file.tree,
        "dataset": groups["/"].load().assign(flat),
    }[form]
    held = given_survey(given)
    assert isinstance(held, Held)
    read = held.read()
    groups_used = [{p for p in s.paths() if not p.startswith("truth/")} for s in (read, from_file)]
    assert groups_used[0] == groups_used[1]
    for path in groups_used[0]:
        assert read[path].dims == from_file[path].dims
        assert read[path].attrs.get("units") == from_file[path].attrs.get("units")
        if form == "decoded" and path.endswith("time"):  # they went through whole nanoseconds
            np.testing.assert_allclose(read.values(path), from_file.values(path), rtol=0, atol=1e-9)
        else:
            assert np.array_equal(read.values(path), from_file.values(path))


@pytest.mark.long
def test_a_survey_in_memory_gives_the_same_bits(found: ClosedLoop, surveys: tuple[Path, Path]) -> None:
    again = magtensor.close_loop(read_canonical(surveys[0]), search=SEARCH)
    assert content(again) == content(found)
    assert again.verdict == found.verdict


@pytest.mark.long
def test_a_total_field_that_is_known_needs_no_reference(surveys: tuple[Path, Path], found: ClosedLoop) -> None:
    total = found.dataset["detrended/total_field"]
    alone = Survey(xr.DataTree.from_dict({"/array": read_canonical(surveys[0]).tree["array"].to_dataset()}))
    again = magtensor.close_loop(alone.merged({"total_field": total}), search=SEARCH)
    assert [a["error_model"] for a in again.verdict["adopted"]] == ["current_field"]


def test_the_calibration_is_the_one_that_apply_uses(
    tmp_path: Path, surveys: tuple[Path, Path], found: ClosedLoop
) -> None:
    file = found.calibration.save(tmp_path / "calibration.nc")
    by_command = apply(file, surveys[1], tmp_path / "applied.nc")
    expected = open_result(tmp_path / "applied.nc").values("calibrated/b")
    for calibration in (found.calibration, magtensor.Calibration.open(file)):
        for other in (surveys[1], read_canonical(surveys[1])):
            calibrated = calibration.apply(other)
            assert np.array_equal(calibrated["calibrated/b"], expected)
            assert calibrated.attrs["fit"] == by_command.sentence
    assert repr(found.calibration) == "<Calibration of S1, S2, S3, S4; linear, current_field>"


def test_a_result_from_memory_asks_for_its_survey(tmp_path: Path, surveys: tuple[Path, Path]) -> None:
    held = magtensor.close_loop(read_canonical(surveys[0]), search=[], most_effects=0)
    held.save(tmp_path / "held")
    with pytest.raises(magtensor.DataError, match="name it with --input"):
        run_recipe(tmp_path / "held" / "result.nc", tmp_path / "again")
    again = run_recipe(tmp_path / "held" / "result.nc", tmp_path / "again", survey=surveys[0])
    assert again.made_by.content_sha256 == content(held)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"most_efects": 3}, "did you mean most_effects"),
        ({"declared": ["temperature_ofset"]}, "did you mean temperature_offset"),
        ({"false_alarm": 2.0}, "false_alarm"),
        ({"plugins": ["nowhere"]}, "nowhere"),
    ],
)
def test_wrong_options(options: dict[str, object], words: str, surveys: tuple[Path, Path]) -> None:
    with pytest.raises(magtensor.UsageError, match=words):
        magtensor.close_loop(surveys[0], **options)  # type: ignore[arg-type]


@pytest.mark.long
def test_a_declared_drift_is_known_as_long_as_the_survey(surveys: tuple[Path, Path]) -> None:
    """Over an hour, of which it has seen ten minutes, it would be extrapolated wherever it is applied."""
    for declared, span_s in ((["offset_drift"], 599.5), ({"offset_drift": {"span_s": 900.0}}, 900.0)):
        made = magtensor.close_loop(surveys[0], declared=declared, search=[])
        (effect,) = [json.loads(str(text)) for text in made.dataset["calibration"]["effects"].values]
        assert effect["settings"]["span_s"] == span_s


def test_wrong_surveys(surveys: tuple[Path, Path]) -> None:
    with pytest.raises(magtensor.UsageError, match="not ndarray"):
        magtensor.close_loop(np.zeros(3))  # type: ignore[arg-type]
    with pytest.raises(magtensor.DataError, match="there is no dataset time"):
        magtensor.close_loop(xr.Dataset({"b_raw": (("time", "sensor", "axis"), np.zeros((5, 4, 3)))}))
    with pytest.raises(magtensor.UsageError, match="the survey itself"):
        magtensor.close_loop(surveys[0], verify=surveys[0])


def test_importing_is_light() -> None:
    heavy = ("scipy", "xarray", "matplotlib", "pydantic", "h5py")
    code = (
        "import sys, magtensor\n"
        "assert 'close_loop' in dir(magtensor) or 'close_loop' in magtensor.__all__\n"
        f"print([m for m in {heavy!r} if m in sys.modules])"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "[]"


JUMPS: dict[str, dict[str, Any]] = {
    "offset_step": {"time_s": [300.0]},
    "scale_step": {"time_s": [300.0]},
    "turn_step": {"time_s": 300.0},
}


@pytest.mark.long
@pytest.mark.parametrize("effect", JUMPS)
def test_a_jump_lasts_into_later_surveys(effect: str, tmp_path: Path) -> None:
    """The same sensors' last minutes as a survey of their own, whose start lies after the jump."""
    jump = {"type": effect, "rms_nT": 3.0, "sensors": ["S2"]} | JUMPS[effect]
    whole = survey_file(tmp_path, scenario(5, jump, motion=scenario()["motion"] | {"duration_s": 600.0}))
    later = tmp_path / "later.h5"
    with h5py.File(whole) as old, h5py.File(later, "w") as new:
        keep = old["time"][:] > 350.0
        names = [n for n, o in old.items() if isinstance(o, h5py.Dataset)]
        for name in (*names, "reference/time", "reference/total_field"):
            item = old[name]
            new[name] = item[keep] if item.shape[:1] == keep.shape else item[()]
            if "units" in item.attrs:
                new[name].attrs["units"] = item.attrs["units"]
    found = magtensor.close_loop(whole, search=list(JUMPS))
    assert [(a["error_model"], a["sensors"]) for a in found.verdict["adopted"]] == [(effect, ["S2"])]
    b = found.calibration.apply(later)["calibrated/b"].values
    contrast = b - b.mean(axis=1, keepdims=True)
    assert np.sqrt(np.mean(contrast**2)) < 1.3 * 0.15
