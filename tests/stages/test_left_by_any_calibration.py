"""What no calibration takes off |b| - F: of a sensor far off its calibration, or seen in too few attitudes."""

from __future__ import annotations

import numpy as np
import pytest

from magtensor.accuracy import left_by_any_calibration
from magtensor.calibration.types import Array

SAMPLES, FIELD_NT, NOISE_NT = 2000, 50_000.0, 0.2


def seen(directions: Array, matrix: Array, offset: Array) -> Array:
    """(N, 1, 3) nT of one sensor."""
    noise = NOISE_NT * np.random.default_rng(2).standard_normal(directions.shape)
    return (FIELD_NT * directions @ matrix.T + offset + noise)[:, None]


def left(b: Array) -> float:
    found = left_by_any_calibration(b, np.full(len(b), FIELD_NT), np.ones((len(b), 1), bool))
    assert found is not None
    return found


def test_another_instrument_is_a_calibration_away() -> None:
    """Off by some per cent and by 1800 nT: to first order 15 nT would be left."""
    rng = np.random.default_rng(1)
    directions = rng.standard_normal((SAMPLES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    matrix = np.eye(3) + 0.02 * rng.standard_normal((3, 3))
    b = seen(directions, matrix, np.array([900.0, -1500.0, 400.0]))
    assert left(b) == pytest.approx(NOISE_NT, rel=0.05)


def test_an_axis_that_is_never_used_takes_nothing() -> None:
    turn = np.linspace(0.0, 40.0, SAMPLES)
    level = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(SAMPLES)])
    assert left(seen(level, 1.02 * np.eye(3), np.zeros(3))) == pytest.approx(NOISE_NT, rel=0.06)


def test_what_is_no_calibration_stays() -> None:
    turn = np.linspace(0.0, 40.0, SAMPLES)
    directions = np.column_stack([np.cos(turn), np.sin(turn), np.cos(2.7 * turn)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    b = seen(directions, np.eye(3), np.zeros(3))
    disturbed = b * (1.0 + 3.0 / FIELD_NT * np.random.default_rng(3).standard_normal((SAMPLES, 1, 1)))
    assert left(disturbed) == pytest.approx(np.hypot(3.0, NOISE_NT), rel=0.05)


def test_too_few_samples_tell_nothing() -> None:
    assert left_by_any_calibration(np.ones((5, 1, 3)), np.ones(5), np.ones((5, 1), bool)) is None
