"""A base station's readings, repeated in a table of more rows until there is a new one."""

from __future__ import annotations

import numpy as np
import pytest
from test_load import Load, Variables

from magtensor.survey.repeated import held_readings


def base(time: np.ndarray, seed: int = 1, noise: float = 0.1, digits: int = 2) -> np.ndarray:
    """Total field, nT: a slope, pulsations and noise, as printed."""
    field = 49500.0 + 0.01 * time + 0.5 * np.sin(2.0 * np.pi * time / 90.0)
    return np.round(field + noise * np.random.default_rng(seed).standard_normal(len(time)), digits)


@pytest.mark.parametrize(("row_s", "period_s", "rows"), [(1.0, 60.0, 500), (1.0, 10.0, 500), (0.5, 1.8, 900)])
def test_held_readings_are_found(row_s: float, period_s: float, rows: int) -> None:
    time = row_s * np.arange(rows)
    first = 0.4 * period_s
    number = np.floor((time - first) / period_s).astype(int)
    every = base(first + period_s * np.arange(number.min(), number.max() + 1))
    found = held_readings(time, every[number - number.min()])
    assert found is not None
    readings, period = found
    assert period == pytest.approx(period_s, rel=2e-3)
    expected = np.diff(number, prepend=number[0] - 1) != 0
    expected[-1] = True
    np.testing.assert_array_equal(readings, expected)


def test_a_reading_that_equals_the_last_one_is_kept() -> None:
    time = np.arange(600.0)
    every = base(np.arange(0.0, 600.0, 10.0))
    every[20:23] = every[19]
    found = held_readings(time, np.repeat(every, 10))
    assert found is not None
    np.testing.assert_array_equal(np.flatnonzero(found[0]), [*range(0, 600, 10), 599])


@pytest.mark.parametrize("digits", [2, 1, 0])
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.3])
def test_readings_in_coarse_steps_are_readings(digits: int, noise: float) -> None:
    for seed in range(60):
        for rows in (60, 600, 6000):
            assert held_readings(np.arange(float(rows)), base(np.arange(float(rows)), seed, noise, digits)) is None


def test_the_field_between_two_readings_is_interpolated(load_variables: Load, variables: Variables) -> None:
    time = np.linspace(-1.0, 41.0, 421)
    every = base(time, noise=1.0)
    rows = {"reference/time": time, "reference/total_field": every[10 * (np.arange(421) // 10)]}
    held = variables | {name: (variables[name][0], values, variables[name][2]) for name, values in rows.items()}
    survey = load_variables(held)
    np.testing.assert_allclose(survey.values("reference/time"), np.arange(-1.0, 42.0), atol=1e-9)
    np.testing.assert_array_equal(survey.values("reference/total_field"), every[::10])
    assert "repeat a reading, of which there is one every 1 s" in survey.attributes["notes"][0]
