"""Two effects of which each hides something of the other, as the study makes them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

import loop_power


@pytest.mark.long
@pytest.mark.parametrize(
    ("effects", "seed"),
    [
        ("reference_clock+temperature_scale", 5023),  # |b| - F of one sensor is worse with its own coefficients
        ("warm_up+reference_drift", 5004),  # one sensor seems to drift, and warms up as the others do
    ],
)
def test_both_are_found_and_nothing_else(effects: str, seed: int) -> None:
    row = loop_power.tried(loop_power.Trial(effects, 3.0, "tilt 40", "white and 1/f", seed, 2.0))
    assert row["outcome"] == "right" and sorted(row["adopted"]) == sorted(effects.split("+"))
