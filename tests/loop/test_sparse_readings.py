"""A base station that is read too seldom: told for what it is, and no fault of its clock."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import Array, adopted_names, linear_state, loaded, scenario, synthetic, verdict_of

from magtensor.error_models.station import Station
from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.remainder.sparse_readings import FAR, as_far_as_unread, sparse_readings
from magtensor.loop.searching.between_readings import between_readings
from magtensor.loop.searching.found import Search
from magtensor.loop.searching.unexplained import strongest_line, unexplained
from magtensor.registry import Registry

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


PASSING = {"type": "passing_source", "closest_m": [12.0, 0.0, 0.0], "velocity_m_s": [0.0, 0.6, 0.0], "time_s": 405.0}


@pytest.mark.parametrize(("duration_s", "passed"), [(800.0, False), pytest.param(1200.0, True, marks=LONG)])
def test_what_passes_between_two_readings_is_more_than_the_field_moves(
    duration_s: float, passed: bool, tmp_path: Path
) -> None:
    """Readings every 30 s of waves of 1 nT rms and 37 and 61 s; a source passes within 20 s, or none does."""
    made = survey(605, 37.0, 1.0, rate_Hz=1.0 / 30.0)
    made["motion"]["duration_s"] = duration_s
    made["field"]["variation"] |= {
        "pulsations": [{"rms_nT": 1.0, "period_s": period_s} for period_s in (37.0, 61.0)],
        "irregular": {"rms_nT": 40.0, "time_s": 150.0},
    }
    made["effects"] = [{**PASSING, "rms_nT": 1.0}] if passed else []
    told = verdict_of(tmp_path, made, None, ["passing_source", "reference_while", "reference_step", "offset_while"])
    assert adopted_names(told) == ({"passing_source"} if passed else set())


def test_how_far_the_field_moves_unread_is_known_from_readings_that_are_as_far_apart() -> None:
    """The middle of a chord over a time T misses a wave of a period P and 3 nT rms by 3 nT (1 - cos(pi T / P)) rms."""
    made = synthetic(3)
    field = 50_000.0 + 3.0 * np.sqrt(2.0) * np.sin(2.0 * np.pi * made.time / 120.0)
    at = made.time[::5]
    read = np.delete(at, [130, 131, 132, 133])
    record = replace(made, total_field=field, station=Station(read, np.interp(read, made.time, field)))
    missed = 3.0 * (1.0 - np.cos(np.pi * 30.0 / 120.0))  # 15 s to either side, further beside the gap
    assert as_far_as_unread(FAR * missed, 25.0, record) and not as_far_as_unread(1.3 * FAR * missed, 25.0, record)
    assert not as_far_as_unread(FAR * missed, 5.0, record)
    assert not as_far_as_unread(FAR * missed, 1190.0, record)  # no others tell


def upright(seed: int, read_s: float, wave_nT: Array, current_nT: Array) -> Record:
    """A platform within some 30 degrees of upright, a wave (N,) in the field that is read every so often, and a current
    (N,) on it that is not logged."""
    rng = np.random.default_rng(seed)
    made = synthetic(seed)
    tilts = np.cumsum(rng.standard_normal((len(made.time), 2)), axis=0)
    down = np.column_stack([0.4 * tilts / tilts.std(axis=0), np.ones(len(made.time))])
    field = 50_000.0 + wave_nT
    seen = down / np.linalg.norm(down, axis=1, keepdims=True) * field[:, None]
    seen += current_nT[:, None] * np.array([0.3, -0.3, 0.9])
    raw = np.repeat(seen[:, None], 4, axis=1) + 0.2 * rng.standard_normal((len(made.time), 4, 3))
    read = np.arange(0.0, made.time[-1] + read_s, read_s)
    station = Station(read, np.interp(read, made.time, field))
    known = station.at(made.time)
    return replace(made, raw=raw, total_field=known, quiet_field=known, station=station)


def wave(period_s: float) -> Array:
    return np.asarray(np.sin(2.0 * np.pi * np.arange(1200.0) / period_s))


@pytest.mark.parametrize("seed", [404, 405])
def test_a_line_of_the_field_that_was_not_read_is_none_of_the_platform(seed: int) -> None:
    """A wave of 33 s read every 10 s leaves images, which are lines where a platform's own would be."""
    record = upright(seed, 10.0, 3.0 * wave(33.0), np.zeros(1200))
    state = linear_state(record)
    assert strongest_line(state, record) is not None and strongest_line(state, record, between=True) is None
    told = unexplained(Search(state, state, (), {}, {}, record, None, Fitting()), record)
    assert not told["present"] and "read too seldom" in told["description"], told["description"]


@pytest.mark.parametrize(("of_the_field", "period_s"), [(True, 6.17), (False, 6.17), (False, 5.05)])
@pytest.mark.parametrize("seed", [407, 408])
def test_the_image_of_a_wave_is_no_tone(seed: int, of_the_field: bool, period_s: float) -> None:
    """A wave of 26.4 s read every 5 s has images at 4.2 and 6.17 s. A current of that period is there at the readings
    too."""
    still = np.zeros(1200)
    record = upright(seed, 5.0, *((3.0 * wave(26.4), still) if of_the_field else (still, 0.1 * wave(period_s))))
    model = Adopted(Registry.load().find("error_model", "periodic_interference"), {"frequency_Hz": 1.0 / period_s})
    state = joint_state(record, [model], Fitting())
    assert between_readings(record, state, 0) is of_the_field
