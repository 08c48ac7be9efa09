"""Jumps that most of a survey's samples feel, powers of a channel that only together predict, two time constants."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import linear_state, loaded, scenario, synthetic

from magtensor.loop.fitting.model import Fitting
from magtensor.loop.searching.found import Search
from magtensor.loop.searching.search import search
from magtensor.registry import Registry

SAMPLES = 300


def searched(record: Any, *names: str) -> Search:
    registry = Registry.load()
    return search(record, [registry.find("error_model", n) for n in names], Fitting())


def gain_jump(first: int, end: int) -> Any:
    """A gain of S2's y axis that is 1000 ppm more for some samples, at random attitudes: up to 50 nT."""
    # the same draw as in `synthetic`, whose field it is
    u = np.random.default_rng(3).standard_normal((SAMPLES, 3))
    added = np.zeros((SAMPLES, 4, 3))
    along = u[:, 1] / np.linalg.norm(u, axis=1) * 50_000.0
    added[first:end, 1, 1] = 1e-3 * along[first:end]
    return synthetic(3, SAMPLES, noise_nT=0.3, added=added)


def test_a_jump_that_lasts_is_no_disturbance_whatever_the_attitudes() -> None:
    record = gain_jump(200, SAMPLES)
    assert linear_state(record).fit.keep.all()
    found = searched(record, "offset_step", "scale_step", "turn_step")
    (adopted,) = found.last.adopted
    assert (adopted.name, adopted.sensors) == ("scale_step", ("S2",))
    assert 199 < adopted.settings["time_s"] <= 200
    np.testing.assert_allclose(found.last.theta[0][1], 1000.0, atol=5.0)
    assert found.last.fit.keep.all()


def test_what_is_over_within_a_fold_is_a_disturbance() -> None:
    state = linear_state(gain_jump(200, 225))
    doubted = np.flatnonzero(~state.fit.keep)
    assert len(doubted) > 10  # at the other attitudes the axis is across the field and shows little
    assert doubted.min() >= 200 and doubted.max() < 225


BEND = {"type": "channel_response", "channel": "temperature", "power": 2, "lag_s": 100.0}
LINE = {"type": "temperature_offset", "lag_s": 100.0}


@pytest.mark.long
@pytest.mark.parametrize(
    ("effects", "order"),
    [
        ([LINE | {"rms_nT": 0.5}], 1),
        ([BEND | {"rms_nT": 0.5}], 2),
        ([LINE | {"rms_nT": 0.4}, BEND | {"rms_nT": 0.4}], 2),
    ],
    ids=["line", "bend", "both"],
)
def test_the_order_of_a_temperature_is_the_lowest_that_does(
    effects: list[dict[str, Any]], order: int, tmp_path: Path
) -> None:
    found = searched(loaded(tmp_path, scenario(4, *effects)), "temperature_offset", "temperature_scale", "offset_drift")
    (adopted,) = found.last.adopted
    assert (adopted.name, adopted.settings["order"]) == ("temperature_offset", order)


@pytest.mark.long
def test_two_ways_of_the_heat_are_two_lags_of_one_thermometer(tmp_path: Path) -> None:
    effects = [LINE | {"lag_s": lag, "rms_nT": 1.0} for lag in (10.0, 200.0)]
    models = ("temperature_offset", "channel_response", "temperature_rate", "offset_drift")
    found = searched(loaded(tmp_path, scenario(21, *effects)), *models)
    assert {a.name for a in found.last.adopted} == {"temperature_offset"}
    # the record's own heat came in before it began: some seconds and a tenth of the longer lag
    lags = sorted(a.settings["lag_s"] for a in found.last.adopted)
    np.testing.assert_allclose(lags, [10.0, 200.0], rtol=0.2, atol=6.0)


VISCOUS = ("viscous_magnetisation", "hysteresis", "eddy_current", "sampling_lag", "bandwidth")


@pytest.mark.long
@pytest.mark.parametrize("taus", [(8.0,), (2.0, 60.0)], ids=["one", "two"])
def test_what_a_time_constant_leaves_is_another_one_and_no_other_effect(
    taus: tuple[float, ...], tmp_path: Path
) -> None:
    effects = [{"type": "viscous_magnetisation", "tau_s": tau, "rms_nT": 1.0} for tau in taus]
    found = searched(loaded(tmp_path, scenario(5, *effects)), *VISCOUS)
    assert {a.name for a in found.last.adopted} == {"viscous_magnetisation"}
    np.testing.assert_allclose(sorted(a.settings["tau_s"] for a in found.last.adopted), taus, rtol=0.2)


def test_noise_of_the_base_station_is_no_delay_of_it(tmp_path: Path) -> None:
    # the noise is in the residual and in the difference of two readings: half of that seems to explain it
    record = replace(loaded(tmp_path, scenario(6)), station=None)
    n = len(record.time)
    spectrum = np.fft.rfft(np.random.default_rng(6).standard_normal(n))
    noise = np.fft.irfft(spectrum / np.sqrt(np.maximum(np.arange(len(spectrum)), 1)), n)
    noise *= 1.5 / noise.std()
    at = record.time
    noisy = replace(record, total_field=record.total_field + noise, quiet_field=record.quiet_field + noise)
    late, quiet = (np.interp(at - 40.0, at, values) for values in (record.total_field, record.quiet_field))
    assert searched(noisy, "reference_clock").last.adopted == ()
    (adopted,) = searched(replace(record, total_field=late, quiet_field=quiet), "reference_clock").last.adopted
    np.testing.assert_allclose(adopted.settings["lag_s"], 40.0, atol=10.0)


@pytest.mark.long
@pytest.mark.parametrize("part", [0.5, 0.9])
def test_a_jump_while_a_posture_is_held_has_its_time_to_a_sample(tmp_path: Path, part: float) -> None:
    """The turns, which nobody recorded, are longer than the samples about the time that white noise shows."""
    rest, turn, at = 2.0, 2.1, 28
    time = at * (rest + turn) + part * rest
    postures = {"type": "postures", "random_count": 60, "rest_s": rest, "turn_s": turn}
    jump = {"type": "offset_step", "rms_nT": 3.0, "time_s": [time]}
    found = searched(loaded(tmp_path, scenario(5, jump, motion=postures, rate_Hz=10.0)), "offset_step", "offset_while")
    (adopted,) = found.last.adopted
    assert (adopted.name, adopted.sensors) == ("offset_step", ())
    assert adopted.settings["time_s"] == pytest.approx(time, abs=0.1)
