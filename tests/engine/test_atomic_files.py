"""Result files are whole or absent, whenever the process ends."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from magtensor.atomic import atomic_path, atomic_set, write_text
from magtensor.cli import status_of

PLUGIN = '''
@stage(needs=("b_raw",), gives=("calibrated/b", "calibration/name"))
def copy_field(survey, *, act: Annotated[str, Field(description="how to end")] = ""):
    """Copy."""
    names = {"calibration/name": (("sensor",), np.array(["a", "b"]), {})}
    if act == "refuse":
        raise DataError("not enough")
    if act == "bug":
        raise ZeroDivisionError
    if act == "unwritable":
        return names | {"calibrated/b": (("time",), np.array([object()] * 4), {})}
    if act.startswith("die at"):
        import os
        count = [int(act.split()[-1])]
        replace = os.replace
        def dying(*names):
            if count[0] == 0:
                os._exit(9)
            count[0] -= 1
            return replace(*names)
        os.replace = dying
    b = survey.values("b_raw")
    return names | {"calibrated/b": (("time", "sensor", "axis"), b, {})}
'''


@pytest.fixture
def own(bench):
    bench.plugin(PLUGIN)
    assert bench.run("  - start\n  - copy_field\n") == 0
    return bench


def contents(bench) -> dict[str, bytes]:
    return {f.name: f.read_bytes() for f in (bench.folder / "out").iterdir()}


@pytest.mark.parametrize(("act", "status"), [("refuse", 3), ("bug", None), ("unwritable", None)])
def test_a_failed_run_leaves_the_old_result(own, act, status):
    before = contents(own)
    if status is None:
        with pytest.raises(Exception):  # noqa: B017 (a bug keeps whatever it raised)
            own.run(f"  - start\n  - copy_field: {{act: {act}}}\n")
    else:
        assert own.run(f"  - start\n  - copy_field: {{act: {act}}}\n") == status
    assert contents(own) == before


@pytest.mark.parametrize("step", range(4))
def test_a_run_that_dies_while_its_files_move_in(own, step):
    """Killed before, between or after the renames: `result.nc` is there only with all the files of its own run."""
    old = contents(own)
    recipe = own.recipe(f"  - start: {{value: 5}}\n  - copy_field: {{act: die at {step}}}\n")
    command = [sys.executable, "-m", "magtensor", "run", str(recipe), "--output", str(own.folder / "out")]
    ended = subprocess.run(command, capture_output=True)
    now = {name: content for name, content in contents_of_files(own).items() if not name.startswith(".")}
    names = sorted(n for n in old)
    if ended.returncode == 9:
        assert "result.nc" not in now or now == old
    else:
        assert ended.returncode == 0 and sorted(now) == names and now["result.nc"] != old["result.nc"]
    assert own.run("  - start\n  - copy_field\n") == 0, "what a killed run left is in nobody's way"
    assert "result.nc" in contents_of_files(own)


def contents_of_files(bench) -> dict[str, bytes]:
    return {f.name: f.read_bytes() for f in (bench.folder / "out").iterdir() if f.is_file()}


def test_set_moves_the_last_file_last_and_takes_it_away_first(tmp_path, monkeypatch):
    moved = []
    replace = os.replace
    (tmp_path / "z").write_text("old")

    def watched(source, target):
        moved.append((os.path.basename(target), (tmp_path / "m").exists()))
        replace(source, target)

    monkeypatch.setattr(os, "replace", watched)
    (tmp_path / "m").write_text("old")
    with atomic_set(tmp_path, last="m") as folder:
        for name in "zma":
            (folder / name).write_text("new")
        assert (tmp_path / "m").read_text() == "old"
    assert [name for name, _ in moved][-1] == "m" and len(moved) == 3
    assert not any(whole for _, whole in moved), "while files move in, the old set is not taken for whole"
    assert {f.name: f.read_text() for f in tmp_path.iterdir()} == {"a": "new", "m": "new", "z": "new"}


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_nothing_is_left_when_the_block_fails(tmp_path, error):
    (tmp_path / "x").write_text("old")
    with pytest.raises(error), atomic_path(tmp_path / "x") as temporary:
        temporary.write_text("half")
        raise error
    with pytest.raises(error), atomic_set(tmp_path, last="x") as folder:
        (folder / "x").write_text("half")
        raise error
    assert [f.name for f in tmp_path.iterdir()] == ["x"]
    assert (tmp_path / "x").read_text() == "old"


HALF_WRITTEN = """
import os, signal, sys
from pathlib import Path
from magtensor.atomic import atomic_path, atomic_set
folder = Path(sys.argv[1])
with atomic_set(folder, last="x") as partial, atomic_path(folder / "y") as temporary:
    (partial / "x").write_text("half")
    temporary.write_text("half")
    print("written", flush=True)
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_left_goes_with_the_next_run(tmp_path):
    """And only that: not what a living process is writing, nor what another machine's may be."""
    command = [sys.executable, "-c", HALF_WRITTEN, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"written\n"
        living = {f.name for f in tmp_path.iterdir()}
        assert len(living) == 2
        (tmp_path / f".partial-elsewhere-{process.pid}").mkdir()
        write_text(tmp_path / "y", "whole")
        with atomic_set(tmp_path, last="x"):
            assert living < {f.name for f in tmp_path.iterdir()}
        process.communicate()
    assert living < {f.name for f in tmp_path.iterdir()}, "killed, it took nothing away itself"
    with atomic_set(tmp_path, last="x") as folder:
        (folder / "x").write_text("whole")
    write_text(tmp_path / "y", "whole")
    assert {f.name for f in tmp_path.iterdir()} == {"x", "y", f".partial-elsewhere-{process.pid}"}


def test_text_is_written_whole(tmp_path):
    write_text(tmp_path / "deep/er/x.txt", "µT\n")
    assert (tmp_path / "deep/er/x.txt").read_bytes() == "µT\n".encode()
    assert [f.name for f in (tmp_path / "deep/er").iterdir()] == ["x.txt"]


@pytest.mark.parametrize("place", ["file.txt/out", "file.txt"])
def test_output_folder_that_cannot_be_is_a_message_before_the_run(own, place, capsys):
    (own.folder / "file.txt").write_text("in the way")
    recipe = own.recipe("  - start\n  - copy_field: {act: bug}\n")
    assert status_of(["run", str(recipe), "--output", str(own.folder / place)]) == 2
    assert "file.txt" in capsys.readouterr().err
