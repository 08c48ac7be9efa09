"""The joint fit with sensors near nominal: derivatives, the prior, its covariance, and what it must not invent."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from level_cases import TOTAL, flight

from magtensor.calibration import nominal as nominal_module
from magtensor.calibration.joint import calibrated, fit_joint, nearest_frame
from magtensor.calibration.known import Known
from magtensor.calibration.nominal import Nominal, fit_nominal
from magtensor.calibration.nominal_steps import NominalData, _system
from magtensor.calibration.types import Array
from magtensor.calibration.undetermined import Undetermined
from magtensor.errors import DataError, NotEnoughData
from magtensor.loop.evidence.residual import residual_of


@pytest.mark.parametrize("sensors", [1, 2, 4])
def test_scores_vanish_at_the_truth_and_change_as_they_say(sensors: int) -> None:
    flown = flight(1, sensors, count=300, noise=0.0)
    data = NominalData(flown.raw.reshape(300, -1), np.full(300, TOTAL), TOTAL, np.linspace(5.0, 9.0, 3 * sensors), 3.0)
    true = np.concatenate([flown.forward, flown.offset[:, :, None] / TOTAL], axis=2).reshape(-1, 4)
    weights = (0.7, 0.3)
    basis = data.basis(data.at(true))
    score, change, covariance = data.equations(data.at(true), weights, basis)
    size = np.sqrt(np.diag(covariance))
    assert np.max(np.abs(score) / size) < 1e-3
    assert np.linalg.eigvalsh(covariance / np.outer(size, size))[0] > -1e-9
    rng = np.random.default_rng(2)
    for way in rng.standard_normal((5, 3 * sensors, 4)):
        there, back = (data.equations(data.at(true + step * way), weights, basis)[0] for step in (1e-6, -1e-6))
        expected = -change @ (way @ basis.T).ravel()
        assert np.max(np.abs((there - back) / 2e-6 - expected)) < 1e-3 * np.max(np.abs(expected))


def _observatory(seed: int) -> tuple[Array, Array]:
    """Outputs (5000, 2, 3) nT of nearly perfect sensors that never turn in a field that hardly changes in a day, and
    the total field (5000,) nT."""
    rng = np.random.default_rng(seed)
    day = np.linspace(0, 2 * np.pi, 5000)
    field = np.array([21e3, 1.5e3, 43.5e3]) + 15.0 * np.column_stack([np.sin(day), np.cos(2 * day), np.sin(3 * day)])
    forward = np.eye(3) + 1e-4 * rng.standard_normal((2, 3, 3))
    raw = np.einsum("sij,nj->nsi", forward, field) + 0.01 * rng.standard_normal((5000, 2, 3))
    return raw, np.linalg.norm(field, axis=1)


def test_sensors_that_stand_still_are_fitted_in_a_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """What samples know of some parameters is 1e14 times what the prior does; rounding has to be less than that."""
    counted: list[int] = []
    equations, settled = NominalData.equations, nominal_module.settled

    def counting(*args: Any) -> Any:
        counted[-1] += 1
        return equations(*args)

    def each(*args: Any) -> Any:
        counted.append(0)
        return settled(*args)

    monkeypatch.setattr(NominalData, "equations", counting)
    monkeypatch.setattr(nominal_module, "settled", each)
    fit_nominal(*_observatory(8), Nominal())
    assert max(counted) <= 12, "as many as a quadratic problem takes, and not until rounding happens to be small"


def test_a_fit_that_begins_with_another_ends_where_it_does_without() -> None:
    raw, total_field = _observatory(9)
    before = fit_nominal(raw, total_field, Nominal())
    changed = raw + np.array([3.0, -2.0, 1.0])
    cold, warm = (fit_nominal(changed, total_field, Nominal(), start=start) for start in (None, before))
    assert cold.posterior is not None
    off = np.concatenate([(warm.forward - cold.forward).reshape(2, 9), warm.offset - cold.offset], axis=1).ravel()
    assert np.max(np.abs(off) / np.sqrt(np.diag(cold.posterior.covariance))) < 0.02


def test_attitudes_that_were_judged_before_are_not_judged_again(monkeypatch: pytest.MonkeyPatch) -> None:
    raw, total_field = _observatory(4)
    before = fit_nominal(raw, total_field, Nominal())
    monkeypatch.setattr(nominal_module, "coverage", None)
    again = fit_nominal(raw, total_field, Nominal(), known=before.coverage)
    assert again.coverage is before.coverage
    np.testing.assert_array_equal(again.forward, before.forward)


def test_a_survey_that_determines_it_is_fitted_alike_with_and_without_the_prior() -> None:
    rng = np.random.default_rng(3)
    u = rng.standard_normal((2000, 3))
    field = TOTAL * u / np.linalg.norm(u, axis=1, keepdims=True)
    forward = np.eye(3) + 0.03 * rng.standard_normal((3, 3, 3))
    raw = np.einsum("sij,nj->nsi", forward, field) + 5.0 * rng.standard_normal((2000, 3, 3))
    plain, near = fit_joint(raw, np.full(2000, TOTAL)), fit_nominal(raw, np.full(2000, TOTAL), Nominal())
    assert plain.posterior is None
    a, b = calibrated(plain), calibrated(near)
    std = np.sqrt(np.diag(a.covariance))
    apart = np.concatenate([(a.matrix - b.matrix).reshape(3, 9), a.offset - b.offset], axis=1).ravel()
    assert np.max(np.abs(apart) / std) < 0.2
    np.testing.assert_allclose(np.sqrt(np.diag(b.covariance)), std, rtol=0.3)


@pytest.mark.parametrize(("sensors", "tilt"), [(2, 1.5), (2, 0.01), (4, 0.3)])
def test_errors_are_as_large_as_the_covariance_says(sensors: int, tilt: float) -> None:
    """Calibrations drawn from the prior itself, over flights of which some parameters are never seen."""
    nominal = Nominal(0.04, float(np.degrees(0.04)), 0.03)
    found = []
    for seed in range(20):
        flown = flight(100 + seed, sensors, tilt_deg=tilt, count=400, scale=0.04, offset=0.03 * TOTAL)
        fit = fit_nominal(flown.raw, np.full(400, TOTAL), nominal)
        assert fit.posterior is not None
        off = fit.forward @ nearest_frame(fit.forward) - flown.forward @ nearest_frame(flown.forward)
        error = np.concatenate([off.reshape(sensors, 9), fit.offset - flown.offset], axis=1).ravel()
        found.append(error / np.sqrt(np.diag(fit.posterior.covariance)))
    each = np.sqrt(np.mean(np.square(found), axis=0))
    assert each.min() > 0.45 and each.max() < 1.55, "of 20: chi-square at one in ten thousand"
    assert 0.7 < np.sqrt(np.mean(np.square(found))) < 1.2


@pytest.mark.parametrize("tilt", [0.0, 0.02, 3.0])
def test_sensors_off_nominal_leave_noise_and_nothing_else(tilt: float) -> None:
    for seed in range(3):
        flown = flight(20 + seed, 2, noise=1.0, tilt_deg=max(tilt, 1e-9), scale=0.07, offset=3000.0)
        total_field = np.full(len(flown.raw), TOTAL)
        left = residual_of(fit_nominal(flown.raw, total_field, Nominal()), flown.raw, total_field)
        assert left.across is not None and left.along is not None
        slow = np.column_stack([left.across, left.along]).reshape(30, 50, -1).mean(axis=1)
        assert 0.9 < left.square() < 1.1
        assert np.mean(slow[:, -1] ** 2) * 50 < 2.0, "what is left is not slow"
        assert np.sum(slow[:, :-1] ** 2) / 30 / 3 * 50 < 2.0


def test_a_strong_current_does_not_take_the_plane() -> None:
    """2000 nT on one compass where the field moves by 500 along z: the prior says which is the field."""
    flown = flight(31, 2, tilt_deg=0.7, effect=np.array([200.0, -300.0, 900.0]))
    fit = fit_nominal(flown.raw, np.full(len(flown.raw), TOTAL), Nominal(), complete=False)
    assert np.abs(fit.forward - np.eye(3)).max() < 0.3
    assert fit.posterior is not None
    assert np.sqrt(np.mean((fit.posterior.field - flown.field) ** 2)) < 0.1 * TOTAL


def test_what_is_far_from_nominal_is_refused() -> None:
    flown = flight(5)
    total_field = np.full(len(flown.raw), TOTAL)
    with pytest.raises(DataError, match=r"sensor 2 is not near nominal: the offset of its x output"):
        fit_nominal(flown.raw + np.array([[0.0, 0, 0], [60_000.0, 0, 0]]), total_field, Nominal())
    with pytest.raises(DataError, match="not near nominal"):
        fit_nominal(flown.raw * np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0]]), total_field, Nominal())
    with pytest.raises(NotEnoughData, match="40 samples"):
        fit_nominal(flown.raw[:40], total_field[:40], Nominal())


@pytest.mark.parametrize("seed", range(1, 6))
def test_a_variometer_far_from_its_base_line_is_fitted(seed: int) -> None:
    """One sensor that stands still and drifts: what it tells is a valley 1e5 times as long as it is wide, and it bends.
    A single step along it leads out by more than the field changes, and steps that make nothing worse follow it."""
    rng = np.random.default_rng(seed)
    slow = np.cumsum(rng.standard_normal((4000, 3)), axis=0) / 10.0 * np.array([1.0, 0.6, 0.4])
    field = np.array([20_800.0, 90.0, 47_800.0]) + slow
    raw = field @ (np.eye(3) + 0.03 * rng.standard_normal((3, 3))).T + 300.0 * rng.standard_normal(3)
    raw += 0.3 * np.sin(np.arange(4000) / 700.0)[:, None] + 0.003 * rng.standard_normal((4000, 3))
    total_field = np.linalg.norm(field, axis=1)
    found = fit_nominal(raw[:, None], total_field, Nominal(), complete=False)
    b = (raw - found.offset[0]) @ np.linalg.inv(found.forward[0]).T
    left = np.linalg.norm(b, axis=1) - total_field
    assert np.sqrt(np.mean(left**2)) < 0.3  # nT, no more than the drift; the base line is off by thousands


@pytest.mark.parametrize(
    ("combinations", "worst_nT", "enough"), [(0, 0.017, True), (0, 500.0, False), (3, 0.02, False)]
)
def test_a_prior_that_determines_nothing_is_no_lack_of_attitudes(
    combinations: int, worst_nT: float, enough: bool
) -> None:
    """Samples that are flagged now had made the fit without it impossible."""
    why = "sensor 2 does not see the field that the others see"
    doubt = Undetermined(why, Nominal(), combinations, 45, Known(0.013, worst_nT), (), "")
    assert doubt.facts()["determined"] is enough
    assert ("the attitudes do not determine the calibration" in doubt.sentence) is not enough
    assert (f"there was no fit ({why}), but the attitudes determine the calibration" in doubt.sentence) is enough


def test_a_fit_that_runs_away_is_refused_as_one() -> None:
    """A sensor that stands still beside an effect of the wrong size: scores that hardly vary by themselves."""
    covariance = np.full((12, 12), 1e10)
    np.fill_diagonal(covariance, 0.0)
    scores = (np.zeros(12), np.zeros((12, 12)), covariance)
    away = SimpleNamespace(basis=lambda here: np.eye(4), equations=lambda *_: scores)
    rows = np.eye(3, 4)
    with pytest.raises(NotEnoughData, match="does not converge"):
        _system(cast(Any, away), cast(Any, SimpleNamespace(rows=rows)), (1.0, 1.0), np.ones(12), rows)
