"""The command line as its users meet it: exit statuses, messages, no tracebacks, an answer at once."""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from magtensor import __version__
from magtensor.cli import cli, status_of

COMMANDS = sorted(cli.commands)


def magtensor(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "magtensor", *map(str, arguments)], capture_output=True, text=True)


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help(command, capsys):
    assert status_of([*command.split(), "--help"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("Usage: magtensor")
    for option in cli.commands[command].params if command else []:
        if option.param_type_name == "option":
            assert option.help, f"{command} {option.opts[0]} has no description"


def test_commands_of_the_contract():
    assert {"run", "apply", "batch", "validate", "inspect", "plugins", "simulate", "report"} <= set(COMMANDS)


@pytest.mark.parametrize(
    "arguments",
    [
        [], ["nonsense"], ["run"], ["run", "none.yaml"], ["run", "."], ["run", "r.yaml", "--nonsense"],
        ["validate", "none.yaml"], ["validate", "binary.yaml"], ["validate", "empty.yaml"], ["validate", "wrong.yaml"],
        ["batch", "none.yaml", "x", "--output", "o"], ["batch", "wrong.yaml", "x", "--output", "o"],
        ["batch", "wrong.yaml", "--output", "o"], ["batch", "wrong.yaml", "x"],
        ["batch", "wrong.yaml", "x", "--output", "o", "--workers", "0"], ["plugins", "no_such_stage"],
        ["plugins", "--plugins", "none"], ["simulate", "none.yaml", "--output", "s.h5"],
        ["simulate", "binary.yaml", "--output", "s.h5"], ["simulate", "wrong.yaml", "--output", "s.h5"],
        ["run", "wrong.yaml", "--set", "nonsense"],
    ],
)  # fmt: skip
def test_mistakes_on_the_command_line_are_status_2(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(bytes(range(128, 256)))
    (tmp_path / "empty.yaml").write_text("")
    (tmp_path / "wrong.yaml").write_text("stages: 5\n")
    status = status_of(arguments)
    said = capsys.readouterr()
    assert status == 2
    assert (said.err or said.out).strip()
    assert "Traceback" not in said.err
    assert sorted(f.name for f in tmp_path.iterdir()) == ["binary.yaml", "empty.yaml", "wrong.yaml"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["inspect", "none.h5"], ["inspect", "odd.h5"], ["apply", "none.nc", "odd.h5"], ["apply", "odd.h5", "odd.h5"],
        ["report", "none"], ["report", "empty"],
    ],
)  # fmt: skip
def test_files_that_are_not_there_or_not_what_they_should_be(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "odd.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(50))
    (tmp_path / "empty").mkdir()
    assert status_of(arguments) in (2, 3)
    assert "Traceback" not in capsys.readouterr().err


def test_statuses_through_a_process(bench):
    bench.plugin(
        "\n@stage(needs=('b_raw',))\ndef end(survey, *, how: Annotated[str, Field(description='x')]):\n    '''End.'''\n"
        "    if how == 'data': raise DataError('too weak', where='sensor S1', hint='stronger')\n"
        "    if how == 'bug': raise ZeroDivisionError('a slip')\n    return {}\n"
    )
    found = {}
    for how in ("well", "data", "bug"):
        recipe = bench.recipe(f"  - start\n  - end: {{how: {how}}}\n")
        found[how] = magtensor("run", recipe, "--output", bench.folder / "out")
    assert {how: done.returncode for how, done in found.items()} == {"well": 0, "data": 3, "bug": 1}
    assert found["data"].stderr == "error: sensor S1: too weak\n  stronger\n"
    assert "Traceback" in found["bug"].stderr and "in stage end, options {'how': 'bug'}" in found["bug"].stderr
    wrong = magtensor("run", bench.recipe("  - strat\n"))
    assert wrong.returncode == 2
    assert wrong.stderr.startswith("error: ") and "did you mean start?" in wrong.stderr


def test_apply_says_what_memory_is_refused_with(capsys):
    status_of(["apply", "--help"])
    said = "".join(capsys.readouterr().out.split())  # lines break at hyphens
    expected = "Refused with --refine-rotation and --save-calibration, and for a calibration that holds effects"
    assert expected.replace(" ", "") in said


def test_a_clone_of_the_same_name_does_not_stand_for_the_package(tmp_path):
    root = Path(__file__).parents[2]
    (tmp_path / "magtensor").symlink_to(root)
    code = "import magtensor; print(magtensor.__version__, magtensor.close_loop.__module__)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.split() == [__version__, "magtensor.closed_loop"], done.stderr
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    code = f"import sys; sys.path = [p for p in sys.path if 'magtensor' not in p]; {code}"
    bare = subprocess.run(
        [sys.executable, "-S", "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert "is a clone of magtensor, which is not installed here" in bare.stderr


def test_a_reader_that_closes_early_is_no_error():
    """As `| head -1` does; a status of 1 would be a bug."""
    nobody, end = os.pipe()
    os.close(nobody)
    done = subprocess.run([sys.executable, "-m", "magtensor", "plugins"], stdout=end, stderr=subprocess.PIPE, text=True)
    os.close(end)
    assert done.returncode == 141 and not done.stderr


def test_a_survey_in_place_of_a_calibration_is_one_message(tmp_path):
    with h5py.File(tmp_path / "survey.h5", "w") as file:
        file["b_raw"] = np.zeros((4, 2, 3))  # without named dimensions
    done = magtensor("apply", tmp_path / "survey.h5", tmp_path / "survey.h5")
    assert done.returncode == 2 and done.stderr.startswith("error: ") and "Warning" not in done.stderr


def test_a_study_tells_what_it_does_without_doing_it():
    study = Path(__file__).parents[2] / "studies" / "common_rotation.py"
    done = subprocess.run([sys.executable, str(study), "--help"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.startswith("usage: ")


def cpu_seconds(*arguments: str) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_help_costs_little_more_than_python_itself():
    """A ratio, for seconds depend on the machine; numpy alone would cost four bare starts more, xarray thirty."""
    bare = statistics.median(cpu_seconds("-c", "pass") for _ in range(7))
    shown = statistics.median(cpu_seconds("-m", "magtensor", "--help") for _ in range(7))
    assert shown < 5 * bare


def test_help_imports_nothing_heavy():
    source = (
        "import sys; from magtensor.cli import status_of; status_of(['--help']);"
        "print([m for m in ('numpy', 'pydantic', 'xarray', 'yaml', 'h5py', 'rich', 'pluggy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
