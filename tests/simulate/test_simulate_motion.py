"""Motions: attitudes follow their rates, stay within their limits, and cover what they promise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from simulate_cases import scenario

from magtensor.simulate import motion as motions
from magtensor.simulate.rotations import matrices
from magtensor.simulate.scenario import Scenario


def built(spec: dict[str, Any], seed: int = 3, rate_Hz: float = 10.0) -> motions.Motion:
    checked = Scenario.model_validate(scenario(motion=spec)).motion
    return motions.build_motion(checked, np.random.default_rng(seed), rate_Hz)


def test_tumbling_is_the_integral_of_its_rate() -> None:
    tumbling = built({"type": "tumbling", "duration_s": 60.0, "rate_rms_deg_s": 40.0, "rate_time_s": 2.0})
    assert isinstance(tumbling, motions.Tumbling)

    def derivative(t: float, q: np.ndarray) -> np.ndarray:
        x, y, z = tumbling.rate(np.array([t]))[0]
        omega = np.array([[0, z, -y, x], [-z, 0, x, y], [y, -x, 0, z], [-x, -y, -z, 0]])
        return 0.5 * omega @ q

    t = np.linspace(0.0, 20.0, 41)
    solved = solve_ivp(derivative, (0, 20), tumbling.attitude(t[:1])[0], t_eval=t, rtol=1e-10, atol=1e-12).y.T
    difference = Rotation.from_quat(solved).inv() * Rotation.from_quat(tumbling.attitude(t))
    assert difference.magnitude().max() < 1e-5  # rad; 1e-5 of 50 000 nT is 0.5 nT of direction, none of size


def test_tumbling_is_continuous_across_its_knots() -> None:
    tumbling = built({"type": "tumbling", "duration_s": 60.0})
    assert isinstance(tumbling, motions.Tumbling)
    knots = -motions.MARGIN_S + tumbling.step * np.arange(700, 1200)
    jump = tumbling.attitude(knots + 1e-9) - tumbling.attitude(knots - 1e-9)
    assert np.abs(jump).max() < 1e-8
    t = np.linspace(1.0, 59.0, 501)
    np.testing.assert_allclose(motions.angular_rate(tumbling, t), tumbling.rate(t), atol=1e-4)


def test_tumbling_has_the_rate_asked_for_and_covers_the_sphere() -> None:
    tumbling = built({"type": "tumbling", "duration_s": 3600.0, "rate_rms_deg_s": 25.0, "rate_time_s": 4.0})
    t = np.arange(0.0, 3600.0, 0.5)
    rate = np.rad2deg(motions.angular_rate(tumbling, t))
    np.testing.assert_allclose(np.sqrt(np.mean(rate**2, axis=0)), 25.0, rtol=0.1)
    up = matrices(tumbling.attitude(t))[:, 2]  # world up in the platform frame
    octant = ((up > 0) @ [1, 2, 4]).astype(int)
    assert np.bincount(octant, minlength=8).min() > len(t) / 24


def test_limited_tilt_stays_within_and_reaches_its_limit() -> None:
    tilt = built({"type": "limited_tilt", "duration_s": 1200.0, "tilt_deg": 20.0})
    yaw, pitch, roll = Rotation.from_quat(tilt.attitude(np.arange(0, 1200.0, 0.1))).as_euler("ZYX", degrees=True).T
    for angle in (pitch, roll):
        assert 19.5 < np.abs(angle).max() <= 20.0 + 1e-9
        assert angle.min() < -19 and angle.max() > 19
    assert np.histogram(yaw, bins=12, range=(-180, 180))[0].min() > 0


def test_postures_rest_turn_and_number_themselves() -> None:
    spec = {"type": "postures", "random_count": 5, "turntable_steps": 4, "rest_s": 2.0, "turn_s": 3.0}
    postures = built(spec)
    time = np.arange(0, postures.duration_s, 0.1)
    segment = postures.segment(time)
    assert [int(np.sum(segment == k)) for k in range(9)] == [20] * 9
    for k in range(9):
        attitudes = postures.attitude(time[segment == k])
        np.testing.assert_array_equal(attitudes, np.repeat(attitudes[:1], 20, axis=0))
    quarter = Rotation.from_quat(postures.attitude(np.array([0.0]))).inv() * Rotation.from_quat(
        postures.attitude(np.array([5.0]))
    )
    np.testing.assert_allclose(quarter.as_rotvec(degrees=True), [[0, 0, 90]], atol=1e-9)
    fine = np.arange(20.0, 40.0, 1e-3)
    rate = motions.angular_rate(postures, fine)
    assert np.abs(np.diff(rate, axis=0)).max() < 0.05  # rad/s within a millisecond: no kick at the ends of a turn


def test_postures_keep_within_a_tilt() -> None:
    postures = built({"type": "postures", "random_count": 300, "tilt_deg": 25.0, "rest_s": 1.0, "turn_s": 1.0})
    up = matrices(postures.attitude(2.0 * np.arange(300) + 0.5))[:, 2, 2]
    lean = np.rad2deg(np.arccos(np.clip(up, -1, 1)))
    assert 23.5 < lean.max() <= 25.0 + 1e-6
    # uniform on the cap: the cosine is uniform
    assert np.mean(np.cos(np.deg2rad(lean))) == pytest.approx((1 + np.cos(np.deg2rad(25.0))) / 2, abs=0.006)


def test_random_attitudes_are_uniform() -> None:
    attitudes = built({"type": "random_attitudes", "count": 4000})
    r = matrices(attitudes.attitude(np.arange(4000) / 10.0))
    assert np.abs(r.mean(axis=0)).max() < 5 / np.sqrt(3 * 4000)  # E R = 0, var = 1/3
    assert np.mean(r**2, axis=0) == pytest.approx(1 / 3, abs=0.03)


def test_euler_grid_is_li_2018s() -> None:
    grid = built({"type": "euler_grid", "step_deg": 20.0}, rate_Hz=1.0)
    assert grid.duration_s == 5832
    first = matrices(grid.attitude(np.array([0.0])))[0]
    np.testing.assert_allclose(first.T @ [1.0, 2.0, 3.0], [2.0, 1.0, -3.0], atol=1e-14)  # north, east, down


def test_one_axis_keeps_its_axis() -> None:
    turning = built({"type": "one_axis", "duration_s": 60.0, "axis": [1.0, 2.0, 2.0], "rate_deg_s": 30.0})
    axis = matrices(turning.attitude(np.arange(0, 60, 0.5))) @ (np.array([1.0, 2.0, 2.0]) / 3)
    np.testing.assert_allclose(axis, np.repeat(axis[:1], 120, axis=0), atol=1e-12)
    rate = motions.angular_rate(turning, np.arange(1.0, 50.0))
    np.testing.assert_allclose(np.rad2deg(np.linalg.norm(rate, axis=1)), 30.0, rtol=1e-6)


def test_survey_lines_are_straight_parallel_and_joined_smoothly() -> None:
    spec = {"type": "survey_lines", "lines": 3, "length_m": 20.0, "spacing_m": 2.0, "speed_m_s": 2.0}
    lines = built(spec | {"height_m": 1.5, "turn_s": 8.0, "azimuth_deg": 90.0})
    time = np.arange(0, lines.duration_s, 0.1)
    segment = lines.segment(time)
    for k in range(3):
        x = lines.origin(time[segment == k])
        assert len(x) == 100
        np.testing.assert_allclose(x[:, 1:], [[-2.0 * k, 1.5]] * 100, atol=1e-9)  # heading east: the next line is south
        np.testing.assert_allclose(np.diff(x[:, 0]), 0.2 * (-1) ** k, atol=1e-9)
    speed = np.diff(lines.origin(np.arange(0, lines.duration_s, 1e-3)), axis=0) / 1e-3
    assert np.abs(np.diff(speed, axis=0)).max() < 0.05
    nose = matrices(lines.attitude(time))[:, :, 0]
    for k in range(3):
        assert np.all(nose[segment == k, 0] * (-1) ** k > 0.95)
    force = motions.specific_force(lines, time[segment == 0][20:-20])
    assert np.linalg.norm(force, axis=1) == pytest.approx(9.81, abs=1e-3)  # steady flight: gravity alone


def test_an_accelerometer_at_rest_reads_gravity_up() -> None:
    lines = built({"type": "survey_lines", "lines": 1, "length_m": 20.0, "wobble_deg": 0.0})
    np.testing.assert_allclose(motions.specific_force(lines, np.array([5.0])), [[0, 0, 9.81]], atol=1e-6)
