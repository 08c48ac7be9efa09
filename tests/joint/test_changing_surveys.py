"""Several surveys whose C changes linearly with the date: errors, what they are said to be, and another date."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from changing_cases import Case, at_another_date, errors, fitted, surveys
from several_cases import require_as_stated, require_at_bound

from magtensor.calibration.surveys.changing import fit_changing
from magtensor.calibration.surveys.dated import Dated, dated, survey_covariance
from magtensor.calibration.surveys.said import OneSurvey, said, view
from magtensor.calibration.surveys.straight import in_words, straight
from magtensor.errors import DataError

SENSORS = ["S1", "S2", "S3", "S4"]


@pytest.mark.parametrize(
    "case",
    [
        Case(samples=(60, 40, 40, 60), tilt_deg=40.0),
        pytest.param(Case(samples=(80, 80, 80), years=(0.0, 1.0, 2.5), sensors=1), marks=pytest.mark.long),
        pytest.param(Case(samples=(80, 60), years=(0.0, 1.0), sensors=2, offsets="common"), marks=pytest.mark.long),
        Case(samples=(60, 40, 60), years=(0.0, 1.0, 2.0), offsets="linear", attitude_deg=0.3),
    ],
    ids=str,
)
def test_errors_are_those_that_noise_allows(case: Case) -> None:
    found = [errors(surveys(seed, case)) for seed in range(14)]
    require_as_stated(found)
    require_at_bound(found, parameters=12)


@pytest.mark.parametrize(
    "case",
    [
        Case(samples=(60,) * 4, offsets="linear"),
        Case(samples=(60,) * 6, years=(0.0, 0.3, 0.8, 1.4, 1.9, 2.4), scatter=1e-4, offsets="common"),
    ],
    ids=["on the line", "about the line"],
)
def test_the_covariance_of_another_date_is_that_of_its_errors(case: Case) -> None:
    found = [at_another_date(surveys(seed, case), 4.0, seed) for seed in range(12)]
    for of_values_or_rates in zip(*found, strict=True):
        assert np.mean(np.square(of_values_or_rates)) == pytest.approx(1.0, abs=0.35)


def same(a: Dated, b: Dated) -> None:
    """To rounding, and to what a covariance says of terms of second order in the change."""
    np.testing.assert_allclose(a.calibration.matrix, b.calibration.matrix, atol=1e-12)
    np.testing.assert_allclose(a.calibration.offset, b.calibration.offset, atol=1e-7)
    np.testing.assert_allclose(a.change.rate, b.change.rate, atol=1e-15)
    for one, other in (
        (a.calibration.covariance, b.calibration.covariance),
        (a.change.covariance, b.change.covariance),
    ):
        std = np.sqrt(np.diag(other))
        np.testing.assert_allclose(one / std[:, None] / std, other / std[:, None] / std, atol=1e-6)


def test_a_date_is_reached_by_any_way() -> None:
    fit = fitted(surveys(1, Case(samples=(60, 60, 60), years=(0.0, 1.0, 3.0), offsets="linear")))
    line = straight(fit)
    first = dated(fit, line, 0)
    same(first.after(3.0), dated(fit, line, 2))
    same(first.after(5.0).after(-4.0), dated(fit, line, 1))


def test_covariance_of_all_surveys_holds_that_of_this_one() -> None:
    fit = fitted(surveys(1, Case(samples=(60, 60, 60), years=(0.0, 1.0, 3.0), scatter=1e-4)))
    line = straight(fit)
    whole, own = survey_covariance(fit, line, 1), dated(fit, line, 1).calibration.covariance
    places = np.arange(48).reshape(4, 12)
    picked = np.concatenate([np.arange(36), 36 + 12 + np.arange(12)])
    wanted = own[np.ix_(*[np.concatenate([places[:, :9].ravel(), places[:, 9:].ravel()])] * 2)]
    std = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(
        whole[np.ix_(picked, picked)] / std[:, None] / std, wanted / std[:, None] / std, atol=1e-8
    )


def test_whether_the_surveys_want_the_change() -> None:
    change, about = [], []
    for seed in range(14):
        line = straight(fitted(surveys(seed, Case(samples=(60, 40, 50), years=(0.0, 1.0, 2.0), rate=0.0))))
        assert line.about is not None
        change.append(line.change[0])
        about.append(line.about[0] / line.about[1])
    freedom = 36 - 3  # a rotation that all share has no rate
    assert np.mean(change) == pytest.approx(freedom, abs=4.0 * np.sqrt(2.0 * freedom / len(change)))
    assert np.mean(about) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / freedom / len(about)))
    truth = surveys(3, Case(samples=(60, 40, 50), years=(0.0, 1.0, 2.0), rate=0.0))
    fit = fitted(truth)
    found = straight(fit)
    change_ = dated(fit, found, 0).change
    words = in_words(found, change_.rate, change_.offset_rate, SENSORS)
    assert "noise explains it, and `matrices: common`" in words and "The line explains C" in words
    bent = surveys(3, Case(samples=(60, 40, 50), years=(0.0, 1.0, 2.0), scatter=2e-4))
    fit = fitted(bent)
    found = straight(fit)
    assert found.scatter == pytest.approx(2e-4, rel=0.4)  # 33 values
    assert "The line does not explain all" in in_words(found, change_.rate, change_.offset_rate, SENSORS)
    two = fitted(surveys(3, Case(samples=(80, 80), years=(0.0, 1.0))))
    assert "Two surveys lie on any line" in in_words(straight(two), change_.rate, change_.offset_rate, SENSORS)


def test_no_sensor_gains_by_a_rotation_that_all_share() -> None:
    truth = surveys(5, Case(samples=(80, 80, 80), years=(0.0, 1.0, 2.0), offsets="common"))
    line = fitted(truth).parameters[: 2 * 36].reshape(2, 4, 3, 3)
    for c in line:
        np.testing.assert_allclose(c.sum(axis=0), c.sum(axis=0).T, atol=1e-12)


@pytest.mark.parametrize("sensors", [1, 3])
def test_the_score_is_the_slope_of_the_cost(sensors: int) -> None:
    truth = surveys(2, Case(samples=(60,), years=(0.0,), sensors=sensors))
    one = OneSurvey(truth.samples.raw, truth.samples.total_field, reference_noise=0.5)
    noise = np.full(3 * sensors, 1.0)
    # off the minimum, where residuals of both parts are far above the noise
    start = np.concatenate([truth.of_survey[0] * 1.0005, truth.offset[0][:, :, None] + 3.0], axis=2)

    def cost(where: np.ndarray) -> float:
        return said(view(one, where[:, :, :3], where[:, :, 3], noise)).cost

    score = said(view(one, start[:, :, :3], start[:, :, 3], noise)).score.reshape(start.shape)
    for step in np.random.default_rng(0).standard_normal((5, *start.shape)) * np.array([1e-6, 1e-6, 1e-6, 1e-2]):
        slope = (cost(start + step) - cost(start - step)) / 2
        assert -2.0 * np.sum(score * step) == pytest.approx(slope, rel=1e-4)


def test_spikes_are_left_out_and_a_change_is_not() -> None:
    truth = surveys(2, Case(samples=(120, 120, 120), years=(0.0, 1.0, 2.0), rate=1e-3))
    raw = truth.samples.raw.copy()
    hit = np.arange(5, 360, 40)
    raw[hit, 1, 2] += 1000.0
    fit = fit_changing(replace(truth.samples, raw=raw), np.array([0.0, 1.0, 2.0]))
    assert not fit.alike.keep[hit].any() and fit.alike.keep.sum() >= 348
    np.testing.assert_allclose(fit.parameters[:72], truth.parameters[:72], atol=1e-4)


def test_refusals() -> None:
    truth = surveys(1, Case(samples=(60, 60), years=(0.0, 1.0)))
    with pytest.raises(DataError, match="one date"):
        fit_changing(truth.samples, np.array([2.0, 2.0]))
    with pytest.raises(DataError, match="unknown in each survey"):
        fit_changing(replace(truth.samples, level=truth.samples.survey), np.array([0.0, 1.0]))
