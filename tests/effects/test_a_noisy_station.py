"""Noise of a base station is neither a scale factor of the variation, however alike the two happen to be, nor a clock
that is wrong."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from magtensor.calibration.types import Array
from magtensor.registry import Registry

SAMPLES, SURVEYS = 400, 100
AGREES = Registry.load().find("error_model", "reference_scale").agrees


def red(rng: np.random.Generator, power: float) -> Array:
    """(N,) of unit rms whose power goes with frequency to the minus `power`."""
    frequency = np.fft.rfftfreq(4 * SAMPLES)
    frequency[0] = frequency[1]
    spectrum = np.fft.rfft(rng.standard_normal(4 * SAMPLES)) * frequency ** (-power / 2.0)
    course = np.fft.irfft(spectrum)[:SAMPLES]
    return cast(Array, (course - course.mean()) / course.std())


def believed(variation: Array, error: Array) -> bool:
    """Whether the model believes what a least-squares fit of the recorded variation to its error gives."""
    recorded = variation + error
    excess = float(error @ recorded / (recorded @ recorded))
    explained = 1.0 - float(np.sum((error - excess * recorded) ** 2) / np.sum(error**2))
    x: Any = SimpleNamespace(reference=recorded)
    assert AGREES is not None
    return AGREES(x, {}, np.array([100.0 * excess]), explained)


@pytest.mark.parametrize("size", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("power", [1.0, 1.6, 2.0])
def test_noise_as_slow_as_the_variation_is_not_believed(power: float, size: float) -> None:
    """By its share alone one in three would be."""
    rng = np.random.default_rng(5)
    assert sum(believed(red(rng, power), size * red(rng, power)) for _ in range(SURVEYS)) <= 4


@pytest.mark.parametrize("excess", [-0.1, 0.03, 0.1, 0.3])
@pytest.mark.parametrize("power", [1.0, 2.0])
def test_a_scale_factor_is_believed(power: float, excess: float) -> None:
    """Beside noise of a fifth of it."""
    rng = np.random.default_rng(6)
    courses = [red(rng, power) for _ in range(SURVEYS)]
    assert sum(believed(v, excess * (v + 0.2 * red(rng, 1.0))) for v in courses) >= 0.9 * SURVEYS


@pytest.mark.parametrize("lag_s", [-100.0, 100.0, -7.0])
def test_readings_of_a_quiet_time_in_the_place_of_disturbed_ones_are_no_clock(lag_s: float) -> None:
    """A car stands beside the station for a while; or the field itself goes on as it does, its stamps wrong."""
    at = np.arange(-300.0, 900.0, 5.0)
    slow = 5.0 * np.sin(at / 60.0) + np.sin(at / 17.0)
    test = Registry.load().find("error_model", "reference_clock").agrees
    assert test is not None
    beside = 100.0 * ((at > 595.0 + lag_s if lag_s < 0.0 else at < 5.0 + lag_s) & (at > 0.0) & (at < 600.0))
    for values, clock in ((slow, True), (0.1 * slow + beside, abs(lag_s) < 10.0)):
        readings = SimpleNamespace(time=at, at=lambda t, values=values: np.interp(t, at, values))
        x: Any = SimpleNamespace(time=np.arange(0.0, 600.0), readings=readings)
        assert test(x, {"lag_s": lag_s}, np.array([0.95 * lag_s]), 0.9) is clock
        assert not test(x, {"lag_s": lag_s}, np.array([0.5 * lag_s]), 0.9)
