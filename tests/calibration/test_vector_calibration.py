"""Calibration against a known vector."""

import numpy as np
import pytest
from paper_setups import LI_FIELD, directions, li_response

from magtensor import DataError, NotEnoughData
from magtensor.calibration.vector import levenberg_marquardt
from magtensor_methods import li2018_lm, linear_regression

METHODS = [linear_regression, li2018_lm]


def measure(rng: np.random.Generator, count: int, noise: float, sensor: int = 0, turn: np.ndarray | None = None):
    c, o = li_response()
    response = c[sensor] if turn is None else c[sensor] @ turn
    field = LI_FIELD * directions(rng, count)
    return field @ response.T + o[sensor] + noise * rng.normal(size=(count, 3)), field, response, o[sensor]


@pytest.mark.parametrize("method", METHODS)
def test_noise_free(method) -> None:
    raw, field, response, offset = measure(np.random.default_rng(1), 20, 0.0)
    found = method(raw, field)
    np.testing.assert_allclose(found.matrix, np.linalg.inv(response), atol=1e-12)
    np.testing.assert_allclose(found.offset, offset, atol=1e-7)
    assert found.frame == "platform"


@pytest.mark.parametrize("method", METHODS)
def test_standardised_errors(method) -> None:
    rng = np.random.default_rng(2)
    squared = []
    for _ in range(200):
        raw, field, response, offset = measure(rng, 60, 2.0)
        found = method(raw, field)
        error = np.concatenate([(found.matrix - np.linalg.inv(response)).ravel(), found.offset - offset])
        squared.append(error @ np.linalg.solve(found.covariance, error))
    # 12 parameters; 168 degrees of freedom of the noise raise the mean by 168/166
    assert np.mean(squared) == pytest.approx(12.1, abs=4 * np.sqrt(24 / 200))


def test_li_ends_at_the_linear_solution() -> None:
    """The cost is quadratic in the rows of the correction, so Levenberg-Marquardt has one place to end."""
    rng = np.random.default_rng(3)
    raw, field, _, _ = measure(rng, 40, 30.0)
    fit = levenberg_marquardt(raw, field)
    closed = np.linalg.lstsq(np.column_stack([raw, np.ones(40)]), field, rcond=None)[0]
    np.testing.assert_allclose(fit.matrix, closed[:3].T, atol=1e-9)
    np.testing.assert_allclose(-fit.matrix @ fit.offset, closed[3], atol=1e-4)


@pytest.mark.parametrize(
    "turn",
    [
        np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
        np.diag([-1.0, -1, 1]),
        np.diag([1.0, -1, -1]),
        np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    ],
)
def test_li_finds_sensors_mounted_at_right_angles(turn: np.ndarray) -> None:
    raw, field, response, _ = measure(np.random.default_rng(4), 40, 1.0, turn=turn)
    np.testing.assert_allclose(li2018_lm(raw, field).matrix, np.linalg.inv(response), atol=1e-4)


def test_robust_regression_withstands_outliers() -> None:
    rng = np.random.default_rng(5)
    raw, field, _, offset = measure(rng, 400, 1.0)
    raw[::50] += 3000.0
    plain, robust = (linear_regression(raw, field, robust=r) for r in (False, True))
    assert np.abs(plain.offset - offset).max() > 20
    assert np.abs(robust.offset - offset).max() < 0.6
    assert robust.diagnostics["noise_nT"] < 2


def test_robust_errors_are_honest_on_clean_data() -> None:
    rng = np.random.default_rng(6)
    squared = []
    for _ in range(120):
        raw, field, _, offset = measure(rng, 80, 2.0)
        found = linear_regression(raw, field, robust=True)
        error = found.offset - offset
        squared.append(error @ np.linalg.solve(found.covariance[9:, 9:], error) / 3)
    assert np.mean(squared) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 360))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("count", [10, 2000])
def test_field_in_a_plane_is_refused(method, noise: float, count: int) -> None:
    rng = np.random.default_rng(7)
    c, o = li_response()
    turn = rng.uniform(0, 2 * np.pi, count)
    field = LI_FIELD * np.column_stack([0.8 * np.cos(turn), 0.8 * np.sin(turn), np.full(count, 0.6)])
    raw = field @ c[0].T + o[0] + noise * rng.normal(size=(count, 3))
    with pytest.raises(NotEnoughData, match="do not determine twelve parameters: along"):
        method(raw, field)


def test_mirrored_and_dead_axes() -> None:
    raw, field, _, _ = measure(np.random.default_rng(8), 40, 1.0)
    with pytest.raises(DataError, match="mirrors"):
        li2018_lm(raw * [1, -1, 1], field)
    assert np.linalg.det(linear_regression(raw * [1, -1, 1], field).matrix) < 0
    raw[:, 2] = 5.0
    with pytest.raises(DataError):
        linear_regression(raw, field)
    with pytest.raises(DataError):
        li2018_lm(raw, field)
    with pytest.raises(NotEnoughData):
        linear_regression(raw[:4], field[:4])
