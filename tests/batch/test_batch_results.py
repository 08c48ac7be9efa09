"""What a batch leaves: results, records, exit statuses; what it does again and what it does not."""

from __future__ import annotations

import os

from magtensor import provenance
from magtensor.batch.process import THREADS
from magtensor.cli import status_of


def test_bad_surveys_stop_no_other(archive, capsys):
    """Every way to fail, side by side with surveys that are fine; one line for each failure, and exit status 4."""
    words = ("exit", "kill", "crash", "bug", "quit")
    names = [archive.survey(f"{word}.h5", word) for word in words]
    names += [archive.survey("text.h5", "1 x2 3"), archive.folder / "missing.h5", archive.folder / "none*.h5"]
    good = [archive.survey("first.h5"), archive.survey("last.h5", "4 5")]
    assert status_of(archive.arguments(good[0], *names, good[1])) == 4

    record = archive.record()
    assert {n: e["state"] for n, e in record.items()} == {
        **{f"{w}.h5": "failed" for w in (*words, "text", "missing")},
        "none*.h5": "failed", "first.h5": "done", "last.h5": "done",
    }  # fmt: skip
    expected = {"exit": 1, "kill": 137, "crash": 139, "bug": 1, "quit": 1, "text": 3, "missing": 3, "none*": 3}
    assert {n: record[f"{n}.h5"]["exit_status"] for n in expected} == expected
    assert "status 7" in record["exit.h5"]["message"]
    assert "SIGKILL" in record["kill.h5"]["message"]
    assert all(e["seconds"] > 0 and e["finished"] for n, e in record.items() if n in ("first.h5", "bug.h5"))

    assert "ZeroDivisionError: a slip of the pen" in (archive.output / "bug/error.txt").read_text()
    assert "string_at" in (archive.output / "crash/error.txt").read_text(), "where compiled code crashed"
    assert not (archive.output / "text").exists(), "wrong data are no bug, and nothing was written"

    said = capsys.readouterr()
    assert "Traceback" not in said.out + said.err
    listed = said.err.split("surveys failed:\n", 1)[1].splitlines()
    assert said.err.split("error: ", 1)[1].startswith("8 of 10 surveys failed:")
    assert len(listed) == 8
    for name, kind in [("text", "data, 3"), ("bug", "bug, 1"), ("kill", "killed"), ("missing", "data, 3")]:
        assert sum(f"{name}.h5 [{kind}]: " in line for line in listed) == 1
    assert sum(line.startswith("[") and "/10] " in line for line in said.out.splitlines()) == 10
    assert "2 of 10 surveys done, 8 failed" in said.out


def test_all_done_is_status_0_and_nothing_is_done_twice(archive, capsys):
    surveys = [archive.survey(f"{n}.h5", str(n)) for n in range(3)]
    assert status_of(archive.arguments(*surveys)) == 0
    before = {f: f.stat().st_mtime_ns for f in archive.output.rglob("*.nc")}
    assert len(before) == 6
    archive.forget_runs()
    assert status_of(archive.arguments(*surveys)) == 0
    assert archive.runs() == []
    assert {f: f.stat().st_mtime_ns for f in archive.output.rglob("*.nc")} == before
    assert "3 of 3 surveys done (3 of them before)" in capsys.readouterr().out


def test_result_is_that_of_run(archive):
    """A batch adds nothing to a result and takes nothing away."""
    survey = archive.survey("one.h5", "1 2 3 5")
    assert status_of(archive.arguments(survey)) == 0
    together = provenance.read(archive.output / "one/result.nc")
    assert archive.run_here(survey) == 0
    alone = provenance.read(archive.output / "one/result.nc")
    assert together.content_sha256 == alone.content_sha256
    assert together.recipe == alone.recipe
    assert together.inputs == alone.inputs


def test_changed_recipe_is_done_again_and_changed_back_too(archive):
    """The files on disk are the last recipe's: after changing back, they are not taken for the first one's."""
    survey = archive.survey("one.h5", "1 2")
    hashes, reasons = [], []
    for factor in (1.0, 2.0, 1.0, 1.0):
        archive.write_recipe(factor=factor)
        archive.forget_runs()
        assert status_of(archive.arguments(survey)) == 0
        hashes.append(provenance.read(archive.output / "one/result.nc").content_sha256)
        reasons.append((archive.record()["one.h5"]["why"], archive.runs()))
    assert hashes[0] == hashes[2] == hashes[3] != hashes[1]
    changed = "recipe changed: stages[0].read_numbers.factor"
    assert reasons == [
        ("no result yet", ["one.h5"]), (changed, ["one.h5"]), (changed, ["one.h5"]), (changed, [])
    ]  # fmt: skip


