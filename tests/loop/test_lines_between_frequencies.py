"""A tone is found as well halfway between two of the survey's own frequencies as at one of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import linear_state, lines_left, synthetic

from magtensor.loop.evidence.spectrum import spectral_lines

SAMPLES = 2000
TURNS = 400  # of the tone in the survey
NOISE_NT = 0.15


@pytest.mark.parametrize("samples", [SAMPLES, SAMPLES - 1], ids=["even", "odd"])
@pytest.mark.parametrize("off", [0.0, 0.25, 0.5, -0.5])
def test_a_weak_tone_is_found_wherever_it_lies(off: float, samples: int) -> None:
    """A third of the noise in one axis: at a frequency nine of ten are found, and halfway three of ten were."""
    frequency = (TURNS + off) / samples
    found = 0
    for seed in range(6):
        added = np.zeros((samples, 4, 3))
        added[:, 3, 0] = NOISE_NT / 3.0 * np.sin(2.0 * np.pi * frequency * np.arange(samples) + seed)
        record = synthetic(seed, samples, added=added, turning_s=7.0, noise_nT=NOISE_NT)
        found += any(abs(f - frequency) < 1.0 / samples and p < 0.005 for f, _, p in lines_left(record))
    assert found >= 4


@pytest.mark.parametrize("samples", [1000, 1001])
def test_the_highest_frequency_is_no_line(samples: int) -> None:
    """It has one phase where others have two, and twice their power as often."""
    added = np.zeros((samples, 4, 3))
    added[:, 2] = 0.5 * np.cos(np.pi * np.arange(samples))[:, None]
    assert all(f < 0.5 for f, _, _ in lines_left(synthetic(8, samples, added=added, turning_s=7.0)))


@pytest.mark.parametrize("seed", range(4))
def test_noise_on_a_platform_that_never_turns_has_no_line(seed: int) -> None:
    """The field's direction is one but for a sensor's noise: |b| - F tells of one coordinate, and not of three."""
    record = synthetic(seed, noise_nT=NOISE_NT)
    residual = linear_state(record).residual
    direction = np.array([0.4, -0.5, 0.77]) + 3e-6 * np.random.default_rng(seed).standard_normal((1200, 3))
    still = replace(residual, across=None, affine=np.column_stack([direction, residual.affine[:, 3:]]))
    assert spectral_lines(still, record.time[residual.samples])[0][2] > 0.005
