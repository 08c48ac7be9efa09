"""The noise of the sensors: two share one residual, and of a few postures chance makes differences."""

from __future__ import annotations

import numpy as np
import pytest

from magtensor.calibration.common_field import common_field
from magtensor.calibration.joint import calibrated, fit_joint
from magtensor.calibration.noise import noise_std, shares_of_two
from magtensor.errors import NotEnoughData

F = 50_000.0


def turned(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 3) nT, a smooth path over the sphere."""
    t = np.linspace(0, 40 * np.pi, n)
    height = np.cos(t / 20)
    r = np.sqrt(1 - height**2)
    return F * np.column_stack([r * np.cos(t), r * np.sin(t), height])


def survey(seed: int, noise: tuple[float, float], reference: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    b = turned(rng, 8000)
    raw = np.stack([b + s * rng.standard_normal(b.shape) for s in noise], axis=1)
    return raw, F + reference * rng.standard_normal(len(b))


@pytest.mark.parametrize("reference", [0.0, 20.0])
def test_shares(reference: float) -> None:
    raw, total_field = survey(1, (10.0, 30.0), reference)
    assert shares_of_two(raw, total_field) == pytest.approx([0.1, 0.9], abs=0.03)
    std = noise_std(raw, total_field)
    assert std[0] == pytest.approx(10.0, rel=0.2)
    assert std[1] == pytest.approx(30.0, rel=0.05)


def test_the_quieter_sensor_leads_the_joint_fit() -> None:
    raw, total_field = survey(2, (2.0, 100.0), 0.0)
    fit = fit_joint(raw, total_field)
    found = calibrated(fit)
    noise = fit.plane.noise.reshape(2, 3)
    assert (noise[1] / noise[0] > 5).all()
    # the quieter sensor's own 2 nT over 8000 samples; with equal weights it would be some 50 nT
    assert np.abs(found.offset[0]).max() < 5 * 2.0 * np.sqrt(3 / 8000) * 3


def test_a_strong_effect_is_no_lack_of_attitudes_until_the_model_is_complete() -> None:
    raw, total_field = survey(3, (5.0, 5.0), 0.0)
    slow = 3_500.0 * np.sin(np.linspace(0, 7 * np.pi, len(raw)))
    raw = raw + slow[:, None, None] * np.array([1.0, -0.5, 0.8])
    fit_joint(raw, total_field, complete=False)
    with pytest.raises(NotEnoughData):
        fit_joint(raw, total_field)
    planar = raw * np.array([1.0, 1.0, 0.0]) + np.array([0.0, 0.0, 1_000.0])
    with pytest.raises(NotEnoughData):
        fit_joint(planar, total_field, complete=False)


@pytest.mark.parametrize(
    ("noise", "known_to"), [((1.0, 30.0, 1.0, 1.0), 0.05), ((0.05, 0.5, 0.1, 1.5), 0.4), ((0.1, 3.0, 0.1), 0.1)]
)
def test_a_quiet_sensor_beside_loud_ones_is_known_for_quiet(noise: tuple[float, ...], known_to: float) -> None:
    """As well as the differences tell it: two equal ones to some per cent, of 0.05 beside 0.1 the square to a half."""
    rng = np.random.default_rng(12)
    b = turned(rng, 6000)
    raw = np.stack([b + s * rng.standard_normal(b.shape) for s in noise], axis=1)
    np.testing.assert_allclose(common_field(raw).noise.reshape(-1, 3).T, [noise] * 3, rtol=known_to)


@pytest.mark.parametrize("sensors", [3, 4, 8])
def test_the_noise_of_a_few_postures_is_not_what_chance_makes_of_an_axis(sensors: int) -> None:
    """Equal axes come out equal within a third; the mean is right."""
    rng = np.random.default_rng(sensors)
    found = np.stack([noise_std(rng.standard_normal((40, sensors, 3))) for _ in range(40)])
    assert found.min() > 0.65 and found.max() < 1.5
    assert np.sqrt(np.mean(found**2)) == pytest.approx(1.0, abs=0.08)


def test_axes_that_differ_are_told_apart_where_the_samples_show_it() -> None:
    rng = np.random.default_rng(2)
    true = np.exp(0.5 * rng.standard_normal((4, 3)))
    np.testing.assert_allclose(noise_std(true * rng.standard_normal((20_000, 4, 3))), true, rtol=0.15)