def test_lost_or_damaged_record_loses_no_result(archive, capsys):
    survey = archive.survey("one.h5")
    record = archive.output / "batch.json"
    assert archive.run_here(survey) == 0
    archive.forget_runs()
    for content in (None, "{", '{"surveys": [{"folder": 1}]}', "[]"):
        if content is not None:
            record.write_text(content)
        assert status_of(archive.arguments(survey)) == 0
        assert archive.record()["one.h5"]["state"] == "done"
        assert ("cannot be read" in capsys.readouterr().out) == (content is not None)
    assert archive.runs() == []


def test_failure_keeps_the_older_result_and_says_so(archive):
    survey = archive.survey("one.h5", "1 2")
    assert archive.run_here(survey) == 0
    good = (archive.output / "one/result.nc").read_bytes()
    archive.survey("one.h5", "bug 1 2")
    assert status_of(archive.arguments(survey)) == 4
    entry = archive.record()["one.h5"]
    assert entry["state"] == "failed"
    assert "result.nc in one is an older one: input changed: one.h5" in entry["message"]
    assert (archive.output / "one/error.txt").is_file()
    assert (archive.output / "one/result.nc").read_bytes() == good

    archive.survey("one.h5", "1 2")
    archive.forget_runs()
    assert status_of(archive.arguments(survey)) == 0
    assert archive.runs() == []
    assert archive.record()["one.h5"]["state"] == "done"
    assert not (archive.output / "one/error.txt").exists(), "of a failure that is no longer one"


def test_wrong_recipe_is_status_2_before_anything_runs(archive, capsys):
    survey = archive.survey("one.h5")
    archive.write_recipe(factr=2.0)
    assert status_of(archive.arguments(survey)) == 2
    assert "factor" in capsys.readouterr().err
    assert archive.runs() == []
    assert not archive.output.exists()


def test_output_that_cannot_be_written_is_status_2(archive, capsys):
    survey = archive.survey("one.h5")
    archive.output = archive.survey("file.txt") / "out"
    assert status_of(archive.arguments(survey)) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_folder_that_cannot_be_written_fails_its_survey_only(archive):
    surveys = [archive.survey("one.h5"), archive.survey("two.h5")]
    archive.output.mkdir()
    (archive.output / "one").write_text("in the way")
    assert status_of(archive.arguments(*surveys)) == 4
    record = archive.record()
    assert record["one.h5"]["state"] == "failed"
    assert "cannot be written" in record["one.h5"]["message"]
    assert record["two.h5"]["state"] == "done"


def test_each_survey_has_its_own_process_with_one_thread(archive, monkeypatch):
    for name in THREADS:
        monkeypatch.delenv(name, raising=False)
    assert status_of(archive.arguments(archive.survey("one.h5"), archive.survey("two.h5"))) == 0
    assert len({process for _, process, _ in archive.begun()} - {os.getpid()}) == 2
    assert [threads for _, _, threads in archive.begun()] == ["1", "1"]
    archive.forget_runs()
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    assert status_of(archive.arguments(archive.survey("three.h5"))) == 0
    assert [threads for _, _, threads in archive.begun()] == ["2"], "what the user sets is the user's"


def test_surveys_of_the_same_stem_do_not_mix(archive):
    surveys = [archive.survey(f"{day}/survey.h5", number) for day, number in (("mon", "1"), ("tue", "2"))]
    assert status_of(archive.arguments(*surveys)) == 0
    folders = sorted(f.name for f in archive.output.iterdir() if f.is_dir())
    assert folders == ["mon-survey", "tue-survey"]
    for day in ("mon", "tue"):
        made_from = provenance.read(archive.output / f"{day}-survey/result.nc").inputs[0]["path"]
        assert made_from == str(archive.folder / day / "survey.h5")
    archive.survey("wed/survey.h5", "3")
    archive.forget_runs()
    assert status_of(archive.arguments(archive.folder / "*/survey.h5")) == 0
    assert archive.runs() == ["survey.h5"], "those that are done keep their folders"
