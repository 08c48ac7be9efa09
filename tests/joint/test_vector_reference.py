"""Attitude and known field together with the total field: weights, standard errors, and the rotation they tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from several_cases import Case, Truth, errors, fitted, require_as_stated, require_at_bound, surveys

from magtensor.calibration.surveys import sums
from magtensor.calibration.surveys.corrections import calibrated_surveys
from magtensor.calibration.surveys.directions import sighting
from magtensor.calibration.surveys.fit import fit_surveys
from magtensor.errors import DataError, NotEnoughData
from magtensor.frame.calibration_errors import errors_of


@pytest.mark.parametrize(
    "case",
    [
        Case(attitude_deg=0.5, tilt_deg=20.0),
        Case(attitude_deg=0.02),
        Case(attitude_deg=0.3, tilt_deg=30.0, sensors=1),
        Case(samples=(150, 150), attitude_deg=0.3, tilt_deg=30.0),
        Case(samples=(300,), attitude_deg=0.002, tilt_deg=30.0, noise_nT=5.0),
    ],
    ids=str,
)
def test_errors_are_those_that_noise_allows(case: Case) -> None:
    found = [errors(surveys(seed, case)) for seed in range(40)]
    require_as_stated(found)
    require_at_bound(found, parameters=12)
    assert np.mean([f.square for f in found]) == pytest.approx(1.0, abs=0.2)


def test_gradient_of_the_cost() -> None:
    rng = np.random.default_rng(1)
    unit = rng.standard_normal((40, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    matrix = np.array([[1.1, 0.2, -0.1], [0.0, 0.9, 0.3], [0.1, 0.0, 1.3]])
    centre = np.repeat([0, 1], 20)
    centres = np.array([[0.4, -0.5, 0.6], [0.1, 0.2, -0.3]])
    y = 20.0 * unit @ np.linalg.inv(matrix).T + centres[centre] + 0.3 * rng.standard_normal((40, 3))
    field = np.full(40, 20.0)
    data = sums.InPlane(y, centre, field)
    known = unit + 0.02 * rng.standard_normal(unit.shape)
    known /= np.linalg.norm(known, axis=1, keepdims=True)
    data = replace(data, sighting=sighting(matrix, data.fields(matrix, centres), known, 0.02, 0.0))

    def cost(step: np.ndarray) -> float:
        moved = (np.eye(3) + step[:9].reshape(3, 3)) @ matrix
        shifted = centres - np.linalg.solve(moved, step[9:].reshape(2, 3).T).T
        return sums.summed(data, moved, shifted).cost

    numeric = [(cost(1e-5 * e) - cost(-1e-5 * e)) / 4e-5 for e in np.eye(15)]
    found = sums.summed(data, matrix, centres)
    np.testing.assert_allclose(found.gradient, numeric, atol=1e-6 * np.abs(numeric).max())


def test_the_attitude_s_error_is_found() -> None:
    for deg in (0.05, 1.0):
        found = fit_surveys(surveys(4, Case(samples=(2000,), attitude_deg=deg, tilt_deg=30.0)).samples)
        assert found.attitude_std is not None
        # of 4000 angles
        assert np.degrees(found.attitude_std) == pytest.approx(deg, rel=4 / np.sqrt(2 * 4000))


def turn_error(truth: Truth) -> float:
    """rad about the worst axis, of the frame."""
    product = fitted(truth).common.matrix[0] @ truth.forward[0]
    u, _, vt = np.linalg.svd(product)
    turn = u @ vt
    return float(np.abs([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]).max()) / 2


def test_the_common_rotation_is_determined() -> None:
    case = Case(samples=(600,), attitude_deg=0.5)
    angles = [turn_error(surveys(seed, case)) for seed in range(20)]
    # N directions, each telling two of three angles: about an axis 0.5 deg / sqrt(2 N / 3)
    one = np.radians(0.5) / np.sqrt(2 * 600 / 3)
    assert np.sqrt(np.mean(np.square(angles))) < 2.5 * one
    assert calibrated_surveys(fit_surveys(surveys(0, case).samples)).common.frame.startswith("platform")


def test_a_poor_total_field_does_not_outweigh_the_attitude() -> None:
    """The size of a world field in place of a measurement: 100 nT off from sample to sample, and nobody says so."""
    worst, squares = [], []
    for seed in range(30):
        truth = surveys(seed, Case(samples=(500,), attitude_deg=0.02, tilt_deg=15.0))
        rough = truth.samples.total_field + 100.0 * np.random.default_rng(seed).standard_normal(500)
        found = calibrated_surveys(fit_surveys(replace(truth.samples, total_field=rough), worst_error=1.0)).common
        error = (found.matrix - np.linalg.inv(truth.forward)).ravel()
        std = np.sqrt(np.diag(found.covariance).reshape(4, 12)[:, :9].ravel())
        squares.append(np.mean((error / std) ** 2))
        worst.append(np.abs(error).max())
    assert np.mean(squares) == pytest.approx(1.0, abs=0.3)
    # weighed as 1 nT, 100 nT of scatter in a cone of 15 deg would put some 100 / 500^1/2 / 15 deg^2 into the matrix
    assert np.median(worst) < 5e-4


def test_unknown_total_field_beside_an_attitude() -> None:
    found = []
    for seed in range(12):
        truth = surveys(seed, Case(samples=(200, 200), levels=2, attitude_deg=0.3, tilt_deg=40.0))
        found.append(errors(truth).standardised)
    assert np.mean(np.square(found)) == pytest.approx(1.0, abs=0.4)


def test_an_attitude_that_drifts_is_believed_less() -> None:
    """Errors alike over a hundred samples: the rotation is a hundred times less certain in variance, and said to be."""
    ratios, widened = [], []
    for seed in range(30):
        truth = surveys(seed, Case(samples=(6000,), attitude_deg=0.05))
        assert truth.samples.direction is not None
        slow = np.radians(0.3) * np.repeat(np.random.default_rng(seed).standard_normal((60, 3)), 100, axis=0)
        known = truth.samples.direction + np.cross(slow, truth.samples.direction)
        known /= np.linalg.norm(known, axis=1, keepdims=True)
        fit = fit_surveys(replace(truth.samples, direction=known))
        found = calibrated_surveys(fit).common
        errors_ = errors_of(found).common @ errors_of(found).common.T  # (3, 3) of the common rotation
        turn = np.mean(found.matrix @ truth.forward, axis=0)
        vector = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        ratios.append(vector @ np.linalg.solve(errors_, vector) / 3)
        widened.append(fit.attitude_excess)
    assert np.median(widened) > 30.0
    # of 90 squares, the widening itself known from 20 parts
    assert 0.5 < np.mean(ratios) < 1.8


def test_a_poor_attitude_does_not_attenuate_the_matrix() -> None:
    """With 2 deg of error in a cone of 20 deg a regression on the attitude's field shrinks C by some 2 %."""
    found = []
    for seed in range(10):
        truth = surveys(seed, Case(samples=(3000,), attitude_deg=2.0, tilt_deg=20.0))
        product = fitted(truth).common.matrix @ truth.forward
        found.append(np.linalg.svd(product)[1] - 1.0)
    assert np.abs(np.mean(found, axis=0)).max() < 2e-5


