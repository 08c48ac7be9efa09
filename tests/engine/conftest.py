"""Recipes and single-file plugins in a temporary folder."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from magtensor.cli import status_of
from magtensor.errors import UsageError
from magtensor.recipe.plan import Plan, read_plan

HEAD = """
from typing import Annotated, Literal
import numpy as np
from magtensor import DataError, MethodChoice, MetricsChoice, method, metric, stage
from magtensor.survey.model import Survey
from pydantic import Field


@stage(gives=("time", "sensor", "axis", "b_raw"), may_give=("temperature",))
def start(survey, *, value: Annotated[float, Field(description="of every sample")] = 1.0):
    '''Make a survey of four samples.'''
    file = survey.source.files()[0]
    b = np.full((4, 2, 3), value) + float(file.read_text())
    return Survey.build({
        "time": (("time",), np.arange(4.0), {"units": "seconds since 2020-01-01T00:00:00Z"}),
        "sensor": (("sensor",), np.array(["S1", "S2"]), {}),
        "axis": (("axis",), np.array(["x", "y", "z"]), {}),
        "b_raw": (("time", "sensor", "axis"), b, {"units": "nT"}),
    })
"""


class Bench:
    """A folder with recipes, plugins and one survey."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.survey = folder / "survey.h5"
        self.survey.write_text("10", encoding="utf-8")

    def plugin(self, body: str, name: str = "own.py", head: str = HEAD) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(head + body, encoding="utf-8")
        return path

    def recipe(self, stages: str, top: str = "plugins: [own.py]") -> Path:
        path = self.folder / "recipe.yaml"
        path.write_text(f"title: test\n{top}\nsurvey: survey.h5\nstages:\n{stages}", encoding="utf-8")
        return path

    def plan(self, stages: str, *overrides: str, **options: Any) -> Plan:
        return read_plan(self.recipe(stages, **options), overrides=overrides)

    def mistakes(self, stages: str, *overrides: str, **options: Any) -> list[str]:
        """The lines of the refusal, the folder left out."""
        with pytest.raises(UsageError) as caught:
            self.plan(stages, *overrides, **options)
        return str(caught.value).replace(f"{self.folder}/", "").split("\n")

    def run(self, stages: str, *more: str) -> int:
        """The exit status of `magtensor run`."""
        output = str(self.folder / "out")
        return status_of(["run", str(self.recipe(stages)), "--output", output, *more])


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # no time for pictures
    return Bench(tmp_path)
