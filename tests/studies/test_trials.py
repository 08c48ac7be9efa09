"""The runner that studies share: what is there is not made again, and what was made is kept."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

import trials


class Trial(NamedTuple):
    name: str
    seed: int


WANTED = [Trial("a", 1), Trial("b", 1), Trial("a", 2)]


def tried(trial: Trial) -> dict[str, Any]:
    """Fails where a seed is 13; counts itself in the file that the environment names."""
    with open(os.environ["TRIALS_MADE"], "a") as file:
        file.write(f"{trial.name}{trial.seed}\n")
    if trial.seed == 13:
        raise ZeroDivisionError("thirteen")
    return trial._asdict() | {"square": trial.seed**2}


def run(folder: Path, wanted: list[Trial], seconds: float = math.inf) -> tuple[list[dict[str, Any]], int, list[str]]:
    """The rows, how many are open, and which trials were made now."""
    made = folder / "made"
    made.write_text("")
    os.environ["TRIALS_MADE"] = str(made)
    chosen = argparse.Namespace(rows=folder / "deeper/rows.jsonl", seconds=seconds, workers=1)
    try:
        rows, open_ = trials.rows_of(chosen, wanted, trials.named(Trial), tried, lambda row: str(row["square"]))
    finally:
        del os.environ["TRIALS_MADE"]
    return rows, open_, made.read_text().split()


def stored(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "deeper/rows.jsonl").read_text().splitlines()]


def test_only_what_is_missing_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows, open_, made = run(tmp_path, WANTED[:2])
    assert made == ["a1", "b1"] and open_ == 0 and rows == stored(tmp_path)
    rows, open_, made = run(tmp_path, WANTED)
    assert made == ["a2"] and open_ == 0
    assert [r["square"] for r in rows] == [1, 1, 4] and rows == stored(tmp_path)
    assert capsys.readouterr().out.split() == ["1", "1", "4"]


def test_nothing_is_begun_after_the_time(tmp_path: Path) -> None:
    run(tmp_path, WANTED[:1])
    rows, open_, made = run(tmp_path, WANTED, seconds=-1.0)
    assert made == [] and open_ == 2 and rows == stored(tmp_path) == [{"name": "a", "seed": 1, "square": 1}]


def test_what_was_made_before_a_bug_is_kept(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        run(tmp_path, [WANTED[0], Trial("bad", 13), WANTED[1]])
    assert [r["name"] for r in stored(tmp_path)] == ["a"]


STUDIES = ["loop_power", "leave_one_out", "level_flight", "verification", "wandering", "base_station"]


@pytest.mark.parametrize("study", STUDIES)
def test_a_row_names_its_trial(study: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A study that is given the rows of all its trials makes none of them again."""
    module = __import__(study)
    asked: list[tuple[Any, ...]] = []
    page = tmp_path / "rows.jsonl"

    def rows_of(chosen: Any, wanted: Any, trial_of: Any, tried: Any, line: Any) -> Any:
        asked.extend(wanted)
        for trial in asked[:5]:
            row = trial._asdict() if study != "level_flight" else {"flight": list(trial)}
            assert tuple(trial_of(json.loads(json.dumps(row)))) == tuple(trial)
        return [], 0

    monkeypatch.setattr(trials, "rows_of", rows_of)
    monkeypatch.setattr(sys, "argv", [study, "--rows", str(page)])
    module.main()
    assert len(asked) > 10 and len(set(asked)) == len(asked)
