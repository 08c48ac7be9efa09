"""Two effects of which each hides something of the other, as the study makes them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

import loop_power


@pytest.mark.long
def test_a_sensor_whose_length_a_late_base_station_spoils_has_its_share_of_a_temperature() -> None:
    effects = "reference_clock+temperature_scale"
    row = loop_power.tried(loop_power.Trial(effects, 3.0, "tilt 40", "white and 1/f", 5023, 2.0))
    assert row["outcome"] == "right" and sorted(row["adopted"]) == sorted(effects.split("+"))
