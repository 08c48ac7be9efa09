"""The loop by hand: `magtensor.explore` and the command of that name."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from loop_cases import scenario, survey_file

import magtensor
from magtensor.cli import status_of
from magtensor.explorer import Explorer
from magtensor.loop.decisions import Decision, decision_of
from magtensor.recipe.source import load_yaml
from magtensor.result import FILES
from magtensor.session import run_recipe

HEATER = {"type": "current_field", "rms_nT": 5.0, "channel": "current_heater"}
SEARCH = ["current_field", "offset_drift", "channel_response"]
PLUGIN = '''"""The heater's field."""
from magtensor import error_model


@error_model("instrument", needs=("current_heater",), source="diagram", typical="nT/A")
def heater_field(x):
    """The stray field of the heater."""
    return x.offsets(x.channel("current_heater"){factor}, "nT/A")
'''
NOISE_NT = 0.15


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    shorter = scenario()["motion"] | {"duration_s": 400.0}
    return survey_file(tmp_path_factory.mktemp("survey"), scenario(5, HEATER, motion=shorter))


@pytest.fixture
def explorer(survey: Path) -> Explorer:
    return magtensor.explore(survey, search=SEARCH, most_effects=2)


def rms(explorer: Explorer) -> float:
    return float(np.sqrt((explorer.residual["total_field"] ** 2).mean()))


def test_look_adopt_look_again_undo(explorer: Explorer) -> None:
    before = rms(explorer)
    assert explorer.left_over()["present"]
    ranking = explorer.ranking()
    assert ranking.index[0] in ("current_field", "channel_response")
    assert ranking.loc["current_field", "passes"]
    told = explorer.adopt("current_field")
    assert "significant, and predicts held-out blocks" in told
    assert rms(explorer) < 1.5 * NOISE_NT < before / 3
    assert not explorer.left_over()["present"]
    assert explorer.undo() == "adopt current_field"
    assert rms(explorer) == before
    assert explorer.decisions == []
    with pytest.raises(magtensor.UsageError, match="nothing to undo"):
        explorer.undo()


@pytest.mark.long
def test_the_result_says_who_did_what_and_can_be_made_again(tmp_path: Path, explorer: Explorer, survey: Path) -> None:
    explorer.reject("channel_response")
    explorer.adopt("offset_drift", order=1)
    explorer.run_loop()
    finished = explorer.save(tmp_path / "out")
    assert {f.name for f in (tmp_path / "out").iterdir()} == set(FILES)
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    adopted = {a["error_model"]: a for a in verdict["adopted"]}
    assert {n: a["by"] for n, a in adopted.items()} == {"offset_drift": "person", "current_field": "loop"}
    assert "not adopted by the loop: not significant" in adopted["offset_drift"]["evidence"]["judged"]
    assert adopted["offset_drift"]["settings"]["order"] == 1
    by_hand = [r for r in verdict["rejected"] if r["by"] == "person"]
    assert [r["error_model"] for r in by_hand] == ["channel_response"]
    assert "significant, and predicts held-out blocks" in by_hand[0]["why"]
    assert [d["decision"] for d in verdict["decisions"]] == [
        "reject channel_response", "adopt offset_drift order=1", "loop",
    ]  # fmt: skip
    assert "traced to current_field; adopted by hand: offset_drift" in finished.sentence
    page = (tmp_path / "out" / "report.html").read_text()
    assert "round by round" in page and page.count("<li>adopted current_field") == 1
    assert "offset_drift (by hand)" in page and "<code>reject channel_response</code>" in page
    again = run_recipe(tmp_path / "out" / "result.nc", tmp_path / "again")
    assert again.notes[0] == "reproduced bit for bit"
    assert json.loads((tmp_path / "again" / "verdict.json").read_text()) == verdict


@pytest.mark.long
def test_the_loop_alone_is_close_loop(explorer: Explorer, survey: Path) -> None:
    explorer.run_loop()
    by_itself = magtensor.close_loop(survey, search=SEARCH, most_effects=2)
    assert explorer.verdict() == by_itself.computed.outcome
    assert "decisions" not in by_itself.verdict


@pytest.mark.long
def test_what_was_adopted_can_be_rejected(explorer: Explorer) -> None:
    explorer.run_loop()
    found = rms(explorer)
    name = explorer.decisions[0][1].removeprefix("adopted ")
    told = explorer.reject(name)
    assert "taken out again" in told and rms(explorer) > 3 * found
    assert name not in explorer.ranking().index
    with pytest.raises(magtensor.UsageError, match="rejected already"):
        explorer.reject(name)
    explorer.adopt(name)  # a person may think again
    assert rms(explorer) == pytest.approx(found, rel=0.02)
    assert not explorer._inquiry.now.rejected


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("curent_field", {}, "did you mean current_field"),
        ("current_field", {"chanel": "x"}, "did you mean channel"),
        ("current_field", {"channel": "current_pump"}, "did you mean current_heater"),
        ("offset_drift", {"order": "two"}, "offset_drift: order"),
        ("supply_scale", {}, "no error model is called"),
    ],
)
def test_a_mistake_changes_nothing(explorer: Explorer, name: str, settings: dict[str, Any], words: str) -> None:
    with pytest.raises((magtensor.UsageError, magtensor.DataError), match=words):
        explorer.adopt(name, **settings)
    assert explorer.decisions == [] and explorer.adopted == []


def test_a_source_that_the_log_shows_is_none_that_nobody_logged(survey: Path) -> None:
    with pytest.raises(magtensor.DataError, match="taken off: its waveform goes as channel current_heater"):
        magtensor.explore(survey, search=["latent_source"]).adopt("latent_source")


def test_a_model_without_its_channel(survey: Path) -> None:
    with pytest.raises(magtensor.DataError, match=r"supply_scale needs supply\*.*logs current_heater, temperature"):
        magtensor.explore(survey, search=["supply_scale"]).adopt("supply_scale")


@pytest.mark.long
def test_a_plugin_file_is_named_changed_and_named_again(tmp_path: Path, explorer: Explorer) -> None:
    file = tmp_path / "heater.py"
    file.write_text(PLUGIN.format(factor=""))
    explorer.reject("channel_response")
    explorer.run_loop()  # which knows nothing of the plugin yet
    assert explorer.load_plugin(file) == ["heater_field"]
    assert explorer.decisions[-1][0] == "loop without heater_field"
    explorer.undo()
    explorer.adopt("heater_field")
    scale = first_coefficient(explorer)
    assert explorer.load_plugin(file) == []
    file.write_text(PLUGIN.format(factor=" * 2.0"))
    assert explorer.load_plugin(file) == ["heater_field"]
    assert first_coefficient(explorer) == pytest.approx(scale / 2, rel=1e-6)
    for text in ("this is no Python", PLUGIN.format(factor=".nothing")):
        file.write_text(text)
        with pytest.raises(magtensor.UsageError, match="heater"):
            explorer.load_plugin(file)
        assert first_coefficient(explorer) == pytest.approx(scale / 2, rel=1e-6)
    file.write_text(PLUGIN.format(factor=" * 2.0"))
    explorer.save(tmp_path / "out")
    assert run_recipe(tmp_path / "out" / "result.nc", tmp_path / "again").notes[0] == "reproduced bit for bit"


CONSTANT = '''"""A constant."""
import numpy as np
from magtensor import error_model


