"""Every Jacobian of the calibration methods against central differences."""

import numpy as np
import pytest
from paper_setups import CHI_FIELD, chi_response, directions

from magtensor.calibration import alignment
from magtensor.calibration.covariance import scalar_influence, scalar_jacobian
from magtensor.calibration.factors import embedding, factor, rotation_and_upper
from magtensor.calibration.parameters import CHI, LI, Convention, parameters, response, response_derivatives
from magtensor.calibration.quadric import design, design_derivative, ellipsoid_restricted, fit_ellipsoid
from magtensor.calibration.rotation import from_vector, to_vector
from magtensor.calibration.vector import affine_to_correction, compressed_jacobian, compressed_residual

VALUES = np.array([0.2, -0.3, 0.1, 1.2, 0.9, 0.8, 0.01, -0.02, 0.03, 0.4, -0.5, 0.6])


def central(f, x: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """Columns of the derivative of f, flattened, at x."""
    columns = []
    for k in range(x.size):
        e = np.zeros(x.size)
        e[k] = step
        e = e.reshape(x.shape)
        columns.append((np.ravel(f(x + e)) - np.ravel(f(x - e))) / (2 * step))
    return np.array(columns).T


@pytest.mark.parametrize("frame", ["cholesky", "polar"])
def test_scalar_jacobian(frame: str) -> None:
    rng = np.random.default_rng(1)
    c, o = chi_response()
    raw = (CHI_FIELD * directions(rng, 20)) @ c[1].T + o[1]
    inverse = np.linalg.inv(c[1])
    matrix = factor(inverse.T @ inverse, frame)

    def size(p: np.ndarray) -> np.ndarray:
        moved = embedding(frame) @ (p * np.array([1.0] * 6 + [CHI_FIELD] * 3))
        m, offset = matrix + moved[:9].reshape(3, 3), o[1] + moved[9:]
        return np.linalg.norm((raw - offset) @ m.T, axis=1) / CHI_FIELD

    exact = scalar_jacobian(matrix, o[1], raw, frame) / CHI_FIELD * np.array([1.0] * 6 + [CHI_FIELD] * 3)
    np.testing.assert_allclose(exact, central(size, np.zeros(9)), atol=1e-8)


@pytest.mark.parametrize("frame", ["cholesky", "polar"])
def test_influence_is_the_derivative_of_the_fit(frame: str) -> None:
    rng = np.random.default_rng(2)
    c, o = chi_response()
    raw = (CHI_FIELD * directions(rng, 15)) @ c[0].T + o[0]
    field = np.full(15, CHI_FIELD)

    def fitted(noise: np.ndarray) -> np.ndarray:
        found = fit_ellipsoid(raw + noise, field, ellipsoid_restricted)
        return np.concatenate([factor(found.shape, frame).ravel() * CHI_FIELD, found.offset])

    ellipsoid = fit_ellipsoid(raw, field, ellipsoid_restricted)
    influence = scalar_influence(factor(ellipsoid.shape, frame), ellipsoid.offset, raw, field, frame)
    linear = np.einsum("pj,je->pje", influence.gain, influence.direction).reshape(12, 45)
    linear[:9] *= CHI_FIELD
    np.testing.assert_allclose(linear, central(fitted, np.zeros((15, 3)), 0.5), atol=2e-4)


def test_design_derivative() -> None:
    x = np.random.default_rng(3).normal(size=(7, 3))
    for axis in range(3):
        e = 1e-6 * np.eye(3)[axis]
        numeric = (design(x + e) - design(x - e)) / 2e-6
        np.testing.assert_allclose(design_derivative(x, axis), numeric, atol=1e-8)


@pytest.mark.parametrize("convention", [CHI, LI])
def test_response_derivatives(convention: Convention) -> None:
    exact = response_derivatives(VALUES, convention).reshape(12, 9).T
    np.testing.assert_allclose(exact, central(lambda p: response(p, convention)[0], VALUES), atol=1e-9)


@pytest.mark.parametrize("convention", [CHI, LI])
def test_parameters_return_with_their_derivatives(convention: Convention) -> None:
    c, offset = response(VALUES, convention)
    matrix = np.linalg.inv(c)
    found = parameters(matrix, offset, np.zeros((12, 12)), convention)
    np.testing.assert_allclose(found.values, VALUES, atol=1e-12)

    def of(p: np.ndarray) -> np.ndarray:
        return parameters(p[:9].reshape(3, 3), p[9:], np.zeros((12, 12)), convention).values

    jacobian = central(of, np.concatenate([matrix.ravel(), offset]))
    root = np.random.default_rng(5).normal(size=(12, 12))
    covariance = root @ root.T
    np.testing.assert_allclose(
        parameters(matrix, offset, covariance, convention).covariance,
        jacobian @ covariance @ jacobian.T,
        rtol=1e-6,
        atol=1e-6,
    )


def test_li_jacobian_of_the_compressed_residual() -> None:
    rng = np.random.default_rng(6)
    triangle, target = np.triu(rng.normal(size=(4, 4))), rng.normal(size=(4, 3))
    exact = compressed_jacobian(VALUES, triangle, target)
    numeric = central(lambda p: compressed_residual(p, triangle, target), VALUES)
    np.testing.assert_allclose(exact, numeric, atol=1e-8)


def test_affine_to_correction() -> None:
    rng = np.random.default_rng(7)
    matrix, offset = np.eye(3) + 0.1 * rng.normal(size=(3, 3)), rng.normal(size=3)

    def correction(rows: np.ndarray) -> np.ndarray:
        m, x0 = rows[:, :3], rows[:, 3]
        return np.concatenate([m.ravel(), -np.linalg.solve(m, x0)])

    rows = np.column_stack([matrix, -matrix @ offset])
    np.testing.assert_allclose(affine_to_correction(matrix, offset), central(correction, rows), atol=1e-8)


@pytest.mark.parametrize("aligner", [alignment.procrustes, alignment.three_angles, alignment.linear_elements])
def test_turn_is_the_derivative_of_the_rotation(aligner: alignment.Aligner) -> None:
    rng = np.random.default_rng(8)
    source = directions(rng, 12)
    rotation = from_vector(np.array([0.2, -0.1, 0.3]))
    target = source @ rotation.T

    def turned(disturbance: np.ndarray) -> np.ndarray:
        return to_vector(aligner(target + disturbance, source).rotation @ rotation.T)

    found = aligner(target, source)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    linear = np.einsum("wai,ji->wja", found.turn.reshape(3, 3, 3), target).reshape(3, 36)
    np.testing.assert_allclose(linear, central(turned, np.zeros((12, 3)), 1e-5), atol=1e-8)


def test_rotation_and_upper_multiply_to_the_matrix() -> None:
    rng = np.random.default_rng(9)
    for sign in (1.0, -1.0):
        matrix = rng.normal(size=(3, 3))
        matrix *= sign * np.sign(np.linalg.det(matrix))
        q, r = rotation_and_upper(matrix)
        np.testing.assert_allclose(q @ r, matrix, atol=1e-14)
        assert np.all(np.diag(r) > 0) and np.allclose(np.tril(r, -1), 0)
        assert np.linalg.det(q) == pytest.approx(sign)
