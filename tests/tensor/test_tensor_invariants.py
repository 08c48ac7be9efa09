import numpy as np
import pytest
from dipole import MU0_OVER_4PI, dipole_field, dipole_tensor, random_rotations
from hypothesis import given, settings
from hypothesis import strategies as st

from magtensor import DataError
from magtensor.tensor.elements import GENERATORS, METRIC, closure, five, full, rotation_of_five, separate
from magtensor.tensor.invariants import invariants, invariants_std

components = st.lists(st.floats(-1e4, 1e4), min_size=5, max_size=5).map(np.array)
quaternions = st.lists(st.floats(-1, 1), min_size=4, max_size=4).map(np.array).filter(lambda q: q @ q > 1e-3)


def rotation(q):
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(q).as_matrix()


def test_dipole_tensor_of_the_tests_is_the_derivative_of_its_field():
    point, moment, h = np.array([1.0, -2.0, 1.5]), np.array([3.0, 1.0, -2.0]), 1e-5
    steps = h * np.eye(3)
    numeric = np.stack([dipole_field(point + e, moment) - dipole_field(point - e, moment) for e in steps], axis=1)
    numeric /= 2 * h
    np.testing.assert_allclose(dipole_tensor(point, moment), numeric, rtol=1e-8, atol=1e-8)


@given(components, quaternions)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_five_and_full_and_their_rotation(g, q):
    turn = rotation(q)
    np.testing.assert_allclose(five(full(g)), g, atol=1e-11 * (1 + np.abs(g).max()))
    turned = turn @ full(g) @ turn.T
    scale = 1 + np.abs(g).max()
    np.testing.assert_allclose(full(rotation_of_five(turn) @ g), turned, atol=1e-12 * scale)
    assert g @ METRIC @ g == pytest.approx(np.sum(full(g) ** 2), rel=1e-12, abs=1e-12)


def test_generators_are_the_derivative_of_the_representation():
    h = 1e-6
    for k in range(3):
        plus, minus = np.array([0, 0, 0, np.cos(h / 2)]), np.array([0, 0, 0, np.cos(h / 2)])
        plus[k], minus[k] = np.sin(h / 2), -np.sin(h / 2)
        numeric = (rotation_of_five(rotation(plus)) - rotation_of_five(rotation(minus))) / (2 * h)
        np.testing.assert_allclose(GENERATORS[k], numeric, atol=1e-9)


@given(components, quaternions)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_invariants_do_not_turn(g, q):
    turn, tensor = rotation(q), full(g)
    one, other = invariants(tensor[None]), invariants((turn @ tensor @ turn.T)[None])
    scale = 1e-12 + np.linalg.norm(tensor)
    for a, b, power in zip(one, other, (2, 3, 1, 1), strict=True):
        # the source strength is a root: rounding of 1e-16 in its square is 1e-8 where it vanishes
        np.testing.assert_allclose(a, b, atol=1e-7 * scale**power, rtol=1e-9)


def test_invariants_by_definition():
    tensor = full(np.array([2.0, -1.0, 0.5, 1.0, 3.0]))
    low, middle, high = np.linalg.eigvalsh(tensor)
    found = invariants(tensor[None])
    minors = sum(np.linalg.det(tensor[np.ix_(k, k)]) for k in ([0, 1], [0, 2], [1, 2]))
    assert found.i1[0] == pytest.approx(minors)  # Pedersen and Rasmussen's form
    assert found.i2[0] == pytest.approx(low * middle * high)
    assert found.magnitude[0] == pytest.approx(np.sqrt(low**2 + middle**2 + high**2))
    assert found.source_strength[0] == pytest.approx(np.sqrt(-(middle**2) - low * high))


