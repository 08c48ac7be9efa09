"""A fit that no scalar reference supports: everything but one scale is known, and as well as the data allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from joint_cases import drawn, tensor_error
from several_cases import Case, errors, require_as_stated, require_at_bound, surveys

from magtensor.calibration.common_scale import nominal, nominal_scale
from magtensor.calibration.joint import calibrated, fit_joint, nearest_frame
from magtensor.calibration.surveys.corrections import calibrated_surveys
from magtensor.calibration.surveys.fit import fit_surveys
from magtensor.calibration.surveys.samples import Samples
from magtensor.errors import NotEnoughData


def constant(seed: int, **options: object) -> tuple[Samples, np.ndarray]:
    """A survey in a constant field that the fit is told wrongly, and its true corrections with nominal sensitivity."""
    survey = drawn(seed, 400, **options)  # type: ignore[arg-type]
    steady = survey.field * (50_000.0 / survey.total_field)[:, None]
    raw = survey.raw + np.einsum("sij,nj->nsi", survey.forward, steady - survey.field)
    none = np.zeros(400, dtype=int)
    matrix = np.linalg.inv(survey.forward @ nearest_frame(survey.forward))
    return Samples(raw, np.full(400, 47_000.0), none, none), matrix * nominal(matrix).factor


@pytest.mark.parametrize(("sensors", "tilt_deg"), [(1, None), (4, 30.0)])
def test_standard_errors_with_one_unknown_constant(sensors: int, tilt_deg: float | None) -> None:
    pooled, squares = [], []
    for seed in range(60):
        samples, matrix = constant(seed, sensors=sensors, tilt_deg=tilt_deg)
        found, _, _ = nominal_scale(calibrated(fit_joint(samples.raw, samples.total_field, worst_error=1.0)))
        at = np.concatenate([12 * s + np.arange(9) for s in range(sensors)])
        covariance = found.covariance[np.ix_(at, at)]
        error = (found.matrix - matrix).ravel()
        std = np.sqrt(np.diag(covariance))
        values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
        seen = values > 1e-9 * values[-1]
        assert seen.sum() == 9 * sensors - 4  # three of the frame's condition, one of the scale's
        pooled.append(error / std)
        squares.append(np.sum((vectors[:, seen].T @ pooled[-1]) ** 2 / values[seen]) / seen.sum())
    assert np.mean(np.square(pooled)) == pytest.approx(1.0, abs=0.25)
    assert 0.91 < np.mean(np.abs(pooled) < 1.96) < 0.985
    assert np.mean(squares) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (60 * (9 * sensors - 4))) + 0.03)


@pytest.mark.parametrize(
    "case",
    [
        Case(levels=5, tilt_deg=40.0),
        Case(levels=3, sensors=1),
        Case(samples=(150, 250), levels=2),
        Case(samples=(60, 60, 60), levels=1, tilt_deg=40.0, sensors=2),
    ],
    ids=str,
)
def test_errors_where_the_field_is_unknown_in_every_segment(case: Case) -> None:
    found = [errors(surveys(seed, case)) for seed in range(40)]
    require_as_stated(found)
    require_at_bound(found, parameters=8)
    assert np.mean([f.square for f in found]) == pytest.approx(1.0, abs=0.2)


def test_contrasts_lose_nothing() -> None:
    ratios = []
    for seed in range(20):
        survey = drawn(seed, 200, tilt_deg=30.0)
        none = np.zeros(200, dtype=int)
        samples = Samples(survey.raw, np.full(200, 50_000.0), none, none, none)
        without = calibrated_surveys(fit_surveys(samples, worst_error=1.0)).of_survey(0)
        known = calibrated(fit_joint(survey.raw, survey.total_field, worst_error=1.0))
        ratios.append(tensor_error(survey, without) / tensor_error(survey, known))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.02)


def test_a_wrong_declared_field_is_a_scale_and_nothing_else() -> None:
    samples, matrix = constant(3)
    one = calibrated(fit_joint(samples.raw, samples.total_field))
    other = calibrated(fit_joint(samples.raw, samples.total_field * 1.1))
    np.testing.assert_allclose(other.matrix, 1.1 * one.matrix, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(other.offset, one.offset, atol=1e-4)
    for found in (one, other):
        scaled, _, std = nominal_scale(found)
        assert np.mean(np.log(np.linalg.det(scaled.matrix))) == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_allclose(scaled.matrix, matrix, atol=2e-4)
        assert 0 < std < 1e-4
        # what the convention fixes has no variance
        slope = np.zeros((4, 12))
        slope[:, :9] = np.linalg.inv(scaled.matrix).transpose(0, 2, 1).reshape(4, 9)
        assert slope.ravel() @ scaled.covariance @ slope.ravel() < 1e-20


def test_mean_of_unknown_constants_can_be_declared() -> None:
    truth = surveys(5, Case(levels=4))
    found = fit_surveys(truth.samples, mean_field=float(np.mean(np.linalg.norm(truth.field, axis=1))))
    matrix = np.linalg.inv(truth.forward @ nearest_frame(truth.forward))
    np.testing.assert_allclose(calibrated_surveys(found).common.matrix, matrix, atol=3e-5)
    levels = found.found.sums.total_field
    np.testing.assert_allclose(levels, np.linalg.norm(truth.field, axis=1), atol=1.0)


def test_a_field_unknown_at_every_posture_is_refused() -> None:
    truth = surveys(6, Case(samples=(300,)))
    samples = truth.samples
    posture = np.arange(300) // 10
    raw = samples.raw[posture * 10]
    noisy = raw + np.random.default_rng(1).standard_normal(raw.shape)
    with pytest.raises(NotEnoughData, match="tells a change of sensitivity"):
        fit_surveys(replace(samples, raw=noisy, level=posture))


def test_attitudes_too_few_within_segments_are_refused() -> None:
    # two attitudes in each of eight segments: the quadric of nine shapes and eight constants is not determined
    truth = surveys(7, Case(samples=(16,), levels=8))
    with pytest.raises(NotEnoughData):
        fit_surveys(truth.samples)
