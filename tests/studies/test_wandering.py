"""What wanders within the hour, a base station or a sensor, has no other cause."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

import wandering


@pytest.mark.long
def test_a_thermometer_seen_through_hours_is_no_cause_of_what_all_sensors_show_alike() -> None:
    """Its course, 6900 s late, followed the wandering by chance and explained more than any drift."""
    row = wandering.tried(wandering.Trial("base station", "tumbling", 1000.0, 0.2, 5000))
    assert row["kind"] in ("slow", "silent") and set(row["adopted"]) <= {"reference_drift"}


@pytest.mark.long
def test_a_sensor_that_wanders_drifts_at_most() -> None:
    row = wandering.tried(wandering.Trial("one sensor", "postures", 300.0, 0.2, 5000))
    assert row["kind"] != "event" and set(row["adopted"]) <= set(wandering.DRIFTS)


def test_each_axis_wanders_by_itself_and_by_what_is_asked() -> None:
    trial = wandering.Trial("all sensors", "tumbling", 100.0, 0.2, 7)
    rng = np.random.default_rng(1)
    time = np.sort(rng.uniform(0.0, 1800.0, 900))
    one, other = (wandering.course(rng, trial, time) for _ in range(2))
    assert one.std() == pytest.approx(0.2) and abs(np.corrcoef(one, other)[0, 1]) < 0.7
    assert np.diff(one).std() < 0.02  # smooth


def test_what_is_restless_for_a_while_is_still_elsewhere() -> None:
    trial = wandering.Trial(f"one sensor{wandering.FOR_A_WHILE}", "tumbling", 15.0, 2.0, 7)
    time = np.arange(0.0, 1800.0, 0.5)
    out = wandering.course(np.random.default_rng(1), trial, time)
    acts = np.flatnonzero(out)
    assert np.ptp(time[acts]) == pytest.approx(8 * 15.0, abs=1.0)
    assert 0.5 < out[acts].std() < 2.5 and np.abs(np.diff(out)).max() < 1.0


def test_the_page_names_what_is_accused_wrongly() -> None:
    row = {
        "who": "all sensors",
        "motion": "tilt 40",
        "time_s": 100.0,
        "rms_nT": 0.1,
        "seed": 1,
        "kind": "other",
        "adopted": ["scale_drift"],
    }
    page = wandering.page("command", [row], 1)
    assert (
        "| all sensors | tilt 40 | 0.1 | 1 | 0 | 0 | 1 | 0 | 0 |" in page and "1 surveys are still to be made" in page
    )
    assert "- all sensors, tilt 40, 0.1 nT, 100 s, seed 1: other (scale_drift)" in page
