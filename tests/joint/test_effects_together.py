"""Error models in a fit of several surveys, of an unknown total field, and with known directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effects_cases import (
    Model,
    calibrated,
    fitted,
    joint_covariance,
    parameters,
    records,
    square,
    true_parameters,
    warmed,
    with_slow_noise,
)
from joint_cases import Array
from several_cases import Case

from magtensor.calibration.surveys.corrections import calibrated_surveys
from magtensor.calibration.surveys.fit import fit_surveys
from magtensor.components import component_of
from magtensor.effect_errors import WithCoefficients, with_coefficients
from magtensor.errors import DataError
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.several import Together, surveys_state
from magtensor_effects.temperature import temperature_offset, temperature_scale

FITS = 12


@pytest.mark.parametrize(
    ("case", "model"),
    [
        (Case(samples=(300, 200), tilt_deg=40.0), temperature_offset),
        (Case(samples=(12,) * 5, tilt_deg=60.0), temperature_offset),
        pytest.param(Case(samples=(300, 200), tilt_deg=40.0, apart_nT=0.0), temperature_scale, marks=pytest.mark.long),
        pytest.param(Case(samples=(400,), tilt_deg=40.0, attitude_deg=0.3), temperature_offset, marks=pytest.mark.long),
        pytest.param(
            Case(samples=(200, 200), tilt_deg=40.0, attitude_deg=0.05), temperature_scale, marks=pytest.mark.long
        ),
        pytest.param(Case(samples=(300, 200), tilt_deg=60.0, levels=3), temperature_scale, marks=pytest.mark.long),
        (Case(samples=(300, 300), tilt_deg=60.0, sensors=1), temperature_offset),
    ],
    ids=lambda value: str(value) if isinstance(value, Case) else value.__name__,
)
def test_joint_covariance_is_that_of_the_errors(case: Case, model: Model) -> None:
    squares, of_theta = [], []
    for seed in range(FITS):
        of = warmed(seed, case, model)
        found = calibrated(of, fitted(of))
        error = parameters(found) - true_parameters(of)
        value, rank = square(error, joint_covariance(found))
        assert found.open == 0
        assert rank == len(error) - (0 if case.attitude_deg else 3) - bool(case.levels)
        squares.append(value / rank)
        of_theta.append(square(error[-len(found.values) :], found.theta)[0] / len(found.values))
    # chi-squares; the noise is found from the data, to some per cent
    assert np.mean(squares) == pytest.approx(1.0, abs=0.1 + 3.5 * np.sqrt(2.0 / (FITS * rank)))
    assert np.mean(of_theta) == pytest.approx(1.0, abs=0.1 + 3.5 * np.sqrt(2.0 / (FITS * 3 * case.sensors)))


def one_after_the_other(found: WithCoefficients) -> Array:
    """C and o of each sensor, then the coefficients."""
    own = found.calibration
    return np.concatenate([np.column_stack([own.matrix.reshape(-1, 9), own.offset]).ravel(), found.values])


def test_one_survey_cut_in_two_is_that_survey() -> None:
    """The one-survey fit, the fit of several that has one, and that of both halves with everything in common."""
    of = warmed(5, Case(samples=(600,), tilt_deg=40.0, apart_nT=0.0), temperature_offset)
    half = np.arange(600) >= 300
    cut = replace(of, samples=replace(of.samples, survey=half.astype(int)))
    component = component_of(temperature_offset)
    assert component is not None
    plain = with_coefficients(joint_state(records(of)[0], [Adopted(component, {})], Fitting(searching=False)))
    whole, halves = (calibrated(one, fitted(one)) for one in (of, cut))
    std = np.sqrt(np.diag(plain.covariance))
    for found in (whole, halves):
        own = found.beside(found.calibration.of_survey(0), mean=False)
        assert np.abs((one_after_the_other(own) - one_after_the_other(plain)) / std).max() < 0.05
        # what was fitted, 5 of 600 values in a direction, is counted off the noise's freedom there
        np.testing.assert_allclose(np.sqrt(np.diag(own.covariance)), std, rtol=0.03)
    scale = np.sqrt(np.diag(joint_covariance(whole)))
    assert (np.abs(parameters(halves) - parameters(whole)) / scale).max() < 0.02


@pytest.mark.parametrize(
    "case",
    [
        Case(samples=(200, 200), tilt_deg=40.0),
        Case(samples=(300,), tilt_deg=40.0, attitude_deg=0.2),
        Case(samples=(200, 200), tilt_deg=60.0, levels=2),
    ],
    ids=str,
)
def test_slope_of_c_and_offsets_is_that_of_refits(case: Case) -> None:
    """Some of one coefficient more, taken off the outputs by hand."""
    of = warmed(4, case, temperature_scale)
    state = fitted(of)
    found = calibrated(of, state)
    slope = found.mixed @ np.linalg.inv(found.theta)
    options = {"worst_error": 1.0, "robust": False, "noise": state.fit.plane.noise.reshape(-1, 3)}
    options |= {"attitude": state.fit.attitude_std, "reference_noise": state.fit.data.reference_noise}
    kept = state.samples.at(state.fit.keep)

    def refitted(theta: np.ndarray) -> np.ndarray:
        taken = state.terms.contribution(theta, 12).reshape(-1, 4, 3)
        again = calibrated_surveys(fit_surveys(replace(kept, raw=kept.raw - taken), **options))
        again = again.nominal() if case.levels else again
        return np.concatenate([again.common.matrix.ravel(), again.offset.ravel()])

    scale = np.repeat([1.0, 50_000.0], [36, len(slope) - 36])
    for k in (0, 4, 11):
        step = 10.0 * np.eye(12)[k]
        numeric = (refitted(step) - refitted(-step)) / 20.0
        wrong = np.abs(slope[:, k] - numeric) / scale
        # the slope is that of a fit without noise
        assert wrong.max() < 0.02 * np.abs(numeric / scale).max()


def test_a_strong_effect_beside_unknown_constants() -> None:
    """Forty times the noise at first: a scale of the field, which is free, must not pass for what the effect leaves."""
    of = warmed(1, Case(samples=(2000, 2000), tilt_deg=40.0, levels=20), temperature_offset)
    more = 20.0 * of.theta * of.degrees[:, None, None]
    of = replace(of, theta=21.0 * of.theta, samples=replace(of.samples, raw=of.samples.raw + more))
    found = calibrated(of, fitted(of))
    value, rank = square(parameters(found) - true_parameters(of), joint_covariance(found))
    assert value / rank == pytest.approx(1.0, abs=0.1 + 4 * np.sqrt(2.0 / rank))


def test_slow_noise_is_in_the_coefficients_errors() -> None:
    """A temperature as slow as the noise takes some of it away, which the rest of the spectrum must replace."""
    squares, against_white = [], []
    case = Case(samples=(1000, 700), tilt_deg=40.0)
    quiet = warmed(0, case, temperature_offset)
    white = np.diag(calibrated(quiet, fitted(quiet)).theta)
    for seed in range(8):
        of = warmed(seed, case, temperature_offset)
        found = calibrated(of, fitted(with_slow_noise(of, seed, 0.5)))
        error = found.values - of.theta.ravel()
        squares.append(np.mean(error**2 / np.diag(found.theta)))
        against_white.append(np.mean(error**2 / white))
    # twelve coefficients a fit, the noise of an axis its own
    assert np.mean(squares) == pytest.approx(1.0, abs=0.2 + 3.5 * np.sqrt(2.0 / (8 * 12)))
    assert np.mean(against_white) > 4.0


def test_coefficients_that_no_data_show_stay_zero() -> None:
    """A temperature that is constant in each survey is an offset of that survey."""
    of = warmed(2, Case(samples=(200, 200)), temperature_offset)
    of = replace(of, degrees=3.0 * of.samples.survey, samples=of.truth.samples)
    found = calibrated(of, fitted(of))
    assert found.open == 12 and np.abs(found.values).max() < 1e-6
    assert any("12 of 12 directions" in words for words in found.calibration.common.unobservable)


def test_coefficients_must_be_the_same_on_all_surveys() -> None:
    of = warmed(2, Case(samples=(60, 60)), temperature_offset)
    first, second = records(of)
    second = replace(second, units={"temperature": "K"})
    component = component_of(temperature_offset)
    assert component is not None
    adopted = [Adopted(component, {})]
    with pytest.raises(DataError, match="nT/degC on one survey and x nT/K"):
        surveys_state(Together(of.samples, [first, second], [adopted, adopted], {"worst_error": 1.0}))
