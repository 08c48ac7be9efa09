"""The tools an error model is written with, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_cases import Array, excitation, simulated

from magtensor.error_models import rates
from magtensor.error_models.excitation import Excitation


def bare(time: Array, run: Array | None = None) -> Excitation:
    field = np.ones((len(time), 1, 3))
    number = np.zeros(len(time), dtype=int) if run is None else run
    return Excitation(time, float(time[0]), ("S1",), field, field, None, {}, {}, number, number)


EVEN = np.arange(400) * 0.05
UNEVEN = np.cumsum(np.random.default_rng(2).uniform(0.01, 0.09, 400))


@pytest.mark.parametrize("time", [EVEN, UNEVEN])
@pytest.mark.parametrize("tau", [0.01, 0.7, 30.0])
def test_the_response_to_a_ramp_is_exact(time: Array, tau: float) -> None:
    t = time - time[0]
    expected = 3.0 * (t - tau * (1 - np.exp(-t / tau))) + 2.0
    x = bare(time)
    np.testing.assert_allclose(x.relaxed(2.0 + 3.0 * t, tau), expected, atol=1e-9)
    np.testing.assert_allclose(x.lagged(2.0 + 3.0 * t, tau), expected, atol=1e-9)


@pytest.mark.parametrize("time", [EVEN, UNEVEN])
def test_the_response_to_a_sinusoid(time: Array) -> None:
    # a cubic spline is off by 5/384 h^4 of the fourth derivative (Hall and Meyer 1976), with steps of up to 0.09 s;
    # twenty times that near the ends, where the third derivative is not known
    w, tau = 1.3, 0.8
    gain, late = 1 / np.hypot(1, w * tau), np.arctan(w * tau)
    t = time - time[0]
    start = np.sin(0.4) - gain * np.sin(0.4 - late)
    expected = gain * np.sin(w * t + 0.4 - late) + start * np.exp(-t / tau)
    np.testing.assert_allclose(
        bare(time).relaxed(np.sin(w * t + 0.4), tau), expected, atol=20 * 5 / 384 * (w * 0.09) ** 4
    )


def test_a_run_begins_in_equilibrium_and_a_lag_goes_on() -> None:
    time = np.concatenate([EVEN, EVEN + 25.0])
    run = np.repeat([0, 1], 400)
    step = np.concatenate([np.zeros(400), np.ones(400)])
    x = bare(time, run)
    np.testing.assert_allclose(x.relaxed(step, 5.0), step, atol=1e-12)
    # a straight line over the gap of 5.05 s, then the rest decays
    gap, tau = 25.0 - EVEN[-1], 5.0
    at_once = 1 - tau / gap * (1 - np.exp(-gap / tau))
    expected = 1 - (1 - at_once) * np.exp(-EVEN / tau)
    np.testing.assert_allclose(x.lagged(step, tau)[400:], expected, atol=1e-12)
    np.testing.assert_array_equal(x.lagged(step, 0.0), step)


def test_a_lag_of_many_columns_is_that_of_each() -> None:
    series = np.random.default_rng(1).standard_normal((400, 2, 3))
    x = bare(UNEVEN)
    every = x.lagged(series, 0.5)
    np.testing.assert_allclose(every[:, 1, 2], x.lagged(series[:, 1, 2].copy(), 0.5), atol=1e-12)


@pytest.mark.parametrize("time", [EVEN, UNEVEN])
def test_the_derivative_of_a_cubic(time: Array) -> None:
    found = bare(time).derivative(0.2 * time**3 - time)
    np.testing.assert_allclose(found[2:-2], (0.6 * time**2 - 1)[2:-2], atol=1e-7)


def test_matrix_and_gradient_are_those_of_the_survey() -> None:
    survey = simulated("site_gradient", tensor_nT_per_m=[12.0, -5.0, 3.0, -20.0, 7.0])
    x = excitation(survey)
    np.testing.assert_allclose(x.matrix, survey.truth.matrix, atol=1e-9)
    np.testing.assert_allclose(x.gradient, survey.truth.tensor, atol=1e-6)
    assert not x.uniform


def test_the_matrix_of_a_field_in_a_plane_is_found_as_far_as_it_shows() -> None:
    survey = simulated("warm_up", nT=[1.0, 1.0, 1.0])
    x = excitation(survey)
    flat = x.field * [1.0, 1.0, 0.0] + [0.0, 0.0, 30000.0]
    output = np.einsum("sij,nsj->nsi", survey.truth.matrix, flat)
    found = replace(x, field=flat, output=output).matrix
    np.testing.assert_allclose(found[:, :, :2], survey.truth.matrix[:, :, :2], atol=1e-9)
    np.testing.assert_allclose(found[:, :, 2], np.broadcast_to([0.0, 0.0, 1.0], (4, 3)), atol=1e-9)


def test_a_field_that_is_not_known_somewhere_has_no_curvature_there() -> None:
    t = np.arange(100) * 0.1
    turned = 5e4 * np.stack([np.cos(t), np.sin(t), 0.0 * t], axis=1)
    rate = rates.turning(t, [(0, 100)], turned)
    rate[90:] = np.nan
    found = rates.curvature(t, [(0, 100)], turned, rate)
    assert np.isfinite(found[:90]).all() and np.isnan(found[90:, :2]).all()
    assert np.isnan(rates.curvature(t, [(0, 100)], turned, np.full_like(rate, np.nan))[:, :2]).all()


@pytest.mark.parametrize("step", [0.3, 0.6])
def test_how_wrong_a_rate_is(step: float) -> None:
    """Told from its part along the field, whose rate is known in closed form; the ends of runs have more of it."""
    t = np.arange(1000) * step
    azimuth, elevation = 3.0 * np.sin(0.3 * t) + 2.0 * np.sin(0.17 * t), 1.2 * np.sin(0.23 * t + 1.0)
    rate_a = 0.9 * np.cos(0.3 * t) + 0.34 * np.cos(0.17 * t)
    rate_e = 1.2 * 0.23 * np.cos(0.23 * t + 1.0)
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    field = 5e4 * np.stack([ce * ca, ce * sa, se], axis=1)
    exact = 5e4 * np.stack(
        [-se * ca * rate_e - ce * sa * rate_a, -se * sa * rate_e + ce * ca * rate_a, ce * rate_e], axis=1
    )
    runs = [(0, 400), (400, 1000)]
    wrong = rates.turning(t, runs, field) - exact
    share = np.sqrt(np.sum(wrong**2) / np.sum(exact**2))
    assert 0.3 * share < rates.error(t, runs, field) < 2.0 * share


@pytest.mark.parametrize("step", [0.05, 0.4])
def test_the_second_derivative_of_a_turn(step: float) -> None:
    """-w^2 of what turns at w. The noise is that of second differences of six samples' reach where the field turns a
    quarter of a radian meanwhile, 1.5 times that near the ends, and of two where it turns by more."""
    t = np.arange(400) * step
    w, size, noise = 0.8, 5e4, 1.0
    turned = size * np.stack([np.cos(w * t), np.sin(w * t), 0.5 + 0.0 * t], axis=1)
    runs = [(0, 150), (150, 400)]
    rate = rates.turning(t, runs, turned)
    exact = turned * [-(w**2), -(w**2), 0.0]
    inner = np.r_[10:140, 160:390]
    # off by (w h)^2 / 12 over the reach h
    h = 6 * 0.05 if step == 0.05 else 2 * step
    found = rates.curvature(t, runs, turned, rate)
    assert np.abs(found - exact)[inner].max() <= 1.05 * w**2 * size * (w * h) ** 2 / 12.0
    noisy = turned + np.random.default_rng(3).normal(scale=noise, size=turned.shape)
    across = (rates.curvature(t, runs, noisy, rates.turning(t, runs, noisy)) - found)[inner, 2]
    assert np.std(across) < 1.2 * np.sqrt(6.0) * noise / h**2
