"""Conventions and inverses of the rotations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper_setups import turn_x, turn_y, turn_z

from magtensor.calibration.rotation import (
    CHI_SEQUENCE,
    LI_SEQUENCE,
    angle_between,
    cross_matrix,
    elementary,
    elementary_derivative,
    from_vector,
    nearest_orthogonal,
    sequence,
    sequence_angles,
    sequence_derivatives,
    to_vector,
)

ANGLE = st.floats(-3.1, 3.1)
MIDDLE = st.floats(-1.56, 1.56)
SEQUENCES = [CHI_SEQUENCE, LI_SEQUENCE, "zyx", "zxy", "yzx", "xzy"]


def test_elementary_rotations_are_those_printed_by_chi_and_li() -> None:
    for axis, printed in (("x", turn_x), ("y", turn_y), ("z", turn_z)):
        np.testing.assert_allclose(elementary(axis, 0.3), printed(0.3), atol=1e-15)


def test_chi_sequence_is_his_equation_4() -> None:
    gamma, beta, alpha = 0.1, -0.2, 0.3
    np.testing.assert_allclose(
        sequence(CHI_SEQUENCE, [gamma, beta, alpha]), turn_y(gamma) @ turn_x(beta) @ turn_z(alpha), atol=1e-15
    )


@pytest.mark.parametrize("axes", SEQUENCES)
@given(first=ANGLE, middle=MIDDLE, last=ANGLE)
def test_angles_return_from_the_matrix(axes: str, first: float, middle: float, last: float) -> None:
    angles = np.array([first, middle, last])
    np.testing.assert_allclose(sequence_angles(axes, sequence(axes, angles)), angles, atol=1e-7)


@pytest.mark.parametrize("axes", SEQUENCES)
@pytest.mark.parametrize("middle", [np.pi / 2, -np.pi / 2])
def test_angles_at_the_pole_give_the_matrix_back(axes: str, middle: float) -> None:
    rotation = sequence(axes, [0.4, middle, -1.1])
    np.testing.assert_allclose(sequence(axes, sequence_angles(axes, rotation)), rotation, atol=1e-12)


@pytest.mark.parametrize("axes", SEQUENCES)
def test_derivatives_of_a_sequence(axes: str) -> None:
    at, step = np.array([0.4, -0.7, 1.9]), 1e-6
    for k, derivative in enumerate(sequence_derivatives(axes, at)):
        e = np.eye(3)[k] * step
        numeric = (sequence(axes, at + e) - sequence(axes, at - e)) / (2 * step)
        np.testing.assert_allclose(derivative, numeric, atol=1e-9)


def test_derivative_of_an_elementary_rotation() -> None:
    for axis in "xyz":
        numeric = (elementary(axis, 0.8 + 1e-6) - elementary(axis, 0.8 - 1e-6)) / 2e-6
        np.testing.assert_allclose(elementary_derivative(axis, 0.8), numeric, atol=1e-9)


@given(st.tuples(*[st.floats(-1.7, 1.7)] * 3))
def test_rotation_vector_returns(vector: tuple[float, float, float]) -> None:
    v = np.array(vector)
    rotation = from_vector(v)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-13)
    np.testing.assert_allclose(to_vector(rotation), v, atol=1e-7)


def test_small_angles_between_rotations_are_not_lost() -> None:
    first = sequence("xyz", [0.2, 0.5, -2.0])
    second = from_vector(np.array([0.0, 3e-9, 4e-9])) @ first
    assert angle_between(first, second) == pytest.approx(5e-9, rel=1e-5)


def test_cross_matrix() -> None:
    v, w = np.array([1.0, -2, 3]), np.array([0.5, 4, -1])
    np.testing.assert_allclose(cross_matrix(v) @ w, np.cross(v, w))


@pytest.mark.parametrize("determinant", [1, -1])
def test_nearest_orthogonal_beats_random_ones(determinant: int) -> None:
    rng = np.random.default_rng(4)
    target = rng.normal(size=(3, 3))
    best = nearest_orthogonal(target, determinant)
    assert np.linalg.det(best) == pytest.approx(determinant)
    for _ in range(200):
        other = best @ from_vector(rng.normal(size=3))
        assert np.sum((target - best) ** 2) <= np.sum((target - other) ** 2) + 1e-12
