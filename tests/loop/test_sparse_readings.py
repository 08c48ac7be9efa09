"""A base station that is read too seldom: told for what it is, and no fault of its clock."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import linear_state, loaded, scenario, verdict_of

from magtensor.loop.remainder.sparse_readings import sparse_readings

LONG = pytest.mark.long


def survey(seed: int, period_s: float, rms_nT: float, **station: Any) -> dict[str, Any]:
    made = scenario(seed)
    made["field"]["variation"] = {
        "pulsations": [{"rms_nT": rms_nT, "period_s": period_s}, {"rms_nT": rms_nT, "period_s": 1.7 * period_s}],
        "irregular": {"rms_nT": 10.0, "time_s": 300.0},
    }
    made["base_station"] |= station
    return made


@pytest.mark.parametrize("seed", [201, pytest.param(202, marks=LONG)])
def test_it_is_told_beside_the_noise(seed: int, tmp_path: Path) -> None:
    """Two waves of 3 nT rms, of 22 and 37 s, read every 10 s."""
    told = verdict_of(tmp_path, survey(seed, 22.0, 3.0, rate_Hz=0.1), None, ["reference_clock", "reference_scale"])
    description = told["unexplained"]["description"]
    assert not told["adopted"] and not told["unexplained"]["present"], description
    assert "which are 10 s apart" in description and "read too seldom" in description
    assert not told["unexplained"]["looks_like"]


@pytest.mark.parametrize("seed", [301, 302, *(pytest.param(seed, marks=LONG) for seed in range(303, 307))])
@pytest.mark.parametrize("station", [{"rate_Hz": 0.2}, {"rate_Hz": 0.2, "noise_sd_nT": 1.0}, {"rate_Hz": 2.0}])
def test_what_is_read_often_enough_is_not(seed: int, station: dict[str, float], tmp_path: Path) -> None:
    record = loaded(tmp_path, survey(seed, 120.0, 1.0, **station))
    assert sparse_readings(linear_state(record), record) is None


def without_readings(path: Path, first: int, last: int) -> None:
    with h5py.File(path, "a") as file:
        station = file["reference"]
        kept = np.r_[0:first, last : len(station["time"])]
        for name in ("time", "total_field"):
            values, attributes = station[name][kept], dict(station[name].attrs)
            del station[name]
            station[name] = values
            station[name].attrs.update(attributes)


@pytest.mark.parametrize(("seed", "lost"), [(402, 2), pytest.param(403, 3, marks=LONG)])
def test_a_gap_of_the_base_station_is_no_event(seed: int, lost: int, tmp_path: Path) -> None:
    """Readings are lost while waves of 3 nT pass: the field that nobody read there is the same for all sensors."""
    made = survey(seed, 22.0, 3.0, rate_Hz=0.2)
    events = ["passing_source", "reference_step", "scale_step"]
    told = verdict_of(tmp_path, made, lambda path: without_readings(path, 130, 130 + lost), events)
    assert not told["adopted"] and not told["unexplained"]["present"], told["unexplained"]["description"]


def test_what_lies_in_a_gap_is_not_used_unless_it_is_much(tmp_path: Path) -> None:
    made = survey(402, 120.0, 1.0, rate_Hz=0.2)
    whole = loaded(tmp_path, made)
    short = loaded(tmp_path, made, lambda path: without_readings(path, 130, 132))
    assert whole.station is not None
    begin, end = whole.station.time[[129, 132]]
    inside = (whole.time > begin) & (whole.time < end)
    assert inside.sum() == pytest.approx(30, abs=1)  # 15 s, two samples a second
    np.testing.assert_array_equal(short.time, whole.time[~inside])

    def often(path: Path) -> None:
        for first in range(40, 240, 10):
            without_readings(path, first, first + 1)

    assert len(loaded(tmp_path, made, often).time) == len(whole.time)


@pytest.mark.parametrize("seed", [406, pytest.param(411, marks=LONG)])
def test_what_passes_for_a_delay_and_is_none_is_no_rest(seed: int, tmp_path: Path) -> None:
    """Waves of 18 and 31 s read every five seconds: what a monotone cubic leaves of them looks like a delay, by half of
    whatever lag it is taken over."""
    made = survey(seed, 18.0, 1.5, rate_Hz=0.2)
    told = verdict_of(tmp_path, made, lambda path: without_readings(path, 130, 133), ["reference_clock"])
    assert not told["adopted"] and not told["unexplained"]["present"], told["unexplained"]["description"]
    assert "reference_clock: significant, but as noise of the base station" in told["unexplained"]["description"]
