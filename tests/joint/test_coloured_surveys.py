"""Standard deviations in noise that is not white, of several surveys, an unmeasured total field and an attitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from joint_cases import FIELD_NT, Array, array
from several_cases import turned
from test_coloured_noise import base_station, relaxing, rms

from magtensor.calibration.joint import calibrated, fit_joint, nearest_frame
from magtensor.calibration.surveys.changing import fit_changing
from magtensor.calibration.surveys.corrections import calibrated_surveys
from magtensor.calibration.surveys.covariance import as_white, covariance_of, to_corrections
from magtensor.calibration.surveys.fit import SurveysFit, fit_surveys
from magtensor.calibration.surveys.samples import Samples, joined

SAMPLES = 2500


@dataclass(frozen=True)
class Case:
    """Surveys of `SAMPLES` samples of four sensors that tumble, with 0.3 nT of white noise.

    Attributes:
        pink: nT, on every output; base: nT, of a base station's readings; wander: nT, rms of a total field taken for
            constant, with a correlation time of a fifth of a survey.
        levels: unknown constants of the total field in each survey; 0 where it is known.
        attitude_deg: standard deviation of the attitude; None without one.
    """

    surveys: int = 1
    pink: float = 0.0
    base: float = 0.0
    wander: float = 0.0
    levels: int = 0
    attitude_deg: float | None = None


def pink(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """1/f noise down to a fifth of a survey."""
    return np.sum([relaxing(rng, shape, tau) for tau in 2.0 * 4.0 ** np.arange(5)], axis=0)


def measured(seed: int, case: Case) -> tuple[Array, Array, Samples]:
    """C (S, 3, 3), o (K, S, 3) nT and the samples."""
    rng = np.random.default_rng(seed)
    forward, first = array(rng, 4)
    offset = first + 30.0 * rng.standard_normal((case.surveys, *first.shape))
    parts = []
    for o in offset:
        unit = relaxing(rng, (SAMPLES, 3), 30.0)
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        level = None if not case.levels else np.arange(SAMPLES) * case.levels // SAMPLES
        size = (
            np.full(SAMPLES, FIELD_NT)
            if level is None
            else (FIELD_NT + 200.0 * rng.standard_normal(case.levels))[level]
        )
        raw = np.einsum("sij,nj->nsi", forward, size[:, None] * unit) + o
        raw += 0.3 * rng.standard_normal(raw.shape) + case.pink * pink(rng, raw.shape)
        total = size + case.base * base_station(rng, SAMPLES) + case.wander * relaxing(rng, (SAMPLES,), SAMPLES / 5)
        known = None if case.attitude_deg is None else turned(rng, unit, np.radians(case.attitude_deg))
        none = np.zeros(SAMPLES, dtype=int)
        parts.append(Samples(raw, total if level is None else np.full(SAMPLES, 48_000.0), none, none, level, known))
    return forward, offset, joined(parts)


def standardised(seed: int, case: Case) -> tuple[Array, Array, SurveysFit]:
    """Errors over the standard deviations given and over those in white noise, matrices (36,), offsets (12 K,)."""
    forward, offset, samples = measured(seed, case)
    fit = fit_surveys(samples, worst_error=1.0)
    found = calibrated_surveys(fit)
    found = found.nominal() if case.levels else found
    matrix = np.linalg.inv(forward if case.attitude_deg is not None else forward @ nearest_frame(forward))
    if case.levels:
        matrix = matrix * np.exp(-np.mean(np.linalg.slogdet(matrix)[1]) / 3)
    error = np.concatenate([(found.common.matrix - matrix).ravel(), (found.offset - offset).ravel()])
    chain = np.eye(len(error))
    chain[:36, :36] = to_corrections(matrix)
    white = chain @ covariance_of(fit.design, as_white(fit.said), fit.chi2_along) @ chain.T
    return error / np.sqrt(np.diag(found.covariance)), error / np.sqrt(np.diag(white)), fit


@pytest.mark.parametrize(
    ("case", "white_is_off"),
    [
        (Case(surveys=3, pink=0.1), 4.0),
        (Case(surveys=2, base=0.5), 2.0),
        (Case(levels=1, pink=0.1), 4.0),
        (Case(surveys=2, levels=4, pink=0.1), 4.0),
        (Case(attitude_deg=0.2, pink=0.1), 4.0),
    ],
    ids=str,
)
def test_standard_deviations_hold_in_coloured_noise(case: Case, white_is_off: float) -> None:
    given, white, fits = zip(*(standardised(seed, case) for seed in range(8)), strict=True)
    z, w = np.array(given), np.array(white)
    assert all(one.coloured is not None for fit in fits for one in fit.said)
    assert rms(w[:, 36:]) > white_is_off  # what there was to mend
    # some tens of independent errors, and a spectrum taken to below its lowest frequency
    assert 0.6 < rms(z[:, 36:]) < 2.0
    assert 0.6 < rms(z[:, :36]) < 1.6
    assert np.mean(np.abs(z) < 1.96) > 0.85


def test_one_survey_is_widened_as_the_plain_fit_is() -> None:
    _, _, samples = measured(3, Case(pink=0.1, base=0.5))
    found = calibrated_surveys(fit_surveys(samples, worst_error=1.0)).common
    plain = calibrated(fit_joint(samples.raw, samples.total_field, worst_error=1.0))
    std, expected = (np.sqrt(np.diag(c.covariance)) for c in (found, plain))
    np.testing.assert_allclose(std, expected, rtol=1e-6)
    for name in ("widened_offsets", "widened_matrices"):
        assert found.diagnostics[name] == pytest.approx(plain.diagnostics[name], rel=1e-6)


def test_the_noise_of_one_survey_widens_what_it_says() -> None:
    quiet, loud = measured(4, Case(surveys=2)), measured(4, Case(surveys=2, pink=0.3))
    raw = quiet[2].raw.copy()
    second = quiet[2].survey == 1
    raw[second] += (loud[2].raw - quiet[2].raw)[second] - (loud[1] - quiet[1])[1]
    samples = Samples(raw, quiet[2].total_field, quiet[2].run, quiet[2].survey)
    fit = fit_surveys(samples, worst_error=1.0)
    assert fit.said[0].coloured is None and fit.said[1].coloured is not None
    std = np.sqrt(np.diag(calibrated_surveys(fit).covariance))[36:].reshape(2, 12)
    assert rms(std[1]) > 5.0 * rms(std[0])


def test_a_c_of_its_own_is_no_noise() -> None:
    forward, _, samples = measured(5, Case(surveys=2))
    b = np.einsum("sij,nsj->nsi", np.linalg.inv(forward), samples.raw)
    raw = samples.raw + (samples.survey == 1)[:, None, None] * 2e-5 * b  # a scale of 1 nT
    fit = fit_surveys(Samples(raw, samples.total_field, samples.run, samples.survey), robust=False, worst_error=1.0)
    assert all(one.coloured is None for one in fit.said)


def test_white_noise_is_called_coloured_no_oftener_than_said() -> None:
    alarms = 0
    for seed in range(40):
        rng = np.random.default_rng(900 + seed)
        forward, offset = array(rng, 3)
        unit = rng.standard_normal((3, 200, 3))
        unit /= np.linalg.norm(unit, axis=2, keepdims=True)
        raw = np.einsum("sij,knj->knsi", forward, FIELD_NT * unit) + offset
        raw += rng.standard_normal(raw.shape)
        none = np.zeros(200, dtype=int)
        fit = fit_surveys(joined([Samples(r, np.full(200, FIELD_NT), none, none) for r in raw]))
        alarms += any(one.coloured is not None for one in fit.said)
    assert alarms <= 3  # 0.4 are expected


def test_the_rate_of_a_change_is_widened() -> None:
    z, widened = [], []
    for seed in range(6):
        forward, _, samples = measured(seed, Case(surveys=3, pink=0.1))
        fit = fit_changing(samples, np.array([0.0, 1.0, 2.0]), offsets="own", worst_error=1.0)
        covariance = covariance_of(fit.design, fit.said, fit.alike.chi2_along)
        white = covariance_of(fit.design, as_white(fit.said), fit.alike.chi2_along)
        rate = slice(36, 72)  # none is there
        z.append(fit.parameters[rate] / np.sqrt(np.diag(covariance)[rate]))
        widened.append(np.sqrt(np.diag(covariance)[rate] / np.diag(white)[rate]))
    assert forward.shape == (4, 3, 3)
    assert rms(np.array(widened)) > 1.5
    assert 0.6 < rms(np.array(z)) < 1.6
