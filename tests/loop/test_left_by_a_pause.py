"""What follows a pause of the record is the memory of an adopted model, unless it lasts longer than that."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import xarray as xr
from loop_cases import scenario, survey_file, synthetic

import magtensor
from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.after_a_pause import left_by_a_pause
from magtensor.registry import Registry

PAUSE_S = 40.0  # after 500 s
LAG_S = 30.0


def paused(record: Record) -> Record:
    """The same with nothing recorded for a while."""
    after = record.time >= 500.0
    return replace(record, time=record.time + PAUSE_S * after, run=after.astype(int))


@pytest.mark.parametrize(
    ("begin", "until", "sensors", "told"),
    [
        (500.0, 600.0, (), True),
        (520.0, 600.0, ("S2",), True),
        (540.0, 600.0, ("S2",), True),
        (560.0, 600.0, (), True),  # where what comes first was flagged
        (640.0, 700.0, (), False),  # after it
        (400.0, 600.0, (), False),  # before it
        (520.0, 900.0, (), False),  # for longer than anything is remembered
        (520.0, 600.0, ("S1",), False),  # on another sensor
    ],
)
def test_what_follows_a_pause(begin: float, until: float, sensors: tuple[str, ...], told: bool) -> None:
    find = Registry.load().find
    event = Adopted(find("error_model", "offset_while"), {"time_s": begin, "until_s": until}, sensors)
    iron = Adopted(find("error_model", "viscous_magnetisation"), {"tau_s": LAG_S}, ("S2", "S3"))
    state = joint_state(paused(synthetic(7, turning_s=4.0)), [iron, event], Fitting())
    assert left_by_a_pause(state, 1) == ("viscous_magnetisation" if told else "")
    alone = joint_state(paused(synthetic(7, turning_s=4.0)), [event], Fitting())
    assert left_by_a_pause(alone, 0) == ""


@pytest.mark.long
def test_the_iron_after_a_pause_is_no_offset(tmp_path: Path) -> None:
    """The platform turns while nothing is recorded, and the iron with it."""
    effect = {"type": "viscous_magnetisation", "rms_nT": 4.0, "tau_s": LAG_S}
    groups = dict(xr.open_groups(survey_file(tmp_path, scenario(12, effect)), decode_times=False))
    elapsed = groups["/"]["time"].values - groups["/"]["time"].values[0]
    groups["/"] = groups["/"].isel(time=(elapsed < 400.0) | (elapsed > 405.0))
    models = ["viscous_magnetisation", "offset_while"]
    found = magtensor.close_loop({n: groups[n] for n in ("/", "/reference")}, search=models).verdict
    assert {s["adopted"] for s in found["steps"]} == {"viscous_magnetisation", None}
