"""A small archive: surveys as text files, and a recipe whose one stage comes from a single-file plugin."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from magtensor.batch.freshness import why_run
from magtensor.cli import status_of
from magtensor.recipe.plan import read_plan

PLUGIN = '''
"""Reads a survey of one number per line; some contents make it fail in every way there is."""
import os, signal, sys, time
from pathlib import Path
from typing import Annotated
import numpy as np
from magtensor import DataError, stage
from magtensor.survey.model import Survey
from pydantic import Field

sys.modules.setdefault("matplotlib", None)  # as where the extra `report` is not installed: no time for pictures


def act(word, log):
    if word == "exit":
        os._exit(7)
    if word == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if word == "crash":
        import ctypes
        ctypes.string_at(0)
    if word == "bug":
        raise ZeroDivisionError("a slip of the pen")
    if word == "quit":
        sys.exit("the plugin leaves")
    if word == "wait":
        (log.parent / "waiting").touch()
        while not (log.parent / "go").exists():
            time.sleep(0.02)


@stage(gives=("time", "sensor", "axis", "b_raw", "calibration/*", "calibrated/*"))
def read_numbers(
    survey, *, factor: Annotated[float, Field(description="times what is read")] = 1.0,
    log: Annotated[str, Field(description="file that counts the runs")],
):
    """Read the numbers."""
    file = survey.source.files()[0]
    words = file.read_text().split()
    with open(log, "a") as stream:
        stream.write(f"{file.name} {os.getpid()} {os.environ.get('OPENBLAS_NUM_THREADS')}\\n")
    print("a print must not disturb the batch")
    if words and words[0].isalpha():
        act(words[0], Path(log))
    try:
        x = np.array([float(w) for w in words if not w.isalpha()])
    except ValueError as error:
        raise DataError(f"not a number: {error}", where=file.name) from error
    b = np.multiply.outer(x, np.ones((2, 3))) * factor
    return Survey.build({
        "time": (("time",), np.arange(len(x), dtype=float), {"units": "seconds since 2020-01-01T00:00:00Z"}),
        "sensor": (("sensor",), np.array(["S1", "S2"]), {}),
        "axis": (("axis",), np.array(["x", "y", "z"]), {}),
        "b_raw": (("time", "sensor", "axis"), b, {"units": "nT"}),
        "calibrated/b": (("time", "sensor", "axis"), b + 1, {"units": "nT"}),
        "calibration/name": (("sensor",), np.array(["a", "b"]), {}),
        "calibration/fit_rms": (("sensor",), np.array([np.nan, 1.5]), {"units": "nT"}),
        "calibration/used": (("sensor",), np.array([True, False]), {}),
    })
'''


class Archive:
    """The files of one test, and the command line that is run on them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.output = folder / "out"
        self.log = folder / "log.txt"
        self.recipe = folder / "recipe.yaml"
        (folder / "numbers.py").write_text(PLUGIN, encoding="utf-8")
        self.write_recipe(factor=1.0)

    def write_recipe(self, **options: Any) -> None:
        options = {"log": str(self.log), **options}
        recipe = {"title": "numbers", "plugins": ["numbers.py"], "stages": [{"read_numbers": options}]}
        self.recipe.write_text(json.dumps(recipe, indent=1), encoding="utf-8")

    def survey(self, name: str, content: str = "1 2 3") -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, encoding="utf-8")
        return path

    def arguments(self, *surveys: object, workers: int = 2, more: tuple[str, ...] = ()) -> list[str]:
        names = [str(s) for s in surveys]
        return ["batch", str(self.recipe), *names, "--output", str(self.output), "--workers", str(workers), *more]

    def run_here(self, survey: Path, *more: str) -> int:
        """Run one survey without a batch, in this process, into its folder of the batch."""
        output = str(self.output / survey.stem)
        return status_of(["run", str(self.recipe), "--input", str(survey), "--output", output, *more])

    def why(self, survey: Path, *overrides: str) -> str:
        """Why a batch would run the survey; nothing where it is done."""
        return why_run(self.output / survey.stem, read_plan(self.recipe, survey=survey, overrides=overrides))

    def record(self) -> dict[str, dict[str, Any]]:
        """The entries of batch.json by the survey's file name."""
        stored = json.loads((self.output / "batch.json").read_text(encoding="utf-8"))
        return {Path(e["survey"]).name: e for e in stored["surveys"]}

    def begun(self) -> list[tuple[str, int, str]]:
        """Survey, process and OPENBLAS_NUM_THREADS of each run that was begun, in order."""
        lines = self.log.read_text(encoding="utf-8").splitlines() if self.log.exists() else []
        return [(name, int(process), threads) for name, process, threads in (line.split(" ") for line in lines)]

    def runs(self) -> list[str]:
        """The surveys that were begun since `forget_runs`, sorted."""
        return sorted(name for name, _, _ in self.begun())

    def forget_runs(self) -> None:
        self.log.unlink(missing_ok=True)


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Archive:
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # not left to the plugin, which would set it for all tests
    return Archive(tmp_path)
