"""Slow noise of a base station is no scale factor of the variation, however alike the two happen to be."""

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
