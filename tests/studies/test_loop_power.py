"""The study of the loop's power, on a few of its surveys."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

import loop_power
from loop_surveys import EVERY_EFFECT, scenario

from magtensor.simulate import simulate


@pytest.mark.long
def test_a_sensor_whose_length_a_late_base_station_spoils_has_its_share_of_a_temperature() -> None:
    effects = "reference_clock+temperature_scale"
    row = loop_power.tried(loop_power.Trial(effects, 3.0, "tilt 40", "white and 1/f", 5023, 2.0))
    assert row["outcome"] == "right" and sorted(row["adopted"]) == sorted(effects.split("+"))


def test_an_effect_of_all_sensors_alike_is_judged_by_its_model() -> None:
    row = loop_power.tried(
        loop_power.Trial("nonlinearity_quadratic alike", 3.0, "postures", "white and 1/f", 2000, 2.0)
    )
    assert row["outcome"] == "right" and row["adopted"] == ["nonlinearity_quadratic"]
    assert row["oracle"] < 1e-6


def test_every_effect_of_the_studies_can_be_simulated() -> None:
    short = {"type": "tumbling", "duration_s": 1100.0, "rate_rms_deg_s": 20.0, "rate_time_s": 4.0}
    for effect in EVERY_EFFECT:
        made = scenario("tumbling", 0.0, 1, effect, 1.0) | {"rate_Hz": 1.0, "motion": short}
        assert simulate(made).truth.effects[0].rms_nT > 0, effect
