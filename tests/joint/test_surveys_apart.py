"""Surveys that differ: the scatter of their offsets, and one C fitted to surveys that do not share it."""

from __future__ import annotations

import numpy as np
import pytest
from changing_cases import Case, surveys

from magtensor.calibration.surveys.agreeing import disagreement_in_words
from magtensor.calibration.surveys.corrections import scatter_of
from magtensor.calibration.surveys.fit import fit_surveys

NAMES = ["a", "b", "c", "d"]


@pytest.mark.parametrize(("count", "values"), [(2, 12), (3, 12), (4, 12), (8, 12), (3, 3)])
def test_any_sum_of_offsets_of_a_further_survey_is_as_uncertain_as_said(count: int, values: int) -> None:
    rng = np.random.default_rng(count)
    square, draws = [], 2000
    root = rng.standard_normal((count * values, count * values)) * 15.0 / np.sqrt(count * values)
    covariance = root @ root.T  # of the errors of the estimates, 15 nT each
    for _ in range(draws):
        error = (root @ rng.standard_normal(count * values)).reshape(count, values)
        found = 30.0 * rng.standard_normal((count, values)) + error
        gain = rng.standard_normal(values)
        off = gain @ (found.mean(axis=0) - 30.0 * rng.standard_normal(values))
        mean = np.kron(np.full((1, count), 1.0 / count), gain)
        by_error = float((mean @ covariance @ mean.T).item())
        scatter = scatter_of(found, covariance)
        square.append(off**2 / (scatter**2 * (1 + 1 / count) * gain @ gain + by_error))
    assert np.mean(square) == pytest.approx(1.0, abs=0.13)


def test_errors_of_the_estimates_are_no_scatter() -> None:
    rng = np.random.default_rng(0)
    found = [scatter_of(20.0 * rng.standard_normal((4, 12)), 400.0 * np.eye(48)) for _ in range(50)]
    assert np.mean(np.square(found)) < 0.2 * 400.0


def words(seed: int, rate: float, samples: tuple[int, ...]) -> str:
    truth = surveys(seed, Case(samples=samples, rate=rate, tilt_deg=40.0))
    return disagreement_in_words(fit_surveys(truth.samples, worst_error=1.0), truth.samples, NAMES)


@pytest.mark.parametrize("samples", [(100,) * 4, (10,) * 4])
def test_surveys_that_share_c_are_not_said_to_disagree(samples: tuple[int, ...]) -> None:
    assert sum(bool(words(seed, 0.0, samples)) for seed in range(20)) <= 1


def test_surveys_whose_c_ages_disagree_about_it() -> None:
    for seed in range(3):
        told = words(seed, 2e-4, (100,) * 4)
        assert "the surveys disagree about C" in told and "`matrices: linear`" in told
    assert "samples were left out as if disturbed" in words(0, 1e-4, (200, 60, 60, 40))
