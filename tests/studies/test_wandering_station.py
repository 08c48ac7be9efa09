"""A base station that wanders within the hour is none of the instrument's temperature."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

import wandering_station


def test_a_thermometer_seen_through_hours_is_no_cause_of_what_all_sensors_show_alike() -> None:
    """Its course, 6900 s late, followed the wandering by chance and explained more than any drift."""
    row = wandering_station.tried(wandering_station.Trial("tumbling", 1000.0, 0.2, 5000))
    assert row["kind"] in ("slow", "silent") and set(row["adopted"]) <= {"reference_drift"}


def test_the_page_names_what_is_accused_wrongly() -> None:
    row = {"motion": "tilt 40", "time_s": 100.0, "rms_nT": 0.1, "seed": 1, "kind": "other", "adopted": ["scale_drift"]}
    page = wandering_station.page("command", [row], 1)
    assert "| tilt 40 | 0.1 | 100 | 1 | 0 | 0 | 1 | 0 | 0 |" in page and "1 surveys are still to be made" in page
    assert "- tilt 40, 0.1 nT, 100 s, seed 1: other (scale_drift)" in page