@pytest.mark.parametrize("postures", [9, 12])
def test_as_few_postures_as_determine_a_matrix_and_an_offset(postures: int) -> None:
    """A known direction tells three values of each posture, so that fewer do than nine."""
    found = [errors(surveys(seed, Case(samples=(postures,), attitude_deg=0.05, apart_nT=0.0))) for seed in range(60)]
    require_as_stated(found)


def test_few_poor_attitudes_are_cautioned_against() -> None:
    """Of 12 postures at 1 deg a tester's errors were 2.4 times the stated ones, of 12 at 0.1 deg as stated."""
    words = {
        (postures, std): fitted(surveys(7, Case(samples=(postures,), attitude_deg=std, apart_nT=0.0)))
        for postures, std in ((12, 1.0), (12, 0.1), (400, 1.0))
    }
    cautioned = {case: "caution" in found.common.diagnostics for case, found in words.items()}
    assert cautioned == {(12, 1.0): True, (12, 0.1): False, (400, 1.0): False}


def test_refusals() -> None:
    few = surveys(4, Case(samples=(8,), attitude_deg=0.05, apart_nT=0.0))
    with pytest.raises(NotEnoughData, match="5 attitudes and 9 samples are the least"):
        fit_surveys(few.samples, common_offsets=True)
    one = surveys(4, Case(samples=(11,), attitude_deg=0.05, apart_nT=0.0, sensors=1))
    with pytest.raises(NotEnoughData, match="12 samples are the least"):
        fit_surveys(one.samples, common_offsets=True)
    truth = surveys(3, Case(samples=(200,), attitude_deg=0.1))
    assert truth.samples.direction is not None
    with pytest.raises(DataError, match="mirror"):
        fit_surveys(replace(truth.samples, raw=-truth.samples.raw, direction=truth.samples.direction))
    level = surveys(5, Case(samples=(200,), attitude_deg=0.1)).samples
    assert level.direction is not None
    yaw = np.column_stack([level.direction[:, :2], np.full(200, 0.8)])
    yaw[:, :2] *= 0.6 / np.linalg.norm(yaw[:, :2], axis=1, keepdims=True)
    varying = level.total_field * (1 + 4e-4 * np.sin(np.arange(200)))
    raw = np.repeat((yaw * varying[:, None])[:, None], 4, axis=1) + np.random.default_rng(6).standard_normal(
        (200, 4, 3)
    )
    with pytest.raises(NotEnoughData, match="did not leave a plane"):  # but for the field's own variation
        fit_surveys(replace(level, raw=raw, total_field=varying, direction=yaw))
    flat = np.tile([[1.0, 0, 0]], (200, 1))
    with pytest.raises(NotEnoughData, match="did not leave a plane"):
        fit_surveys(replace(truth.samples, direction=flat))
