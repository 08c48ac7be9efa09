"""The three recipes that hostile surveys are given to, and what every refusal must keep to."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from hostile_surveys import SCENARIO, Contents, calibration_error, contents_of, true_field

from magtensor import result
from magtensor.cli import status_of

STAGES: dict[str, list[Any]] = {
    "chi": [
        "load", "detrend_diurnal", {"calibrate_scalar": {"method": "chi2017"}}, "align", "assemble_tensor", "qc",
    ],
    "li": ["load", "detrend_diurnal", {"calibrate_array": {"method": "li2018"}}, "assemble_tensor", "qc"],
    "joint": [
        "load", {"detrend_diurnal": {"uncovered": "mask"}}, "calibrate_joint",
        "assemble_tensor", "qc",
    ],
}  # fmt: skip
# Words of the libraries underneath, which tell a geophysicist nothing.
JARGON = re.compile(
    r"Traceback|numpy|xarray|h5py|h5netcdf|dtype|ndarray|broadcast|<U\d|float64|array\(|Errno|synchronously|LinAlg"
)


@dataclass(frozen=True)
class Outcome:
    """What a command did."""

    status: int
    out: str
    error: str
    folder: Path

    def refused(self, *patterns: str, status: int = 3) -> None:
        """One message that holds these patterns, no jargon, and nothing written."""
        assert self.status == status, f"exit {self.status}: {self.out}{self.error}"
        assert self.error.count("error: ") == 1
        assert self.error.startswith("error: ")
        assert not JARGON.search(self.error), self.error
        assert len(self.error) < 2000
        for pattern in patterns:
            assert re.search(pattern, self.error), f"{pattern!r} is not in {self.error!r}"
        assert not self.folder.is_dir() or not list(self.folder.iterdir()), "a refused run leaves no files"

    def succeeded(self) -> Outcome:
        assert self.status == 0, f"exit {self.status}: {self.error}"
        assert self.error == ""
        return self

    @property
    def flags(self) -> list[dict[str, Any]]:
        """The flag record."""
        with h5py.File(self.folder / result.RESULT) as file:
            out: list[dict[str, Any]] = json.loads(file["qc"].attrs["flag_record"])
        return out

    @property
    def verdicts(self) -> dict[str, str]:
        """State of every QC metric."""
        with h5py.File(self.folder / result.RESULT) as file:
            names, states = file["qc/metric"].asstr()[()], file["qc/state"].asstr()[()]
        return dict(zip(names, states, strict=True))

    def error_against(self, truth: np.ndarray, time: np.ndarray) -> tuple[float, float, np.ndarray]:
        """Errors of the mean field and of the differences over the samples in use, and which those are (N,)."""
        with h5py.File(self.folder / result.RESULT) as file:
            group = file["calibrated"]
            b, good, own = group["b"][()], group["good"][()].astype(bool), group["time"][()]
        at = np.searchsorted(time, own)
        mean, difference = calibration_error(b[good], truth[at][good][:, : b.shape[1]])
        used = np.zeros(len(time), dtype=bool)
        used[at[good]] = True
        return mean, difference, used


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A survey without faults, 500 samples of four sensors, made by the simulator."""
    folder = tmp_path_factory.mktemp("sound")
    (folder / "scenario.yaml").write_text(yaml.safe_dump(SCENARIO), encoding="utf-8")
    assert status_of(["simulate", str(folder / "scenario.yaml"), "--output", str(folder / "sound.nc")]) == 0
    return folder / "sound.nc"


@pytest.fixture(scope="session")
def sound_contents(sound: Path) -> Contents:
    return contents_of(sound)


@pytest.fixture(scope="session")
def truth(sound: Path) -> np.ndarray:
    return true_field(sound)


@pytest.fixture
def contents(sound_contents: Contents) -> Contents:
    """The sound survey, to be damaged."""
    return sound_contents.copy()


@pytest.fixture
def bench(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Outcome]:
    """Run one of the recipes on a survey file, in this process and without the report."""
    monkeypatch.setattr(result, "report", lambda folder: None)

    def run(recipe: str, survey: Path | Contents, *more: str, survey_section: Any = None, load: Any = None) -> Outcome:
        path = survey if isinstance(survey, Path) else survey.write(tmp_path / "survey.nc")
        stages = [{"load": load} if stage == "load" and load else stage for stage in STAGES[recipe]]
        document = {"title": recipe, "authors": ["a hostile user"], "stages": stages}
        given = ["--input", str(path)]
        if survey_section is not None:
            document, given = {**document, "survey": survey_section}, []
        (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
        folder = tmp_path / "results"
        capsys.readouterr()
        status = status_of(["run", str(tmp_path / "recipe.yaml"), *given, "--output", str(folder), *more])
        captured = capsys.readouterr()
        return Outcome(status, captured.out, captured.err, folder)

    return run


@pytest.fixture
def command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Any command, in this process; what it must not have written is `absent`."""

    def run(*arguments: Any) -> Outcome:
        capsys.readouterr()
        status = status_of([str(a) for a in arguments])
        captured = capsys.readouterr()
        return Outcome(status, captured.out, captured.err, tmp_path / "nothing")

    return run
