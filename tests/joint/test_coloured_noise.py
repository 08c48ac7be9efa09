"""Standard deviations of the joint fit in noise that is not white, drawn in the time domain without the simulator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from joint_cases import FIELD_NT, Array, array, drawn, fitted, truth
from scipy.signal import lfilter

from magtensor.calibration import joint
from magtensor.calibration.blocks import blocks_of, complement, length_of
from magtensor.calibration.joint import JointFit, calibrated, fit_joint
from magtensor.calibration.maximum_likelihood import along
from magtensor.calibration.score_colour import FALSE_ALARM, colour_of_scores, fitted_spectrum

SAMPLES = 6000


def relaxing(rng: np.random.Generator, shape: tuple[int, ...], tau: float) -> Array:
    """Stationary first-order noise of unit variance and a correlation time of tau samples."""
    keep = np.exp(-1.0 / tau)
    drive = rng.standard_normal(shape) * np.sqrt(1.0 - keep**2)
    drive[0] /= np.sqrt(1.0 - keep**2)
    out: Array = lfilter([1.0], [1.0, -keep], drive, axis=0)
    return out


def pink(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """1/f noise: relaxations of equal variance, each four times as slow as the one before, up to a third of
    the survey."""
    return np.sum([relaxing(rng, shape, tau) for tau in 2.0 * 4.0 ** np.arange(6)], axis=0)


def base_station(rng: np.random.Generator, count: int) -> Array:
    """White readings every 20 samples, interpolated."""
    at = np.arange(0, count + 20, 20)
    return np.interp(np.arange(count), at, rng.standard_normal(len(at)))


@dataclass(frozen=True)
class Case:
    """A survey's noise besides the white one.

    Attributes:
        pink: nT, on every output; base: nT, of a base station's readings.
        wander: nT, rms of a total field taken for constant, whose correlation time is a fifth of the survey.
    """

    sensors: int = 4
    pink: float = 0.0
    base: float = 0.0
    wander: float = 0.0


def measured(seed: int, case: Case, count: int = SAMPLES) -> tuple[Array, Array, Array, Array]:
    """C, o, raw outputs and total field of an array that tumbles with a correlation time of 30 samples, with 0.3 nT of
    white noise."""
    rng = np.random.default_rng(seed)
    forward, offset = array(rng, case.sensors)
    unit = relaxing(rng, (count, 3), 30.0)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    raw = np.einsum("sij,nj->nsi", forward, FIELD_NT * unit) + offset
    raw += 0.3 * rng.standard_normal(raw.shape) + case.pink * pink(rng, raw.shape)
    total = np.full(count, FIELD_NT) + case.base * base_station(rng, count)
    return forward, offset, raw, total + case.wander * relaxing(rng, (count,), count / 5)


def standardised(seed: int, case: Case) -> tuple[Array, Array, JointFit]:
    """Errors (S, 12) over the standard deviations given, over those in white noise, and the fit."""
    forward, offset, raw, total = measured(seed, case)
    fit = fit_joint(raw, total, worst_error=1.0)
    found, white = calibrated(fit), calibrated(replace(fit, colour=None))
    true = np.linalg.inv(forward @ joint.nearest_frame(forward))
    error = np.concatenate([(found.matrix - true).reshape(-1, 9), found.offset - offset], axis=1)
    std, without = (np.sqrt(np.diag(c.covariance)).reshape(-1, 12) for c in (found, white))
    return error / std, error / without, fit


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    ("case", "white_is_off"),
    [
        (Case(pink=0.1), 5.0),
        (Case(sensors=1, pink=0.1), 5.0),
        (Case(sensors=2, pink=0.1), 5.0),
        (Case(base=0.5), 3.0),
        (Case(sensors=1, base=0.5), 2.5),
        (Case(wander=3.0), 5.0),
        (Case(pink=0.1, base=0.5, wander=1.0), 4.0),
    ],
)
def test_standard_deviations_hold_in_coloured_noise(case: Case, white_is_off: float) -> None:
    given, white, fits = zip(*(standardised(seed, case) for seed in range(16)), strict=True)
    z, w = np.array(given), np.array(white)
    assert all(fit.colour is not None for fit in fits)
    assert rms(w[..., 9:]) > white_is_off  # what there was to mend
    # 16 surveys with a common error in each: some 50 independent ones, and a spectrum extrapolated below its lowest
    # frequency; a factor of two is what is asked for
    assert 0.6 < rms(z[..., 9:]) < 2.0
    assert 0.6 < rms(z[..., :9]) < 1.6
    assert np.mean(np.abs(z) < 1.96) > 0.85


def test_white_noise_is_called_coloured_no_oftener_than_said() -> None:
    alarms, surveys = 0, 0
    for sensors, tilt, samples in ((1, None, 300), (2, 20.0, 400), (4, None, 64), (4, 20.0, 800)):
        for seed in range(50):
            survey = drawn(5000 + seed, samples, sensors=sensors, tilt_deg=tilt)
            fit = fit_joint(survey.raw, survey.total_field, worst_error=1.0)
            alarms, surveys = alarms + (fit.colour is not None), surveys + 1
    assert alarms <= FALSE_ALARM * surveys + 3.0 * np.sqrt(FALSE_ALARM * surveys)


def test_postures_too_few_for_blocks_are_taken_as_white() -> None:
    survey = drawn(1, 24)
    found = fitted(survey)
    assert "widened_offsets" not in found.diagnostics
    std = np.sqrt(np.diag(found.covariance)).reshape(4, 12)[:, 9:]
    assert (np.abs(found.offset - truth(survey)[1]) < 5.0 * std).all()


def test_the_result_says_by_how_much_it_was_widened() -> None:
    _, _, raw, total = measured(3, Case(pink=0.1))
    fit = fit_joint(raw, total, worst_error=1.0)
    found, white = calibrated(fit), calibrated(replace(fit, colour=None))
    ratio = np.sqrt(np.diag(found.covariance) / np.diag(white.covariance)).reshape(4, 12)
    assert found.diagnostics["widened_offsets"] == pytest.approx(rms(ratio[:, 9:]))
    assert found.diagnostics["widened_matrices"] == pytest.approx(rms(ratio[:, :9]))
    # noise slower than the tumbling meets the offsets, not the elements
    assert rms(ratio[:, 9:]) > 2.0 * rms(ratio[:, :9])


def test_noise_of_one_sensor_widens_that_sensor() -> None:
    _, _, raw, total = measured(4, Case())
    raw[:, 2] += 1.0 * pink(np.random.default_rng(40), (SAMPLES, 3))
    fit = fit_joint(raw, total, worst_error=1.0)
    std = np.sqrt(np.diag(calibrated(fit).covariance)).reshape(4, 12)[:, 9:]
    assert (std[2] > 3.0 * std[[0, 1, 3]].max()).all()


def test_covariance_is_never_less_than_in_white_noise() -> None:
    _, _, raw, total = measured(6, Case(base=0.5))
    fit = fit_joint(raw, total, worst_error=1.0)
    assert fit.colour is not None
    assert min(fit.colour.widened.values()) >= 1.0
    assert np.linalg.eigvalsh(fit.colour.covariance)[0] > 0.0


@pytest.mark.parametrize("sensors", [1, 3])
def test_scores_of_blocks_are_sums_over_their_samples(sensors: int) -> None:
    survey = drawn(2, 640, sensors=sensors)
    fit = fit_joint(survey.raw, survey.total_field)
    plane, scalar = fit.plane, fit.scalar
    found = blocks_of(plane, scalar, survey.raw, survey.total_field, 0.0).at(plane, scalar)
    y = plane.coordinates(survey.raw)
    seen = along(scalar.matrix, scalar.offset, y.T, survey.total_field, 0.0)
    z = np.column_stack([np.ones(640), scalar.field(y)])
    left = plane.residual(survey.raw) @ complement(plane)
    for number, (a, b) in enumerate(pairwise(np.arange(0, 641, 5))):
        np.testing.assert_allclose(found.across[number], left[a:b].T @ z[a:b], atol=1e-6 * FIELD_NT)
        # half the derivative with a shift of the field, but for what the noise's own size depends on it
        shift = (seen.residual * seen.inverse_std * seen.unit)[:, a:b].sum(axis=1)
        np.testing.assert_allclose(found.along[number, 6:], shift, atol=1e-3 * np.abs(seen.inverse_std).max() * 5)


@pytest.mark.parametrize("sensors", [1, 4])
def test_one_reading_finds_the_colour_that_all_together_show(sensors: int, monkeypatch: pytest.MonkeyPatch) -> None:
    _, _, raw, total = measured(8, Case(sensors=sensors, pink=0.1), 16_384)
    noise = np.full((sensors, 3), 0.3)
    whole = fit_joint(raw, total, worst_error=1.0, noise=noise, robust=False)
    monkeypatch.setattr(joint, "AT_ONCE", 5_000)
    monkeypatch.setattr(joint, "SELECTION", 4_096)
    read = fit_joint(raw, total, worst_error=1.0, noise=noise, robust=False)
    a, b = (np.sqrt(np.diag(calibrated(fit).covariance)) for fit in (read, whole))
    np.testing.assert_allclose(a, b, rtol=5e-3)  # of the same 128 blocks


@pytest.mark.parametrize("count", [65_537, 10**6, 10**7, 3 * 10**8])
def test_blocks_of_a_recording_are_bounded_and_whole_in_its_pieces(count: int) -> None:
    length = length_of(count)
    assert 96 <= count / length <= 192
    assert length & (length - 1) == 0


@pytest.mark.parametrize(("law", "mean"), [(0.0, 1.0), (1.0, 0.570), (2.0, 0.756)])
def test_spectra_are_taken_to_frequency_zero(law: float, mean: float) -> None:
    """Variance of the mean over T: the integral of sinc^2(j / 2) S(j) from j = 1/2 (from 0 for white noise)."""
    j = np.arange(1, 128.0)
    fine = np.linspace(0.5 if law else 1e-6, 400.0, 2_000_000)
    integral = float(np.sum(np.sinc(fine / 2) ** 2 * fine**-law) * (fine[1] - fine[0]))
    assert integral == pytest.approx(mean, rel=0.002)
    found, at_zero = fitted_spectrum(1e3 * j**-law, 1e4)
    np.testing.assert_allclose(found, 1e3 * j**-law, rtol=0.05)
    assert at_zero == pytest.approx(1e3 * mean, rel=0.1)


def test_without_scatter_there_is_no_colour() -> None:
    survey = drawn(3, 640)
    fit = fit_joint(survey.raw, survey.total_field)
    found = blocks_of(fit.plane, fit.scalar, survey.raw, survey.total_field, 0.0).at(fit.plane, fit.scalar)
    assert colour_of_scores(found, 0.0, 0.0) is None
