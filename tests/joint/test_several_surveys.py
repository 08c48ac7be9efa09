"""Several surveys of one array in one fit: one C, own offsets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from joint_cases import drawn
from several_cases import Case, errors, fitted, require_as_stated, require_at_bound, surveys, true_matrix

from magtensor.calibration.joint import calibrated, fit_joint
from magtensor.calibration.surveys.corrections import calibrated_surveys
from magtensor.calibration.surveys.fit import fit_surveys
from magtensor.calibration.surveys.samples import Samples
from magtensor.errors import DataError, NotEnoughData


@pytest.mark.parametrize("sensors", [1, 2, 4])
@pytest.mark.parametrize("reference_noise", [0.0, 2.0])
def test_one_survey_is_the_joint_fit(sensors: int, reference_noise: float) -> None:
    survey = drawn(3, 300, sensors=sensors)
    none = np.zeros(300, dtype=int)
    fit = fit_surveys(Samples(survey.raw, survey.total_field, none, none), reference_noise=reference_noise)
    found = calibrated_surveys(fit).of_survey(0)
    expected = calibrated(fit_joint(survey.raw, survey.total_field, reference_noise=reference_noise))
    np.testing.assert_allclose(found.matrix, expected.matrix, atol=1e-8)
    np.testing.assert_allclose(found.offset, expected.offset, atol=2e-3 if sensors == 2 else 1e-4)
    std, wanted = (np.sqrt(np.diag(c.covariance)) for c in (found, expected))
    np.testing.assert_allclose(std, wanted, rtol=2e-3 if sensors == 2 else 1e-5)


@pytest.mark.parametrize(
    "case",
    [
        Case(samples=(200, 100, 50), tilt_deg=25.0),
        Case(samples=(150, 150), sensors=1),
        pytest.param(Case(samples=(150, 150), sensors=2), marks=pytest.mark.long),
        pytest.param(Case(samples=(100, 200), apart_nT=0.0, tilt_deg=40.0), marks=pytest.mark.long),
        pytest.param(Case(samples=(150, 150), apart_nT=3000.0), marks=pytest.mark.long),
    ],
    ids=str,
)
def test_errors_are_those_that_noise_allows(case: Case) -> None:
    found = [errors(surveys(seed, case)) for seed in range(40)]
    require_as_stated(found)
    require_at_bound(found, parameters=12)
    assert np.mean([f.square for f in found]) == pytest.approx(1.0, abs=0.2)


def test_postures_that_are_too_few_alone_suffice_together() -> None:
    case = Case(samples=(8, 7, 8, 7, 8, 7), tilt_deg=40.0)
    found = []
    for seed in range(30):
        truth = surveys(seed, case)
        for k in range(6):
            own = truth.samples.survey == k
            with pytest.raises(NotEnoughData):
                fit_joint(truth.samples.raw[own], truth.samples.total_field[own])
        found.append(errors(truth))
    require_as_stated(found)
    require_at_bound(found, parameters=105)
    fit_surveys(surveys(0, case).samples)  # and what a user's demands on coverage are


def test_offset_for_a_survey_that_was_not_in_the_fit() -> None:
    inside = []
    for seed in range(60):
        truth = surveys(seed, Case(samples=(80,) * 10, tilt_deg=40.0))
        found = fitted(truth).of_another()
        # the next survey's offsets: drawn as those were, about those of the array that the seed draws first
        own = truth.offset.mean(axis=0)
        rng = np.random.default_rng(10_000 + seed)
        base = own + 30.0 / np.sqrt(10) * rng.standard_normal(own.shape)  # the mean of ten is off by as much
        new = base + 30.0 * rng.standard_normal(own.shape)
        std = np.sqrt(np.diag(found.covariance)).reshape(4, 12)[:, 9:]
        inside.append(np.abs(found.offset - new) / std < 1.96)  # 108 degrees of freedom: a Gaussian, next to
    assert np.mean(inside) == pytest.approx(0.95, abs=0.03)


def test_spikes_are_left_out() -> None:
    truth = surveys(2, Case(samples=(300, 300)))
    raw = truth.samples.raw.copy()
    hit = np.arange(5, 600, 60)
    raw[hit, 1, 2] += 1000.0
    fit = fit_surveys(replace(truth.samples, raw=raw))
    assert not fit.keep[hit].any()
    assert fit.keep.sum() >= 588
    np.testing.assert_allclose(calibrated_surveys(fit).common.matrix, true_matrix(truth), atol=3e-5)


def test_refusals() -> None:
    truth = surveys(1, Case(samples=(100, 3)))
    with pytest.raises(NotEnoughData, match="survey 2 of 2 has 3 samples"):
        fit_surveys(truth.samples)
    planar = surveys(1, Case(samples=(60, 60), tilt_deg=0.0))  # turned about the vertical alone, twice
    with pytest.raises(NotEnoughData, match="second quadric"):
        fit_surveys(planar.samples)
    mirrored = surveys(1, Case(samples=(100, 100)))
    raw = mirrored.samples.raw.copy()
    raw[:, 2, 0] *= -1
    with pytest.raises(DataError, match="sensor 3 is inverted"):
        fit_surveys(replace(mirrored.samples, raw=raw))
    raw[7, 0, 0] = np.nan
    with pytest.raises(DataError, match="finite"):
        fit_surveys(replace(mirrored.samples, raw=raw))
