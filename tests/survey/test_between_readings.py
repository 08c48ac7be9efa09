"""What lies between two readings: which course follows a record best, and that none rings."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from magtensor.between_readings import COURSES, Course, breaks, course, followed_best, noise_gain
from magtensor.error_models.station import Station

STEP_S = 5.0
READ = np.arange(0.0, 2000.0, STEP_S)
BETWEEN = (READ[:-1, None] + STEP_S * np.arange(1, 10) / 10.0).ravel()


def pulsations(at: np.ndarray, seed: int, shortest_s: float = 20.0, longest_s: float = 120.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    period, phase = rng.uniform(shortest_s, longest_s, 12), rng.uniform(0, 2 * np.pi, 12)
    return np.asarray(np.sin(2 * np.pi * at[:, None] / period + phase).sum(axis=1))


@pytest.mark.parametrize("seed", range(5))
def test_the_spline_is_chosen_for_pulsations_that_are_resolved(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    read = pulsations(READ, seed) + 0.02 * rng.standard_normal(len(READ))
    assert followed_best(READ, read) == "spline"
    wrong = {how: course(READ, read, how)(BETWEEN) - pulsations(BETWEEN, seed) for how in ("pchip", "spline")}
    assert np.std(wrong["spline"]) < 0.7 * np.std(wrong["pchip"])


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("what", ["noise", "random walk", "steps", "a constant", "a ramp"])
def test_the_monotone_cubic_stays_where_the_spline_is_no_better(what: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    read = {
        "noise": rng.standard_normal(len(READ)),
        "random walk": np.cumsum(rng.standard_normal(len(READ))),
        "steps": 30.0 * np.cumsum(rng.random(len(READ)) < 0.02) + 0.05 * rng.standard_normal(len(READ)),
        "a constant": np.full(len(READ), 48_000.0),
        "a ramp": 48_000.0 + 0.01 * READ,
    }[what]
    assert followed_best(READ, read) == "pchip"


def test_few_readings_tell_nothing() -> None:
    assert followed_best(READ[:50], pulsations(READ[:50], 1)) == "pchip"


@pytest.mark.parametrize("what", ["step", "spike", "gap"])
def test_a_spline_does_not_ring(what: str) -> None:
    read = pulsations(READ, 3)
    true, time, at = pulsations(BETWEEN, 3), READ, BETWEEN
    where = 1000.0
    if what == "step":
        read, true = read + 300.0 * (where < READ), true + 300.0 * (where < BETWEEN)
    elif what == "spike":
        read = read + 300.0 * (where == READ)
    else:
        kept = np.abs(READ - where) > 20.0
        time, read = READ[kept], read[kept]
    near = (np.abs(at - where) <= 25.0) if what == "gap" else (np.abs(at - where) <= STEP_S)
    error = course(time, read, "spline")(at) - true
    assert np.abs(error[~near]).max() < 0.25  # a spline through it is off by 80 nT beside the step
    assert breaks(time, read).sum() == {"step": 1, "spike": 2, "gap": 1}[what]


def test_what_noise_the_spline_lets_through() -> None:
    rng = np.random.default_rng(5)
    read = rng.standard_normal((3000, 40))
    place = np.array([0.0, 0.1, 0.25, 0.5, 0.8])
    time = np.arange(40.0)
    found = np.array([course(time, one, "spline")(20.0 + place) for one in read if not breaks(time, one).any()])
    assert len(found) > 2000
    np.testing.assert_allclose(found.std(axis=0), noise_gain("spline", place), rtol=0.06)
    np.testing.assert_allclose(noise_gain("pchip", place), np.hypot(1 - place, place))


@pytest.mark.parametrize("how", COURSES)
@pytest.mark.parametrize("count", [2, 90])
def test_a_base_station_can_be_sent_to_another_process(how: Course, count: int) -> None:
    """With the course that it has been asked for, as a search that shares its work out sends it back."""
    time = np.arange(float(count))
    station = Station(time, np.sin(time), how)
    asked = np.linspace(0.0, count - 1.0, 7)
    there = station.at(asked)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(station)).at(asked), there)


def test_where_a_time_lies_between_readings() -> None:
    """Before the first and after the last there is no share that has gone by."""
    gap = Station(np.array([2.0, 4.0, 10.0]), np.zeros(3)).between(np.array([0.0, 2.0, 2.5, 4.0, 8.5, 10.0, 11.0]))
    np.testing.assert_array_equal(gap.number, [0, 1, 1, 2, 2, 3, 3])
    np.testing.assert_allclose(gap.share, [0.0, 0.0, 0.25, 0.0, 0.75, 1.0, 1.0])
    np.testing.assert_array_equal(gap.apart_s, [2.0, 2.0, 2.0, 6.0, 6.0, 6.0, 6.0])
