"""An attitude on another clock than the sensors is found."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtensor.frame.delay import attitude_delay

WORLD = np.array([20_000.0, 3_000.0, 44_000.0])
TIME = np.arange(2000) * 0.1
TURN = Rotation.from_rotvec([0.7, -1.2, 2.0], degrees=True)


def attitude(time: NDArray[np.float64]) -> Rotation:
    """A rig that is swung about all its axes, a turn in some twenty seconds."""
    yaw, pitch, roll = 18.0 * time, 60.0 * np.sin(time / 3.1), 50.0 * np.sin(time / 2.3 + 1.0)
    return Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]), degrees=True)


def logged(delay_s: float, noise_deg: float = 0.02) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, 4) an attitude that is late, its signs as they come, and (N, 3) nT the field in the sensors' frame."""
    rng = np.random.default_rng(5)
    b = (attitude(TIME) * TURN).inv().apply(WORLD) + 0.2 * rng.standard_normal((len(TIME), 3))
    noisy = attitude(TIME - delay_s) * Rotation.from_rotvec(np.radians(noise_deg) * rng.standard_normal((len(TIME), 3)))
    return noisy.as_quat() * rng.choice([-1.0, 1.0], (len(TIME), 1)), b


@pytest.mark.parametrize("world", [None, WORLD], ids=["field unknown", "field known"])
@pytest.mark.parametrize("delay_s", [0.08, -0.35, 2.0])
def test_it_is_found_to_a_hundredth_of_a_sample_or_two(delay_s: float, world: NDArray[np.float64] | None) -> None:
    q, b = logged(delay_s)
    found = attitude_delay(TIME, q, TURN.apply(b) if world is not None else b, world)
    assert found is not None
    assert found.delay_s == pytest.approx(delay_s, abs=0.003)
    assert np.degrees(found.after) < 0.05 < np.degrees(found.before)
    assert f"the attitude is {abs(found.delay_s):.3g} s {'late' if delay_s > 0 else 'early'} against" in found.words


@pytest.mark.parametrize("noise_deg", [0.02, 1.0])
def test_noise_of_an_attitude_is_no_delay(noise_deg: float) -> None:
    q, b = logged(0.0, noise_deg)
    assert attitude_delay(TIME, q, b, None) is None
    q, b = logged(0.0005, noise_deg)  # less than what it errs by
    assert attitude_delay(TIME, q, b, None) is None


def test_what_hardly_moves_or_is_short_shows_none() -> None:
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(TIME), 1))
    b = np.tile(WORLD, (len(TIME), 1)) + np.random.default_rng(6).standard_normal((len(TIME), 3))
    assert attitude_delay(TIME, still, b, None) is None
    assert attitude_delay(TIME[:2], still[:2], b[:2], None) is None
    q, b = logged(0.08)
    assert attitude_delay(TIME[:100], q[:100], b[:100], None) is None


def test_errors_of_a_calibration_by_few_samples_are_no_delay() -> None:
    """They are the same function of the attitude all along, which in one motion may go with how it changes."""
    time = TIME[:150]
    for seed in range(8):
        rng = np.random.default_rng(seed)
        motion = Rotation.from_euler("ZYX", 360.0 * rng.uniform(size=3), degrees=True) * attitude(2.5 * time)
        b = motion.inv().apply(WORLD) @ (np.eye(3) + 2e-5 * rng.standard_normal((3, 3))).T
        assert attitude_delay(time, motion.as_quat(), b, None) is None, seed
