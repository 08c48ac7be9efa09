"""The tables of the loop's study: what each oracle finds, and what the loop names of it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

import loop_power_page


def row(oracle: float, tests: float, outcome: str) -> dict[str, Any]:
    survey = {"effect": "warm_up", "motion": "tumbling", "noise": "white", "amplitude": 0.3, "seed": 1, "rate_Hz": 2.0}
    return survey | {"oracle": oracle, "tests": tests, "outcome": outcome, "adopted": ["warm_up"]}


ROWS = [
    row(1e-9, 100.0, "right"),
    row(1e-9, 100.0, "missed"),  # what the loop lost itself
    row(1e-4, 100.0, "missed"),  # the price of what was tried
    row(0.1, 100.0, "missed"),  # what no test finds
]


def test_the_second_oracle_pays_for_what_was_tried() -> None:
    (cells,) = [line.split(" | ") for line in loop_power_page.power(ROWS) if line.startswith("| 0.3 x")]
    assert [cell.split(" ")[0] for cell in cells[3:7]] == ["3/4", "1/3", "2/4", "1/2"]


def test_the_marks_of_what_was_lost() -> None:
    assert [loop_power_page.outcome(r) for r in ROWS] == ["right", "missed", "missed+", "missed*"]
