"""Sensors that hardly turn, and a world field of unknown direction."""

from __future__ import annotations

import numpy as np
import pytest

from magtensor.calibration.determined import calibrate_determined, design, determined
from magtensor.calibration.quadric import ellipsoid_restricted
from magtensor.calibration.scalar import calibrate
from magtensor.calibration.world_field import world_direction
from magtensor.errors import NotEnoughData

F = 50_000.0


def standing(rng: np.random.Generator, error: np.ndarray, offset: np.ndarray, noise: float, n: int = 6000):
    """A variometer's day: the field varies by some tens of nT, the sensor stands."""
    time = np.arange(n) / n
    field = np.array([20_000.0, 300.0, 45_800.0]) + np.column_stack(
        [40 * np.sin(2 * np.pi * time), 30 * np.cos(4 * np.pi * time), 15 * np.sin(6 * np.pi * time + 1)]
    )
    raw = field @ (np.eye(3) + error).T + offset + noise * rng.standard_normal((n, 3))
    return raw, np.linalg.norm(field, axis=1)


def test_derivative() -> None:
    rng = np.random.default_rng(1)
    raw = rng.normal(0, 1, (20, 3)) * 20_000
    exact = design(raw, F)
    from magtensor.calibration.determined import correction

    for k in range(9):
        each = []
        for sign in (1, -1):
            theta = np.zeros(9)
            theta[k] = sign * 0.5
            matrix, offset = correction(theta, F)
            each.append(np.linalg.norm((raw - offset) @ matrix.T, axis=1))
        np.testing.assert_allclose(each[0] - each[1], exact[:, k], atol=1e-4)


def test_a_standing_sensor_tells_its_error_along_the_field_only() -> None:
    rng = np.random.default_rng(2)
    offset = np.array([100.0, -40.0, 250.0])
    raw, total_field = standing(rng, np.zeros((3, 3)), offset, 0.5)
    found = determined(raw, total_field)
    assert 1 <= found.count <= 3, "the error along the field, and at most what the variation shows"
    u = raw.mean(axis=0) / np.linalg.norm(raw.mean(axis=0))
    assert found.held_out_rms[0] == pytest.approx(abs(offset @ u), rel=0.02)
    assert found.held_out_rms[found.count] < 0.6, "the noise along the field is 0.5 nT"
    with pytest.raises(NotEnoughData):
        calibrate(raw, total_field, ellipsoid_restricted, "polar")
    fitted = calibrate_determined(raw, total_field)
    assert f"{9 - found.count} of 9 combinations" in fitted.unobservable[0]
    later, field = standing(np.random.default_rng(3), np.zeros((3, 3)), offset, 0.5)
    after = np.linalg.norm(fitted.apply(later), axis=1) - field
    assert np.sqrt(np.mean(after**2)) < 0.6


def test_turned_in_all_directions_all_nine_are_determined() -> None:
    rng = np.random.default_rng(4)
    u = rng.normal(size=(4000, 3))
    b = F * u / np.linalg.norm(u, axis=1, keepdims=True)
    error = np.array([[0.01, 0.004, -0.006], [0.004, -0.008, 0.002], [-0.006, 0.002, 0.005]])
    offset = np.array([300.0, -150.0, 80.0])
    raw = b @ np.linalg.inv(np.eye(3) + error).T + offset + rng.standard_normal((4000, 3))
    fitted = calibrate_determined(raw, np.full(4000, F))
    assert fitted.unobservable == ()
    np.testing.assert_allclose(fitted.matrix, np.eye(3) + error, atol=2e-5)
    std = np.sqrt(np.diag(fitted.covariance)[9:])
    assert (np.abs(fitted.offset - offset) < 5 * std).all()
    assert std == pytest.approx(np.sqrt(3 / 4000), rel=0.8), "noise / sqrt(N / 3)"


def test_a_sensor_without_error_is_left_alone() -> None:
    raw, total_field = standing(np.random.default_rng(5), np.zeros((3, 3)), np.zeros(3), 5.0)
    with pytest.raises(NotEnoughData, match="no combination"):
        determined(raw, total_field)


def attitudes(rng: np.random.Generator, n: int, tilt: float) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    angles = np.column_stack([np.linspace(0, 12 * np.pi, n), *(tilt * rng.standard_normal((2, n)))])
    return Rotation.from_euler("ZYX", angles).inv().as_matrix()


def test_the_direction_of_the_world_field_is_found_with_the_sensor() -> None:
    rng = np.random.default_rng(6)
    turn = attitudes(rng, 3000, 0.5)
    world = np.array([900.0, 19_000.0, -46_000.0])
    c = np.eye(3) + 0.02 * rng.standard_normal((3, 3))
    raw = turn @ world @ c.T + [200.0, -300.0, 100.0] + 3 * rng.standard_normal((3000, 3))
    found = world_direction(raw[:, None], turn, np.full(3000, np.linalg.norm(world)))
    angle = np.arccos(found.direction @ world / np.linalg.norm(world))
    assert angle < 5 * found.std
    assert found.std < 1e-4, "3 nT of 50 000 over 3000 samples"


def test_turning_about_the_vertical_does_not_tell_the_dip() -> None:
    rng = np.random.default_rng(7)
    turn = attitudes(rng, 2000, 0.0)
    raw = turn @ np.array([0.0, 19_000.0, -46_000.0]) + 3 * rng.standard_normal((2000, 3))
    with pytest.raises(NotEnoughData, match="direction of the world field"):
        world_direction(raw[:, None], turn, np.full(2000, F))


@pytest.mark.parametrize("seed", range(3))
def test_combinations_that_run_away_are_left_nominal(seed: int) -> None:
    """A variometer of some picotesla: beside the few combinations that show, Newton steps in the others have no end."""
    rng = np.random.default_rng(seed)
    slow = np.cumsum(rng.standard_normal((2000, 3)), axis=0) * np.array([0.006, 0.004, 0.002])
    field = np.array([20_800.0, 90.0, 43_000.0]) + slow
    raw = field + np.array([3.0, -5.0, 7.0]) + 0.003 * rng.standard_normal(field.shape)
    total_field = np.linalg.norm(field, axis=1) + 0.003 * rng.standard_normal(len(field))
    found = determined(raw, total_field)
    assert found.count <= 3 and np.isfinite(found.held_out_rms).all()
    assert found.held_out_rms[found.count] < 0.01