@error_model("instrument", source="diagram", typical="nT")
def constant(x):
    """What the offset contains."""
    return x.offsets(np.ones(len(x.time)), "nT")
'''
PARTLY = '''"""Half of it a constant."""
import numpy as np
from magtensor import error_model
from magtensor.error_models.terms import joined


@error_model("instrument", needs=("current_heater",), source="diagram", typical="nT")
def partly(x):
    """The heater's field, and what the offset contains."""
    heater = x.offsets(x.channel("current_heater"), "nT/A", "heater ")
    return joined([heater, x.offsets(np.ones(len(x.time)), "nT", "constant ")])
'''


@pytest.mark.long
def test_what_the_calibration_has_already_is_refused(tmp_path: Path, explorer: Explorer) -> None:
    file = tmp_path / "constant.py"
    file.write_text(CONSTANT)
    assert explorer.load_plugin(file) == ["constant"]
    explorer.adopt("offset_drift", order=1)
    before = rms(explorer)
    with pytest.raises(magtensor.DataError, match="constant cannot be told from the calibration as it is"):
        explorer.adopt("constant")
    assert [a.split()[0] for a in explorer.adopted] == ["offset_drift"] and rms(explorer) == before
    words = explorer.left_over()["description"]  # the loop has not run: what the ranking lets pass is of use
    passing = {str(n) for n, row in explorer.ranking().iterrows() if row["passes"]}
    assert passing
    of_use = words.split("significant, predicts held-out blocks and is not adopted: ")[1].split("; ")[0]
    assert passing & {each.split(" at ")[0] for each in of_use.split(", ")}
    if "of no use on held-out blocks: " in words:
        useless = words.split("of no use on held-out blocks: ")[1].split("; ")[0].split(", ")
        assert not passing & {each.split(" at ")[0] for each in useless}
    partly = tmp_path / "partly.py"
    partly.write_text(PARTLY)
    assert explorer.load_plugin(partly) == ["partly"]
    told = explorer.adopt("partly")  # four sensors of three axes: the constants are offsets, the heater's field is new
    assert "of the 24 directions of its coefficients 12 can be told from the calibration as it is" in told
    assert "directions of its coefficients" not in explorer.decisions[0][1]


def test_messages_of_what_is_refused(tmp_path: Path, survey: Path) -> None:
    explorer = magtensor.explore(survey, search=["temperature_offset"])
    with pytest.raises(magtensor.DataError, match="cannot be told from the calibration"):
        explorer.adopt("temperature_offset", lag_s=1e9)
    explorer.adopt("temperature_offset", lag_s=100.0)
    for settings in ({"lag_s": 50.0}, {"lag_s": 50.0, "channel": "temperature"}):
        with pytest.raises(magtensor.UsageError, match="is adopted already; reject it or undo first"):
            explorer.adopt("temperature_offset", **settings)
    with pytest.raises(magtensor.UsageError, match="given by its name"):
        explorer.adopt(None)  # type: ignore[arg-type]
    (tmp_path / "nothing.py").write_text("x = 1\n")
    with pytest.raises(magtensor.UsageError, match="gives no error model: mark a function"):
        explorer.load_plugin(tmp_path / "nothing.py")
    assert len(explorer.decisions) == 1


def first_coefficient(explorer: Explorer) -> float:
    state = explorer._inquiry.now.state
    return float(state.theta[0][0])


@pytest.mark.parametrize(
    ("text", "decision"),
    [
        ("adopt a", Decision("adopt", "a")),
        ("adopt a lag_s=1.5 channel=current_x", Decision("adopt", "a", {"lag_s": 1.5, "channel": "current_x"})),
        ("adopt a on=true name='two words'", Decision("adopt", "a", {"on": True, "name": "two words"})),
        ("adopt a name='\"7\"'", Decision("adopt", "a", {"name": "7"})),
        ("reject a", Decision("reject", "a")),
        ("loop", Decision("loop")),
        ("loop without a b", Decision("loop", without=("a", "b"))),
    ],
)
def test_decisions_as_text(text: str, decision: Decision) -> None:
    assert decision_of(text) == decision
    assert decision_of(str(decision)) == decision


@pytest.mark.parametrize(
    "text", ["", "adopt", "adopt x=1", "adopt a b", "adopt a x=1 x=2", "reject a x=1", "lop", "loop x", "adopt 'a"]
)
def test_texts_that_are_no_decisions(text: str) -> None:
    with pytest.raises(magtensor.UsageError):
        decision_of(text)


def converse(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    file: Path,
    *commands: str,
    options: tuple[str, ...] = (),
) -> tuple[int, str]:
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(commands) + "\n"))
    status = status_of(["explore", str(file), *options])
    said = capsys.readouterr()
    assert "Traceback" not in said.out + said.err
    return status, said.out


@pytest.fixture
def recipe(tmp_path: Path, survey: Path) -> Path:
    """A recipe with few error models, so that the session is quick."""
    path = tmp_path / "few.yaml"
    loop = {"close_loop": {"search": ["current_field", "offset_drift"]}}
    stages = ["load", {"detrend_diurnal": {"uncovered": "mask"}}, loop, "assemble_tensor"]
    path.write_text(yaml.safe_dump({"title": "few", "survey": str(survey), "stages": stages}))
    return path


@pytest.mark.long
def test_a_session_that_is_piped_in(
    tmp_path: Path, recipe: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.py").write_text(PLUGIN.format(factor=".nothing").replace("heater_field", "bad"))
    commands = (
        "help", "residual", "ranking", "nonsense", "adopt", "adopt curent_field", "load", "load bad.py", "load nowhere",
        "show current_field", "adopt current_field channel=current_heater", "verdict", "reject offset_drift  # enough",
        "undo", "status",
    )  # fmt: skip
    status, said = converse(monkeypatch, capsys, recipe, *commands)
    assert status == 2  # something was refused
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(errors) == 6
    assert "did you mean current_field" in errors[2] and "bad fails on this survey" in errors[4]
    session = tmp_path / "few.session-1.yaml"
    assert "not saved as a result" in said and session.name in said
    assert yaml.safe_load(session.read_text())["stages"][2]["close_loop"]["decisions"] == [
        "adopt current_field channel=current_heater"
    ]
    # taken up again, in the same file
    status, said = converse(monkeypatch, capsys, session, "status", "save", "quit", "never reached")
    assert status == 0 and "never reached" not in said
    assert "1. adopt current_field channel=current_heater: significant, and predicts" in said
    assert "Adopted by hand: current_field" in said and "not saved" not in said
    verdict = json.loads((tmp_path / "few.session-1.explored" / "verdict.json").read_text())
    assert [a["by"] for a in verdict["adopted"]] == ["person"]
    # and run as the recipe that it is
    assert status_of(["run", str(session), "--output", "by_run"]) == 0
    assert json.loads((tmp_path / "by_run" / "verdict.json").read_text()) == verdict


@pytest.mark.long
def test_a_session_with_another_survey_is_another_session(
    tmp_path: Path, survey: Path, recipe: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    converse(monkeypatch, capsys, recipe, "adopt offset_drift order=1")
    first = tmp_path / "few.session-1.yaml"
    before = first.read_text()
    other = tmp_path / "other.h5"
    other.write_bytes(survey.read_bytes())
    status, said = converse(
        monkeypatch,
        capsys,
        first,
        "reject current_field",
        "save a b",
        "show",
        "save 'a",
        options=("--input", "other.h5"),
    )
    assert status == 2 and first.read_text() == before
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert "write `save [FOLDER]`" in errors[0] and "write `show NAME`" in errors[1] and "cannot be read" in errors[2]
    second = yaml.safe_load((tmp_path / "few.session-2.yaml").read_text())
    assert Path(second["survey"]["file"]) == other
    assert second["stages"][2]["close_loop"]["decisions"] == ["adopt offset_drift order=1", "reject current_field"]


def test_decisions_that_no_file_holds(
    tmp_path: Path, recipe: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(path: Path, text: str) -> None:
        raise magtensor.DataError("no space left")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("magtensor.prompt.write_text", fail)
    status, said = converse(monkeypatch, capsys, recipe, "reject current_field")
    assert status == 2
    assert "no file holds the decisions: reject current_field" in said and "takes them up" not in said


def test_a_verification_survey_is_looked_at_first(
    tmp_path: Path, survey: Path, recipe: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    magtensor.explore(survey, search=["offset_drift"]).save(tmp_path / "out")
    for verify, status, words in (
        (survey, 2, "this is the survey itself"),
        (tmp_path / "nowhere.h5", 3, "nowhere.h5"),
        (tmp_path / "out" / "result.nc", 3, "a result of magtensor, not a survey"),
    ):
        assert status_of(["explore", str(recipe), "--verify", str(verify)]) == status
        said = capsys.readouterr()
        assert words in said.err and "`help`" not in said.out


def test_a_bug_or_a_stop_costs_one_line(
    tmp_path: Path, recipe: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    faults = iter([ZeroDivisionError("a plugin's bug"), KeyboardInterrupt()])

    def fail(self: Explorer) -> None:
        raise next(faults)

    monkeypatch.setattr(Explorer, "ranking", fail)
    status, said = converse(monkeypatch, capsys, recipe, "ranking", "ranking", "status")
    assert status == 2
    assert "error: ZeroDivisionError: a plugin's bug (" in said
    assert "error: stopped; nothing has changed" in said
    assert "0 decisions" in said.split("stopped")[1]


def test_what_cannot_be_explored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "other.yaml").write_text(f"title: t\nsurvey: {tmp_path / 's.h5'}\nstages: [load]\n")
    assert status_of(["explore", str(tmp_path / "nowhere.h5")]) == 3
    assert status_of(["explore", str(tmp_path / "other.yaml")]) == 2
    assert "no stage close_loop" in capsys.readouterr().err


@pytest.mark.long
def test_a_session_holds_its_verification_survey(
    tmp_path: Path, survey: Path, recipe: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for number, name in enumerate(("verify.h5", "other.h5"), start=1):  # a copy is refused
        (tmp_path / name).write_bytes(survey.read_bytes())
        with h5py.File(tmp_path / name, "r+") as copy:
            copy["b_raw"][...] += 0.01 * np.random.default_rng(number).standard_normal(copy["b_raw"].shape)
    options = ("--verify", "verify.h5")
    converse(monkeypatch, capsys, recipe, "reject current_field", options=options)
    first = tmp_path / "few.session-1.yaml"
    written = first.read_text()
    assert yaml.safe_load(written)["verify"] == str(tmp_path / "verify.h5")
    session = Explorer(load_yaml(first), None)
    assert set(session.verdict()["error"]["verify"]) >= {"before", "after"}
    assert session.inputs == [survey, tmp_path / "verify.h5"]
    converse(monkeypatch, capsys, first, "reject offset_drift", options=options)
    assert yaml.safe_load(first.read_text())["verify"] == str(tmp_path / "verify.h5")
    assert not (tmp_path / "few.session-2.yaml").exists()
    converse(monkeypatch, capsys, first, "status", options=("--verify", "other.h5"))
    assert yaml.safe_load((tmp_path / "few.session-2.yaml").read_text())["verify"] == str(tmp_path / "other.h5")
    assert yaml.safe_load(first.read_text())["verify"] == str(tmp_path / "verify.h5")
