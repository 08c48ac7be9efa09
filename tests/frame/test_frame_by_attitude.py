"""The rotation between the frame of a calibration and the platform's, as far as an attitude shows it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magtensor.attitude import into_platform_frame

WORLD = np.array([20_000.0, 3_000.0, 44_000.0])


def flown(turn_deg: list[float], tilt_deg: float, noise_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """(N, 4) quaternions and the field (N, 3) nT of sensors turned against the platform."""
    rng = np.random.default_rng(3)
    angles = np.column_stack([rng.uniform(0, 360, 400), rng.uniform(-tilt_deg, tilt_deg, (400, 2))])
    true = Rotation.from_euler("ZYX", angles, degrees=True)
    b = (true * Rotation.from_rotvec(turn_deg, degrees=True)).inv().apply(WORLD)
    logged = true * Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=(400, 3)))
    return logged.as_quat(), b


def error_deg(found: np.ndarray, turn_deg: list[float]) -> np.ndarray:
    return (Rotation.from_matrix(found) * Rotation.from_rotvec(turn_deg, degrees=True).inv()).as_rotvec(degrees=True)


@pytest.mark.parametrize("turn_deg", [[0.0, 0.0, 0.0], [0.7, -1.2, 0.5], [0.0, 3.0, 90.0], [178.0, 0.0, 5.0]])
@pytest.mark.parametrize("tilt_deg", [40.0, 90.0])
def test_an_attitude_shows_it(turn_deg: list[float], tilt_deg: float) -> None:
    q, b = flown(turn_deg, tilt_deg, noise_deg=0.05)
    assert (
        np.abs(error_deg(into_platform_frame(q, b), turn_deg)).max() < 0.02
    )  # 0.05 deg in 400 samples, and little tilt


def test_what_a_level_rig_does_not_show_is_no_turn() -> None:
    q, b = flown([0.6, 0.8, 1.5], tilt_deg=0.01, noise_deg=0.3)
    found = Rotation.from_matrix(into_platform_frame(q, b)).as_rotvec(degrees=True)
    assert abs(found[2]) < 0.05  # about the vertical: it is a turn of the world
    np.testing.assert_allclose(found[:2], [0.6, 0.8], atol=0.1)


def test_samples_without_attitude_have_no_part_in_it() -> None:
    q, b = flown([0.7, -1.2, 0.5], 40.0, 0.05)
    q[::3] = np.nan
    assert np.abs(error_deg(into_platform_frame(q, b), [0.7, -1.2, 0.5])).max() < 0.03
    np.testing.assert_array_equal(into_platform_frame(np.full_like(q, np.nan), b), np.eye(3))
