"""Responses of a first-order lag, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from magtensor.error_models import first_order

TIME = np.cumsum(np.random.default_rng(3).uniform(0.05, 0.15, 200))


@pytest.mark.parametrize("tau", [1e-3, 0.1, 0.105, 3.0, 1e5])
def test_a_cubic_is_answered_exactly(tau: float) -> None:
    t = TIME - TIME[0]
    c = np.polynomial.Polynomial([2.0, -1.0, 0.3, -0.02])
    # x - tau x' + tau^2 x'' - ..., and what of that is not there at the start decays; summed so that nothing cancels
    if tau < 1e3:
        steady = c(t) - tau * c.deriv()(t) + tau**2 * c.deriv(2)(t) - tau**3 * c.deriv(3)(t)
        expected = steady + (c(0) - steady[0]) * np.exp(-t / tau)
    else:  # the integral of (x - y) / tau, y hardly moving
        expected = c(0) + (c.integ()(t) - c(0) * t) / tau
    found = first_order.smooth(TIME, c(t), tau)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 if tau < 1e3 else 0.01 * t[-1] ** 2 / tau)


def test_a_turn_loses_less_than_by_straight_lines() -> None:
    w, tau, h = 5.0, 0.05, 0.1
    t = np.arange(300) * h
    x = np.stack([np.cos(w * t), np.sin(w * t)], axis=1)
    expected = np.stack([np.cos(w * t - np.arctan(w * tau)), np.sin(w * t - np.arctan(w * tau))], axis=1)
    expected /= np.hypot(1.0, w * tau)
    inner = slice(100, 200)  # what it began with has decayed, and no end of the spline is near
    spline, lines = (f(t, x, tau)[inner] - expected[inner] for f in (first_order.smooth, first_order.straight))
    assert np.abs(spline).max() < (w * h) ** 4 / 384
    assert np.abs(lines).max() > 0.5 * (w * h) ** 2 / 12


def test_many_columns_are_each_answered_as_one() -> None:
    series = np.random.default_rng(4).standard_normal((200, 2, 3))
    for response in (first_order.smooth, first_order.straight):
        together = response(TIME, series, 0.4)
        np.testing.assert_allclose(together[:, 1, 2], response(TIME, series[:, 1, 2], 0.4), atol=1e-12)
