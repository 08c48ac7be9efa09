"""Recordings faster than their sensors: rows that repeat a reading or lie between two are found, nothing else is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_load import Load, Variables, changed

from magtensor.survey.repeated import filled_in, left_behind


def turning(samples: int, noise_nT: float, seed: int = 3, step_s: float = 0.01) -> np.ndarray:
    """(N, 3) nT of a sensor that turns, with noise."""
    rng = np.random.default_rng(seed)
    t = step_s * np.arange(samples)
    angle = 0.8 * np.sin(0.7 * t) + 1.1 * t
    field = 48e3 * np.column_stack([np.cos(angle), np.sin(angle) * np.cos(0.5 * t), np.sin(angle) * np.sin(0.5 * t)])
    return np.asarray(field + noise_nT * rng.standard_normal(field.shape))


def interpolated(values: np.ndarray, times: int) -> np.ndarray:
    at = np.arange((len(values) - 1) * times + 1) / times
    return np.column_stack([np.interp(at, np.arange(len(values)), column) for column in values.T])


@pytest.mark.parametrize("times", [2, 3, 10])
@pytest.mark.parametrize("kind", ["float64", "float32", "tenths"])
def test_interpolated_rows_are_found(kind: str, times: int) -> None:
    values = turning(800, 100.0)
    if kind == "tenths":
        values = np.round(values, 1)
    field = interpolated(values, times)
    if kind == "float32":
        field = field.astype(np.float32).astype(float)
    expected = np.arange(len(field)) % times != 0
    assert (filled_in(field) == expected).mean() > 0.995


@pytest.mark.parametrize("noise_nT", [2.0, 100.0])
def test_lines_that_were_printed_with_decimals(noise_nT: float) -> None:
    field = np.round(interpolated(turning(800, noise_nT), 4), 2)
    assert (filled_in(field) == (np.arange(len(field)) % 4 != 0)).mean() > 0.97


@pytest.mark.parametrize("times", [2, 3, 10])
def test_repeated_rows_are_found(times: int) -> None:
    values = np.round(turning(800, 100.0) / 150.0) * 150.0
    found = filled_in(np.repeat(values, times, axis=0))
    assert (found == (np.arange(len(found)) % times != 0)).mean() > 0.98


@pytest.mark.parametrize(
    ("noise_nT", "step_nT", "step_s"),
    [
        (0.15, 0.0, 0.1),  # a good fluxgate
        (0.15, 0.0, 1e-4),  # at rest, for 200 ms
        (50.0, 150.0, 0.01),  # steps of a telephone's sensor
        (5.0, 150.0, 0.01),
        (0.5, 150.0, 1e-3),  # steps far above the noise, in a slow turn
        (0.01, 1.0, 0.002),
        (0.0, 0.0, 1e-3),  # without noise
        (0.0, 0.0, 0.1),
        (0.0, 10.0, 0.01),
        (2.0, 0.01, 0.01),  # printed with decimals
        (0.02, 0.01, 1e-3),
    ],
)
def test_readings_are_not(noise_nT: float, step_nT: float, step_s: float) -> None:
    field = turning(2000, noise_nT, step_s=step_s)
    if step_nT:
        field = np.round(field / step_nT) * step_nT
    assert not filled_in(field).any()
    assert not filled_in(field.astype(np.float32).astype(float)).any()


def test_rest_between_turns_in_coarse_steps_is_not() -> None:
    turns = [np.repeat(turning(8, 0.0, seed, 1.0)[-1:], 60, axis=0) for seed in range(12)]
    field = np.concatenate([np.concatenate([rest, turning(20, 1.0, 9, 0.03)]) for rest in turns])
    field = 100.0 * np.round((field + np.random.default_rng(4).standard_normal(field.shape)) / 100.0)
    assert not filled_in(field).any()


def test_no_calibration_is_fitted_to_them(load_variables: Load, variables: Variables) -> None:
    own: Any = variables["b_raw"][1]
    rng = np.random.default_rng(8)
    field = np.repeat(own[::2] + 10.0 * rng.standard_normal(own[::2].shape), 2, axis=0)
    survey = load_variables(changed(variables, "b_raw", lambda _: field))
    assert survey.good.all()
    np.testing.assert_array_equal(survey.readings[2:-1], (np.arange(len(field)) % 2 == 0)[2:-1])
    assert "no calibration is fitted to them" in survey.attributes["notes"][0]


def test_a_spike_is_flagged_with_what_was_made_from_it(load_variables: Load, variables: Variables) -> None:
    own: Any = variables["b_raw"][1]
    readings = own[::4] + 10.0 * np.random.default_rng(8).standard_normal(own[::4].shape)
    flat = interpolated(readings.reshape(len(readings), -1), 4)[: len(own)]
    field = np.concatenate([flat, np.repeat(flat[-1:], len(own) - len(flat), axis=0)]).reshape(own.shape)
    survey = load_variables(changed(variables, "b_raw", lambda _: field))
    spike = np.zeros(len(field), dtype=bool)
    spike[200] = True
    assert survey.readings[200]
    np.testing.assert_array_equal(np.flatnonzero(survey.made_from(spike)), np.arange(197, 204))


def test_sensors_that_are_read_in_turn_are_all_used(load_variables: Load, variables: Variables) -> None:
    own: Any = variables["b_raw"][1]
    field = np.array(own, copy=True)
    for s in range(4):
        field[:, s] = own[np.maximum((np.arange(len(own)) - s) // 4 * 4 + s, 0), s]
    survey = load_variables(changed(variables, "b_raw", lambda _: field))
    assert survey.readings.all()
    assert "the sensors are read in different rows" in survey.attributes["notes"][0]


def test_a_sensor_that_now_and_then_repeats_a_row_is_left_behind() -> None:
    """What it says is wrong by what the platform turned since; a sensor of half the rate always does, and is kept."""
    rng = np.random.default_rng(8)
    field = np.stack([turning(1000, 1.0, seed) for seed in (1, 2, 3)], axis=1)
    again = rng.random(1000) < 0.15
    again[0] = False
    sticking, slow = field.copy(), field.copy()
    for row in np.flatnonzero(again):
        sticking[row, 1] = sticking[row - 1, 1]
    slow[1::2, 1] = slow[:-1:2, 1]
    for given, expected in ((sticking, again), (slow, np.zeros(1000, dtype=bool)), (field, np.zeros(1000, dtype=bool))):
        reading = ~np.column_stack([filled_in(given[:, s]) for s in range(3)])
        found = left_behind(given, reading)
        assert not found[:, [0, 2]].any()
        assert (found[1:-1, 1] == expected[1:-1]).all()
    together = np.repeat(sticking[again, 1][:, None], 3, axis=1)  # all repeat at once: a recording faster than they are
    assert not left_behind(together, np.zeros(together.shape[:2], dtype=bool)).any()
