"""What must hold of the joint fit whatever the data: derivatives, symmetry, robustness, refusals."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from joint_cases import Array, drawn, fitted, tensor_error, truth

from magtensor.calibration.common_field import common_field
from magtensor.calibration.joint import fit_joint
from magtensor.calibration.maximum_likelihood import Scores, along, fit_scalar, minimised, scores
from magtensor.errors import DataError, NotEnoughData

PAIRS = ((1, 2), (0, 2), (0, 1))


def changed(matrix: Array, offset: Array, step: Array) -> tuple[Array, Array]:
    """Matrix and offset whose field is b + E b + e, written anew."""
    e = np.diag(step[:3])
    for value, (i, j) in zip(step[3:6], PAIRS, strict=True):
        e[i, j] = e[j, i] = value
    matrix = (np.eye(3) + e) @ matrix
    return matrix, offset - np.linalg.inv(matrix) @ step[6:]


def cost(matrix: Array, offset: Array, y: Array, field: Array, reference_noise: float) -> float:
    """Sum of the squared distances from the surface, sample by sample."""
    total = 0.0
    for sample, f in zip(y, field, strict=True):
        b = matrix @ (sample - offset)
        u = b / np.linalg.norm(b)
        total += (np.linalg.norm(b) - f) ** 2 / (np.sum((matrix.T @ u) ** 2) + reference_noise**2)
    return total


@pytest.mark.parametrize("reference_noise", [0.0, 0.7])
def test_gradient_of_the_scalar_cost(reference_noise: float) -> None:
    rng = np.random.default_rng(2)
    # noise of a tenth of the field, so that the derivative of the denominator counts
    y = 10.0 * rng.standard_normal((50, 3)) / np.sqrt(3) + rng.standard_normal((50, 3))
    matrix = np.array([[1.1, 0.2, -0.1], [0.0, 0.9, 0.3], [0.1, 0.0, 1.3]])
    offset, field = np.array([0.4, -0.5, 0.6]), np.full(50, 10.0)
    found = scores(along(matrix, offset, y.T, field, reference_noise), field)
    assert found.cost == pytest.approx(cost(matrix, offset, y, field, reference_noise), rel=1e-12)

    def at(step: Array) -> float:
        return cost(*changed(matrix, offset, step), y, field, reference_noise)

    numeric = np.array([(at(1e-5 * e) - at(-1e-5 * e)) / 4e-5 for e in np.eye(9)])
    np.testing.assert_allclose(found.gradient, numeric, atol=1e-6 * np.abs(numeric).max())


def test_normal_matrix_is_the_curvature_without_noise() -> None:
    u = np.random.default_rng(4).standard_normal((60, 3))
    field = np.linspace(9.0, 11.0, 60)
    matrix, offset = np.array([[1.1, 0.2, -0.1], [0.0, 0.9, 0.3], [0.1, 0.0, 1.3]]), np.array([0.4, -0.5, 0.6])
    b = field[:, None] * u / np.linalg.norm(u, axis=1, keepdims=True)
    y = b @ np.linalg.inv(matrix).T + offset
    found = scores(along(matrix, offset, y.T, field, 0.3), field)

    def at(step: Array) -> float:
        return cost(*changed(matrix, offset, step), y, field, 0.3)

    h, axes = 1e-4, np.eye(9)
    curvature = [
        [
            (at(h * (a + b)) - at(h * (a - b)) - at(h * (b - a)) + at(-h * (a + b))) / (8 * h**2)
            for b in axes
        ]
        for a in axes
    ]  # fmt: skip
    np.testing.assert_allclose(found.normal, curvature, atol=1e-5 * np.abs(curvature).max())
    z = np.column_stack([b, np.ones(60)])
    np.testing.assert_allclose(found.moments, z.T @ z, rtol=1e-12, atol=1e-9)


def test_scalar_fit_is_a_minimum() -> None:
    rng = np.random.default_rng(3)
    u = rng.standard_normal((300, 3))
    y = 20.0 * u / np.linalg.norm(u, axis=1, keepdims=True) + rng.standard_normal((300, 3))
    field = np.full(300, 20.0)
    fit = fit_scalar(y, field)
    least = cost(fit.matrix, fit.offset, y, field, 0.0)
    assert fit.chi2 == pytest.approx(least / 291, rel=1e-12)
    std = np.sqrt(np.diag(np.linalg.inv(fit.scores.normal)))
    for e in np.eye(9):
        up, down = (cost(*changed(fit.matrix, fit.offset, s * 0.1 * std * e), y, field, 0.0) for s in (1, -1))
        # a tenth of a standard deviation raises the cost by 0.01 and more; the minimum lies within a thousandth
        assert min(up, down) > least
        assert abs(up - down) / (up + down - 2 * least) < 0.05


def test_common_field_is_the_plane_of_the_outputs() -> None:
    survey = drawn(1, 500, noise_nT=1.0)
    plane = common_field(survey.raw, np.ones((4, 3)))
    np.testing.assert_allclose(plane.basis.T @ plane.basis, np.eye(3), atol=1e-12)
    true = survey.forward.reshape(12, 3)
    off = true - plane.basis @ (plane.basis.T @ true)
    assert np.abs(off).max() < 5 / 50_000 * 5  # noise over field, five times
    residual = plane.residual(survey.raw)
    assert np.mean(np.sum(residual**2, axis=1)) / 9 == pytest.approx(1.0, abs=4 * np.sqrt(2 / (9 * 500)))
    assert np.abs(residual.mean(axis=0)).max() < 1e-9


def test_spikes_cost_little_and_are_flagged() -> None:
    with_spikes, without, not_robust = [], [], []
    for seed in range(8):
        survey = drawn(seed, 1500)
        rng = np.random.default_rng(50 + seed)
        hit = rng.choice(1500, 15, replace=False)
        raw = survey.raw.copy()
        raw[hit, rng.integers(0, 4, 15), rng.integers(0, 3, 15)] += 1000.0 * rng.choice([-1.0, 1.0], 15)
        spoiled = replace(survey, raw=raw)
        fit = fit_joint(raw, survey.total_field)
        assert not fit.keep[hit].any()
        assert (~fit.keep).sum() <= 15 + 2
        with_spikes.append(tensor_error(survey, fitted(spoiled)))
        without.append(tensor_error(survey, fitted(survey)))
        not_robust.append(tensor_error(survey, fitted(spoiled, robust=False)))
    rms = [float(np.sqrt(np.mean(np.square(e)))) for e in (with_spikes, without, not_robust)]
    assert rms[0] < 1.1 * rms[1]
    assert rms[2] > 3.0 * rms[1]


@pytest.mark.parametrize("sensors", [1, 2])
def test_spikes_of_few_sensors_are_flagged(sensors: int) -> None:
    survey = drawn(4, 1000, sensors=sensors)
    raw = survey.raw.copy()
    hit = np.arange(50, 1000, 100)
    raw[hit, sensors - 1] += 600.0  # 600 nT on all three axes: never across the field alone
    fit = fit_joint(raw, survey.total_field)
    along = np.abs(survey.field[hit].sum(axis=1)) / 50_000 > 0.1
    assert not fit.keep[hit[along]].any()
    assert (~fit.keep).sum() <= len(hit) + 2


@pytest.mark.parametrize("sensors", [1, 2, 4])
def test_turning_all_axes_turns_the_calibration(sensors: int) -> None:
    survey = drawn(6, 300, sensors=sensors)
    turn = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    assert np.linalg.det(turn) == pytest.approx(1.0)
    here, there = fitted(survey), fitted(replace(survey, raw=survey.raw @ turn.T))
    np.testing.assert_allclose(there.matrix, turn @ here.matrix @ turn.T, atol=1e-8)
    np.testing.assert_allclose(there.offset, here.offset @ turn.T, atol=1e-4)


@pytest.mark.parametrize("sensors", [1, 4])
def test_units_change_nothing_else(sensors: int) -> None:
    survey = drawn(7, 300, sensors=sensors)
    here = fitted(survey)
    micro = fitted(replace(survey, raw=survey.raw * 1e-3, total_field=survey.total_field * 1e-3))
    np.testing.assert_allclose(micro.matrix, here.matrix, atol=1e-8)
    np.testing.assert_allclose(micro.offset, 1e-3 * here.offset, atol=1e-7)
    counts = fitted(replace(survey, raw=survey.raw * 7.0))
    np.testing.assert_allclose(counts.matrix, here.matrix / 7.0, atol=1e-8)
    scale = np.tile(np.concatenate([np.full(9, 1 / 7.0), np.full(3, 7.0)]), sensors)
    np.testing.assert_allclose(
        np.sqrt(np.diag(counts.covariance)), scale * np.sqrt(np.diag(here.covariance)), rtol=1e-4
    )


def test_the_order_of_sensors_and_samples_does_not_matter() -> None:
    survey = drawn(8, 300)
    noise = np.ones((4, 3))
    here = fitted(survey, noise=noise)
    order = [2, 0, 3, 1]
    there = fitted(replace(survey, raw=survey.raw[:, order]), noise=noise)
    np.testing.assert_allclose(there.matrix, here.matrix[order], atol=1e-9)
    mixed = np.random.default_rng(1).permutation(300)
    again = fitted(replace(survey, raw=survey.raw[mixed], total_field=survey.total_field[mixed]), noise=noise)
    np.testing.assert_allclose(again.matrix, here.matrix, atol=1e-9)


def test_without_noise_the_answer_is_exact() -> None:
    survey = drawn(9, 60, noise_nT=1e-6)
    matrix, offset = truth(survey)
    found = fitted(survey)
    np.testing.assert_allclose(found.matrix, matrix, atol=1e-9)
    np.testing.assert_allclose(found.offset, offset, atol=1e-5)


def test_rotations_are_proper() -> None:
    for seed in range(5):
        assert (np.linalg.det(fitted(drawn(seed, 100)).matrix) > 0).all()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_inverted_axis_is_told(axis: int) -> None:
    survey = drawn(10, 200)
    raw = survey.raw.copy()
    raw[:, 2, axis] *= -1
    with pytest.raises(DataError, match="xyz"[axis]):
        fit_joint(raw, survey.total_field)


@pytest.mark.parametrize("sensors", [1, 4])
def test_turning_about_one_axis_is_refused(sensors: int) -> None:
    angle = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    survey = drawn(11, 300, sensors=sensors)
    field = 50_000.0 * np.column_stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), np.full(300, np.sqrt(0.75))])
    raw = np.einsum("sij,nj->nsi", survey.forward, field) + survey.offset
    raw = raw + np.random.default_rng(1).standard_normal(raw.shape)
    with pytest.raises(NotEnoughData):
        fit_joint(raw, np.full(300, 50_000.0))


def test_four_attitudes_are_refused() -> None:
    survey = drawn(12, 4)
    with pytest.raises(NotEnoughData):
        fit_joint(survey.raw, survey.total_field)


def test_error_falls_with_the_number_of_samples() -> None:
    errors = [
        np.median([tensor_error(s, fitted(s)) for s in (drawn(seed, n) for seed in range(6))]) for n in (50, 800, 12800)
    ]
    assert all(3.0 < a / b < 5.3 for a, b in pairwise(errors))  # 4 by the square root


def test_the_noise_does_not_lose_digits_beside_a_large_field() -> None:
    """The plane takes the part of the noise that goes with the field, however large that is, but for the square of
    noise over field: a few millionths for the smaller one."""
    rng = np.random.default_rng(3)
    field = rng.standard_normal((2000, 1, 3))
    noise = 0.1 * rng.standard_normal((2000, 4, 3))
    small, large = (common_field(size * field + noise).noise for size in (100.0, 50_000.0))
    np.testing.assert_allclose(large, small, rtol=1e-5)


def test_a_step_too_far_is_taken_back_without_a_word() -> None:
    """Its lengths overflow, which is a RuntimeWarning anywhere else."""
    rng = np.random.default_rng(7)
    u = rng.standard_normal((3, 200))
    y, total = u / np.linalg.norm(u, axis=0) * 300.0 + rng.standard_normal((3, 200)), np.full(200, 300.0)
    asked = 0

    def at(matrix: Array, offset: Array) -> Scores:
        nonlocal asked
        asked += 1
        there = 1e200 * matrix if asked == 2 else matrix  # the first step
        return scores(along(there, offset, y, total, 0.0), total)

    found = minimised(np.diag([1.01, 0.99, 1.0]), np.array([2.0, -1.0, 0.0]), at)
    assert found.chi2 == pytest.approx(1.0, abs=0.4)  # 191 degrees of freedom: four deviations
    assert np.abs(found.matrix - np.eye(3)).max() < 0.01
