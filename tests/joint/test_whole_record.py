"""A recording longer than a selection of it: one reading gives the estimate that all samples together give."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from joint_cases import Array, Drawn, drawn

from magtensor.calibration import joint, whole_record
from magtensor.calibration.joint import JointFit, calibrated, fit_joint, fit_recording
from magtensor.calibration.recording import InMemory, even_blocks, even_samples
from magtensor.calibration.whole_record import Limits, fit_whole
from magtensor.errors import DataError, NotEnoughData


@pytest.fixture
def short_selection(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings of 20 000 samples count as long."""
    monkeypatch.setattr(joint, "AT_ONCE", 5_000)
    monkeypatch.setattr(joint, "SELECTION", 4_096)


def together(survey: Drawn, **options: object) -> JointFit:
    return fit_joint(survey.raw, survey.total_field, worst_error=1.0, **options)


@pytest.mark.usefixtures("short_selection")
@pytest.mark.parametrize("sensors", [1, 2, 4])
@pytest.mark.parametrize(("tilt_deg", "noise_nT"), [(None, 1.0), (20.0, 1.0), (40.0, 30.0)])
def test_one_reading_is_as_good_as_all_together(
    sensors: int, tilt_deg: float | None, noise_nT: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    survey = drawn(3, 20_000, sensors=sensors, tilt_deg=tilt_deg, noise_nT=noise_nT)
    part = together(survey)
    monkeypatch.setattr(joint, "AT_ONCE", 20_000)
    # the noise is known from the selection alone: given to both, there is nothing left to differ by
    noise = part.plane.noise.reshape(sensors, 3)
    whole = together(survey, noise=noise)
    a, b = calibrated(part), calibrated(whole)
    std = np.sqrt(np.diag(b.covariance))
    error = np.concatenate(
        [
            np.concatenate([(x - y).ravel(), p - q])
            for x, y, p, q in zip(a.matrix, b.matrix, a.offset, b.offset, strict=True)
        ]
    )
    assert np.abs(error / std).max() < 0.02
    np.testing.assert_allclose(np.sqrt(np.diag(a.covariance)), std, rtol=1e-3)
    assert a.diagnostics["chi2_total_field"] == pytest.approx(b.diagnostics["chi2_total_field"], rel=1e-4)
    if sensors > 1:
        assert part.plane.chi2 == pytest.approx(whole.plane.chi2, rel=1e-6)


@pytest.mark.usefixtures("short_selection")
@pytest.mark.parametrize("sensors", [1, 4])
def test_spikes_outside_the_selection_are_left_out(sensors: int) -> None:
    survey = drawn(5, 20_000, sensors=sensors)
    rng = np.random.default_rng(6)
    hit = rng.choice(20_000, 200, replace=False)
    raw = survey.raw.copy()
    raw[hit, rng.integers(0, sensors, 200)] += 1000.0 * survey.field[hit] / 50_000
    fit = fit_joint(raw, survey.total_field)
    assert not fit.keep[hit].any()
    assert (~fit.keep).sum() <= 202
    clean = calibrated(fit_joint(survey.raw, survey.total_field))
    std = np.sqrt(np.diag(clean.covariance)).reshape(sensors, 12)[:, 9:]
    assert (np.abs(fit.offset - clean.offset) < 1.0 * std).all()


@pytest.mark.usefixtures("short_selection")
def test_what_the_selection_never_saw_the_rest_may_hold() -> None:
    survey = drawn(7, 20_000)
    rest = np.abs(np.arange(20_000) - 12_345) > 60  # turned for 120 samples only, between blocks of the selection
    still = survey.field.copy()
    still[rest] = survey.field[0]
    clean = np.einsum("sij,nj->nsi", survey.forward, still) + survey.offset
    raw = clean + np.random.default_rng(1).standard_normal(clean.shape)
    total_field = np.linalg.norm(still, axis=1)
    fit = fit_joint(raw, total_field, worst_error=1.0)
    alone = fit_joint(raw[~rest], total_field[~rest], worst_error=1.0)
    std = np.sqrt(np.diag(calibrated(alone).covariance)).reshape(4, 12)[:, 9:]
    assert (np.abs(fit.offset - survey.offset) < 5 * std).all()


@pytest.mark.usefixtures("short_selection")
def test_an_effect_that_nobody_declared_does_not_stop_it() -> None:
    survey = drawn(8, 20_000)
    drift = 300.0 * np.sin(np.linspace(0, 20, 20_000))
    raw = survey.raw.copy()
    raw[:, 1, 2] += drift
    fit = fit_joint(raw, survey.total_field, complete=False)
    noise = fit.plane.noise.reshape(4, 3)
    # the drift is not the noise, though blocks of the selection lie far apart in time
    np.testing.assert_allclose(noise, 1.0, atol=0.3)


@dataclass(frozen=True)
class FromDisk:
    """Another recording than those of the product, that counts what is read."""

    survey: Drawn
    usable: Array | None
    asked: list[int] = field(default_factory=list)

    @property
    def count(self) -> int:
        return len(self.survey.raw)

    @property
    def sensors(self) -> int:
        return self.survey.raw.shape[1]

    def read(self, start: int, stop: int) -> tuple[Array, Array]:
        self.asked.append(stop - start)
        return self.survey.raw[start:stop].copy(), self.survey.total_field[start:stop].copy()


def test_a_recording_is_read_little_more_than_once_and_in_pieces() -> None:
    survey = drawn(9, 200_000, sensors=2)
    disk = FromDisk(survey, None)
    fit = fit_recording(disk)
    assert sum(disk.asked) <= 200_000 + joint.SELECTION
    assert max(disk.asked) <= 65_536
    same = fit_joint(survey.raw, survey.total_field)
    np.testing.assert_array_equal(fit.forward, same.forward)
    np.testing.assert_array_equal(fit.keep, same.keep)


def test_samples_that_may_not_be_used_are_never_looked_at() -> None:
    survey = drawn(10, 100_000, sensors=2)
    usable = np.ones(100_000, dtype=bool)
    usable[20_000:30_000] = False
    survey.raw[~usable] = np.nan
    fit = fit_recording(InMemory(survey.raw, survey.total_field, usable))
    assert not fit.keep[~usable].any()
    assert fit.keep[usable].all()
    assert np.isfinite(calibrated(fit).covariance).all()


def test_a_value_that_is_no_number_is_refused() -> None:
    survey = drawn(10, 100_000, sensors=2)
    survey.raw[77_777, 1, 2] = np.nan
    with pytest.raises(DataError, match="finite"):
        fit_joint(survey.raw, survey.total_field)


def test_a_recording_that_its_selection_does_not_stand_for_is_refused() -> None:
    survey = drawn(11, 70_000)
    fit = fit_joint(survey.raw, survey.total_field)
    recording = InMemory(survey.raw, survey.total_field)
    narrow = Limits(along=0.1, across=0.1)
    with pytest.raises(NotEnoughData, match="half of the samples"):
        fit_whole(recording, fit.plane, fit.scalar, limits=narrow, reference_noise=0.0, keep=None)


@pytest.mark.parametrize(("count", "samples"), [(100_000, 16_384), (20_000, 16_384), (70_000, 4_096), (500, 1_000)])
def test_selections_are_even(count: int, samples: int) -> None:
    for index in (even_blocks(count, samples), even_samples(count, samples)):
        assert (np.diff(index) > 0).all()
        assert index[0] >= 0 and index[-1] < count
        share = np.histogram(index, bins=4, range=(0, count))[0] / len(index)
        np.testing.assert_allclose(share, 0.25, atol=0.15)


def test_where_readings_do_not_settle_all_samples_are_fitted_together(monkeypatch: pytest.MonkeyPatch) -> None:
    survey = drawn(12, 70_000, sensors=1)
    settled = fit_joint(survey.raw, survey.total_field)
    monkeypatch.setattr(whole_record, "NEGLIGIBLE", 0.0)
    together = fit_joint(survey.raw, survey.total_field)
    np.testing.assert_allclose(together.offset, settled.offset, atol=0.01 / np.sqrt(70_000))
