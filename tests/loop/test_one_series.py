"""Coefficients of one series in noise whose power is known from the residual alone, octave by octave."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from loop_cases import BASE, Array, linear_state, loaded, scenario
from scipy.special import betaincc

from magtensor.loop.evidence.one_series import one_series_p
from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.registry import Registry

COUNTS = np.array([4.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0])
SQUARES = np.array([160.0, 120.0, 100.0, 60.0, 40.0, 20.0, 10.0, 5.0])  # of a regressor that is slow, as a step is


@pytest.mark.parametrize(
    ("count", "dimension", "share"),
    [(8, 1, 0.9), (8, 1, 0.99), (16, 1, 0.7), (64, 1, 0.5), (6, 1, 0.3), (36, 9, 0.7), (36, 9, 0.9), (72, 3, 0.5)],
)
def test_in_one_band_it_is_the_correlation_coefficient(count: int, dimension: int, share: float) -> None:
    one = np.ones(1)
    exact = betaincc(dimension / 2.0, (count - dimension) / 2.0, share**2)
    product = share * np.linspace(1.0, 3.0, dimension)
    product *= share / np.linalg.norm(product)
    assert one_series_p(count * one, product[None], one, one) == pytest.approx(exact, rel=0.2)


@pytest.mark.parametrize("dimension", [1, 3])
def test_noise_has_every_probability_alike(dimension: int) -> None:
    rng = np.random.default_rng(3)
    found = []
    for _ in range(80):
        levels = 10.0 ** rng.uniform(-1.0, 2.0, len(COUNTS))
        noise = [rng.standard_normal((int(n), dimension)) * one for n, one in zip(COUNTS, levels, strict=True)]
        power = np.array([np.sum(n**2) for n in noise])
        first = np.array([n[0] for n in noise])  # along a regressor that is all in it
        found.append(one_series_p(dimension * COUNTS, first * np.sqrt(SQUARES)[:, None], SQUARES, power))
    for level in (0.05, 0.1, 0.3, 0.5):
        assert np.mean(np.array(found) < level) < level + 3.0 * np.sqrt(level * (1.0 - level) / len(found))
    assert np.mean(np.array(found) < 0.5) > 0.3  # and it is a probability, not a bound


def test_it_does_not_depend_on_the_units() -> None:
    cosines = np.array([0.95, 0.8, 0.5, 0.3, 0.1, 0.0, 0.05, 0.0])
    product = (cosines * np.sqrt(SQUARES * COUNTS))[:, None]
    p = one_series_p(COUNTS, product, SQUARES, COUNTS)
    again = one_series_p(COUNTS, 1e-9 * product, 1e-12 * SQUARES, 1e-6 * COUNTS)
    assert 0.0 < p < 1e-3
    assert again == pytest.approx(p, rel=1e-6)


def slow_noise(count: int, seed: int) -> Array:
    """White noise of 0.1 nT and a random walk that is larger below a hundredth of all frequencies."""
    rng = np.random.default_rng(seed)
    out: Array = 0.1 * rng.standard_normal(count) + 0.005 * np.cumsum(rng.standard_normal(count))
    return out


def p_of_a_step(folder: Path, *effects: dict[str, object], added: Array | None = None, seed: int = 91) -> float:
    """The least p of a step of the base station within 10 s of its half, in noise of each sensor's own spectrum."""
    record = loaded(folder, scenario(seed, *effects, base_station=BASE["base_station"] | {"rate_Hz": 2.0}))
    assert record.total_field is not None
    if added is not None:
        record.total_field[:] += added
    state = linear_state(record)
    step = Registry.load().find("error_model", "reference_step")
    noise = OwnNoise(state.residual, None)
    times = np.arange(590.0, 611.0, 2.0)
    return min(noise.p_value(step.function(state.excitation, time_s=t).at(state.residual.samples)) for t in times)


def test_a_step_of_the_size_of_the_noise_is_beyond_all_that_is_tried(tmp_path: Path) -> None:
    effect = {"type": "reference_step", "time_s": [600.0], "rms_nT": 0.15}
    assert p_of_a_step(tmp_path, effect) < 0.005 / 36 / 342  # the level, the models, the times that are tried


def test_a_base_station_that_walks_has_no_steps(tmp_path: Path) -> None:
    walks = [p_of_a_step(tmp_path, added=slow_noise(2400, seed)) for seed in range(4)]
    assert min(walks) > 0.005 / 4 / 11  # of four walks and eleven times each