def test_source_strength_of_a_dipole_is_the_same_in_every_direction():
    rng = np.random.default_rng(1)
    moment = np.array([10.0, -30.0, 20.0])
    directions = rng.normal(size=(50, 3))
    points = 4.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    tensors = np.stack([dipole_tensor(p, moment) for p in points])
    expected = 3 * MU0_OVER_4PI * np.linalg.norm(moment) / 4.0**4
    np.testing.assert_allclose(invariants(tensors).source_strength, expected, rtol=1e-9)
    assert np.ptp(invariants(tensors).magnitude) > 0.2 * expected


def monte_carlo(tensor, covariance, rng, draws=40000):
    noisy = full(five(tensor) + rng.multivariate_normal(np.zeros(5), covariance, draws))
    return [np.std(column) for column in invariants(noisy)]


@pytest.mark.parametrize("first, second", [(100.0, -20.0), (100.0, 20.0), (90.0, -3.0), (-60.0, 75.0)])
def test_standard_deviations_agree_with_monte_carlo(first, second):
    rng = np.random.default_rng(2)
    turn = random_rotations(rng, 1)[0]
    tensor = turn @ np.diag([first, second, -first - second]) @ turn.T
    mix = rng.normal(size=(5, 5))
    covariance = 0.02 * (mix @ mix.T + np.eye(5))
    found = invariants_std(tensor[None], covariance)
    for analytic, sampled in zip(found, monte_carlo(tensor, covariance, rng), strict=True):
        assert analytic[0] == pytest.approx(sampled, rel=0.02)


def test_repeated_eigenvalues_give_a_safe_deviation_whatever_eigenvectors_come_out():
    rng = np.random.default_rng(3)
    covariance = 0.3 * np.linalg.inv(METRIC)  # the same in every frame
    found = []
    for turn in random_rotations(rng, 5):
        for shape in ([2, -1, -1], [1, 1, -2]):
            tensor = turn @ np.diag(50.0 * np.array(shape)) @ turn.T
            analytic = invariants_std(tensor[None], covariance).source_strength[0]
            sampled = monte_carlo(tensor, covariance, rng, 20000)[3]
            assert 0.98 * sampled <= analytic <= 1.55 * sampled
            found.append(analytic)
    assert np.ptp(found) < 1e-6 * np.mean(found)


@pytest.mark.parametrize("gap", [0.1, 0.5, 1.0, 3.0])
def test_nearly_repeated_eigenvalues(gap):
    rng = np.random.default_rng(4)
    covariance = 0.3 * np.linalg.inv(METRIC)
    tensor = np.diag([100.0, -50.0 + gap / 2, -50.0 - gap / 2])
    analytic = invariants_std(tensor[None], covariance).source_strength[0]
    assert 0.97 <= analytic / monte_carlo(tensor, covariance, rng)[3] <= 1.55


def test_a_vanishing_tensor_and_missing_samples():
    tensors = np.zeros((3, 3, 3))
    tensors[1] = np.nan
    tensors[2] = np.diag([2.0, -1.0, -1.0])
    found, std = invariants(tensors), invariants_std(tensors, np.stack([0.1 * np.eye(5)] * 3))
    for column in (*found, *std):
        assert np.isnan(column[1]) and np.isfinite(column[[0, 2]]).all()
    sampled = monte_carlo(tensors[0], 0.1 * np.eye(5), np.random.default_rng(5))
    assert std.magnitude[0] >= sampled[2] and std.source_strength[0] >= sampled[3]


def test_wrong_shapes_are_data_errors():
    with pytest.raises(DataError, match="tensor"):
        invariants(np.zeros((3, 3)))
    with pytest.raises(DataError, match="covariance"):
        invariants_std(np.zeros((4, 3, 3)), np.zeros((3, 3)))


def test_separate_elements_and_closure():
    tensor = np.arange(9.0).reshape(1, 3, 3)
    assert separate(tensor)["Bxy"] == 1 and separate(tensor)["Byx"] == 3
    assert {k: float(v[0]) for k, v in closure(tensor).items()} == {
        "trace": 12.0, "Bxy - Byx": -2.0, "Bxz - Bzx": -4.0, "Byz - Bzy": -2.0,
    }  # fmt: skip
