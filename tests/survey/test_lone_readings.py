"""Readings of a log that cannot be, and what only looks like one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from magtensor.survey.lone_readings import lone_readings

Array = np.ndarray[Any, Any]
ROWS = 6000


def rng() -> np.random.Generator:
    return np.random.default_rng(41)


def thermometer() -> Array:
    """One that rounds to a sixteenth of a degree, while it warms up."""
    return np.round((21.0 + 1.5 * (1.0 - np.exp(-np.arange(ROWS) / 2500.0))) * 16.0) / 16.0


def current() -> Array:
    """A motor's: it follows what is asked of it within a second, ten rows."""
    drive, out = np.repeat(rng().uniform(5.0, 14.0, ROWS // 60), 60), np.empty(ROWS)
    level = drive[0]
    for i, asked in enumerate(drive):
        level += (asked - level) / 10.0
        out[i] = level
    return out + 0.05 * rng().standard_normal(ROWS)


def held(readings: Array, rows: int) -> Array:
    return np.repeat(readings[::rows], rows)[:ROWS]


def test_what_a_bus_answers_when_a_thermometer_does_not() -> None:
    values = thermometer()
    at = [400, 2711, 2712, 5100]
    values[at] = [85.0, -127.0, -127.0, 85.0]
    assert np.flatnonzero(lone_readings(values)).tolist() == at


def test_a_temperature_does_not_jump_and_come_back() -> None:
    values = np.round((21.0 + 4.0 * np.sin(np.arange(ROWS) / 900.0)) * 16.0) / 16.0 + 0.1 * rng().standard_normal(ROWS)
    values[3000:3030] = 85.0
    assert np.flatnonzero(lone_readings(values, slow=True)).tolist() == list(range(3000, 3030))
    assert not lone_readings(values).any()  # of anything else that may be


def test_a_reading_that_is_held_until_the_next() -> None:
    values = held(thermometer() + 0.01 * rng().standard_normal(ROWS), 10)
    values[3000:3010] = 85.0
    assert np.flatnonzero(lone_readings(values)).tolist() == list(range(3000, 3010))


def test_a_lost_bit_of_a_current() -> None:
    values = current()
    values[1234] += 128.0
    assert np.flatnonzero(lone_readings(values)).tolist() == [1234]


def test_one_of_several_thermometers_and_gaps() -> None:
    values = np.column_stack([thermometer(), thermometer() + 3.0])
    values[100:200] = np.nan
    values[2000, 1] = 85.0
    assert np.argwhere(lone_readings(values)).tolist() == [[2000, 1]]


def pulses(values: Array, size: float, every: int = 500) -> Array:
    values[every // 2 :: every] += size
    return values


def during(values: Array, first: int, last: int, value: float) -> Array:
    values[first:last] = value
    return values


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(thermometer, id="a thermometer"),
        pytest.param(current, id="a current"),
        pytest.param(lambda: pulses(0.02 * rng().standard_normal(ROWS), 5.0), id="pulses of what is else noise"),
        pytest.param(lambda: pulses(np.zeros(ROWS), 5.0), id="pulses of what is else nothing"),
        pytest.param(lambda: during(current(), 3000, 3050, 0.0), id="a motor that stops for five seconds"),
        pytest.param(lambda: during(current(), 0, 50, 0.0), id="a motor that is started"),
        pytest.param(lambda: during(current(), ROWS - 2, ROWS, 60.0), id="what the end leaves open"),
        pytest.param(lambda: pulses(current(), 8.0, 3), id="what comes every third row"),
        pytest.param(lambda: rng().exponential(1.0, ROWS), id="noise with a long tail"),
        pytest.param(lambda: np.cumsum(rng().standard_normal(ROWS)), id="a random walk"),
        pytest.param(lambda: np.full(ROWS, 3.0), id="a constant"),
        pytest.param(lambda: np.full(ROWS, np.nan), id="nothing"),
    ],
)
def test_a_course_that_is_none(make: Callable[[], Array]) -> None:
    assert not lone_readings(make()).any()


def test_the_top_of_a_pulse_is_not_alone() -> None:
    """A magnetorquer's, smooth; of the highest one two readings are beyond all others."""
    rows = np.arange(ROWS)
    each = [np.exp(-0.5 * ((rows - at) / 25.0) ** 2) for at in range(300, ROWS, 400)]
    values: Array = np.sum(each, axis=0)
    low, high = np.quantile(values, [0.02, 0.98])
    highest = np.array([0.85, 0.92, 0.97, 1.01, 1.01, 0.97, 0.92, 0.85])
    values[2947:2955] = highest * (high + (high - low))
    assert not lone_readings(values).any()
    values[2950:2952] *= 2.0
    assert np.flatnonzero(lone_readings(values)).tolist() == [2950, 2951]
