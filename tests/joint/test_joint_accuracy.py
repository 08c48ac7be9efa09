"""The joint fit against the limit that noise sets: METHODS A4.7 and A4.8, and Monte Carlo of its covariance."""

from __future__ import annotations

import numpy as np
import pytest
from joint_cases import Drawn, drawn, fitted, tensor_error, truth

from magtensor.calibration.joint import fit_joint


@pytest.mark.parametrize(
    ("tilt_deg", "samples", "published"),
    [(None, 12, 1.83), (None, 30, 1.05), (None, 200, 0.40), (20.0, 12, 1.92), (20.0, 30, 1.08), (20.0, 200, 0.41)],
)
def test_tensor_error_of_methods_a48(tilt_deg: float | None, samples: int, published: float) -> None:
    errors = []
    for seed in range(20):
        survey = drawn(1000 * samples + seed, samples, tilt_deg=tilt_deg)
        fresh = drawn(1000 * samples + seed, 400, tilt_deg=tilt_deg)  # the same array: it is drawn first
        other = Drawn(survey.forward, survey.offset, fresh.field, fresh.total_field, fresh.raw)
        errors.append(tensor_error(other, fitted(survey)))
    # of the median of 20 draws, each side, 3 standard deviations; the published medians have their own scatter
    scatter = 1.25 * np.std(errors) / np.sqrt(len(errors))
    assert abs(np.median(errors) - published) < 3.0 * scatter + 0.02 * published


def standardised(survey: Drawn, **options: object) -> tuple[np.ndarray, float, int]:
    """Errors of all 12 S parameters over their standard deviations, Mahalanobis square and the covariance's rank."""
    found = fitted(survey, **options)
    matrix, offset = truth(survey)
    error = np.concatenate(
        [
            np.concatenate([(a - b).ravel(), c - d])
            for a, b, c, d in zip(found.matrix, matrix, found.offset, offset, strict=True)
        ]
    )
    std = np.sqrt(np.diag(found.covariance))
    values, vectors = np.linalg.eigh(found.covariance / np.outer(std, std))
    seen = values > 1e-9 * values[-1]
    z = error / std
    return z, float(np.sum((vectors[:, seen].T @ z) ** 2 / values[seen])), int(seen.sum())


@pytest.mark.parametrize(
    ("sensors", "tilt_deg", "samples"),
    [
        (1, None, 400),
        (1, 20.0, 400),
        (2, None, 400),
        (2, 20.0, 400),
        (3, 20.0, 400),
        (4, None, 400),
        (4, 20.0, 400),
        (4, None, 40),
    ],
)
def test_covariance_is_that_of_the_errors(sensors: int, tilt_deg: float | None, samples: int) -> None:
    errors, squares = [], []
    for seed in range(60):
        z, square, rank = standardised(drawn(seed, samples, sensors=sensors, tilt_deg=tilt_deg))
        assert rank == 12 * sensors - 3  # the frame's own condition takes three
        errors.append(z)
        squares.append(square / rank)
    pooled = np.array(errors)
    # parameters share their errors, so that 60 surveys hold some 60 x 4 independent ones: 1.4 % on the coverage
    assert 0.91 < np.mean(np.abs(pooled) < 1.96) < 0.985
    assert np.mean(pooled**2) == pytest.approx(1.0, abs=0.25)
    # a mean of chi-squares of known freedom over 60 surveys; noise estimated per survey adds a little
    assert np.mean(squares) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (60 * (12 * sensors - 3))) + 0.02)


@pytest.mark.long
def test_coverage_of_all_kinds_of_survey_together() -> None:
    inside = []
    for seed in range(40):
        for sensors, tilt_deg in ((1, None), (1, 20.0), (2, None), (2, 20.0), (3, None), (4, 20.0)):
            z, _, _ = standardised(drawn(700 + seed, 300, sensors=sensors, tilt_deg=tilt_deg))
            inside.append(np.abs(z) < 1.96)
    assert 0.93 < np.mean(np.concatenate(inside)) < 0.97


def test_covariance_with_axes_of_different_noise_and_a_noisy_reference() -> None:
    noise = np.random.default_rng(8).uniform(0.3, 3.0, (4, 3))
    squares = []
    for seed in range(40):
        survey = drawn(seed, 600, noise_nT=noise)
        reference = survey.total_field + 2.0 * np.random.default_rng(900 + seed).standard_normal(600)
        noisy = Drawn(survey.forward, survey.offset, survey.field, reference, survey.raw)
        _, square, rank = standardised(noisy)  # nobody said how noisy the reference is
        squares.append(square / rank)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("noise_nT", [30.0, 100.0])
def test_no_bias_where_attitudes_cover_a_cap(noise_nT: float) -> None:
    """A cap of 50 deg and 5000 samples, METHODS A4.7: plain least squares of |b| - F is off by 6 and more standard
    deviations, and by as many nT with any number of samples."""
    errors = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        z = rng.uniform(np.cos(np.radians(50.0)), 1.0, 5000)
        heading = rng.uniform(0, 2 * np.pi, 5000)
        across = np.sqrt(1 - z**2)
        field = 50_000.0 * np.column_stack([across * np.cos(heading), across * np.sin(heading), z])
        raw = (field + noise_nT * rng.standard_normal(field.shape))[:, None]
        fit = fit_joint(raw, np.full(5000, 50_000.0), worst_error=1.0, robust=False)
        errors.append(fit.offset[0, 2])
    # scatter 75 and 240 nT in METHODS; plain least squares -452 and thousands
    assert np.std(errors) < 3.4 * noise_nT
    assert abs(np.mean(errors)) < 3.0 * np.std(errors) / np.sqrt(len(errors))


def test_noise_of_each_axis_is_found() -> None:
    noise = np.random.default_rng(4).uniform(0.5, 2.0, (4, 3))
    samples = 3000
    found = fit_joint(*_data(drawn(3, samples, noise_nT=noise))).plane.noise.reshape(4, 3)
    # second differences of white noise: variance known to sqrt(2 x 1.94 / N), of which a standard deviation has
    # half; an axis quieter than its neighbours is found from a residual that is partly theirs: up to 3 times that
    scatter = np.sqrt(1.94 / (2 * samples))
    np.testing.assert_allclose(found / noise, 1.0, atol=4 * 3 * scatter)
    assert np.sqrt(np.mean((found / noise - 1) ** 2)) < 2.5 * scatter


def test_noise_of_two_sensors_is_told_apart_by_the_total_field() -> None:
    noise = np.array([[0.5] * 3, [2.0] * 3])
    found = fit_joint(*_data(drawn(5, 4000, sensors=2, noise_nT=noise))).plane.noise.reshape(2, 3)
    rms = np.sqrt((found**2).mean(axis=1))
    assert rms[1] == pytest.approx(2.0, rel=0.1)
    assert rms[0] == pytest.approx(0.5, rel=0.4)


def _data(survey: Drawn) -> tuple[np.ndarray, np.ndarray]:
    return survey.raw, survey.total_field
