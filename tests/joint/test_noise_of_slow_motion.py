"""The noise of outputs between which the field hardly moves: neighbouring samples differ by noise above all."""

from __future__ import annotations

import numpy as np
import pytest

from magtensor.calibration.common_field import output_noise


def outputs(noise_nT: list[float], turning_rad_s: float, added: float = 0.0) -> np.ndarray:
    """(N, S, 3) nT at 10 Hz of a payload that turns about its cord and swings; `added` nT of a current on one axis."""
    rng, instrument = np.random.default_rng(5), np.random.default_rng(6)
    time = np.arange(8000) / 10.0
    spin, swing = turning_rad_s * time + 2.0 * np.sin(time / 30.0), np.radians(20.0) * np.sin(turning_rad_s * time)
    flat = np.column_stack([np.cos(spin) * 22_000.0, -np.sin(spin) * 22_000.0, np.full(len(time), 46_000.0)])
    turned = np.column_stack(
        [
            np.cos(swing) * flat[:, 0] - np.sin(swing) * flat[:, 2],
            flat[:, 1],
            np.sin(swing) * flat[:, 0] + np.cos(swing) * flat[:, 2],
        ]
    )
    sensors = len(noise_nT)
    forward = np.eye(3) + 0.02 * instrument.standard_normal((sensors, 3, 3))
    raw = np.einsum("sij,nj->nsi", forward, turned) + 300.0 * instrument.standard_normal((sensors, 3))
    raw[:, 0, 2] += added * np.sin(time / 13.0)
    return raw + np.array(noise_nT)[:, None] * rng.standard_normal(raw.shape)


@pytest.mark.parametrize("turning_rad_s", [0.1, 0.5, 3.0])
@pytest.mark.parametrize("levels", [1.0, 0.001])
def test_of_four_sensors_each_has_its_own(turning_rad_s: float, levels: float) -> None:
    noise = [150.0 * levels, 550.0 * levels, 300.0 * levels, 200.0 * levels]
    found = output_noise(outputs(noise, turning_rad_s))
    np.testing.assert_allclose(found, np.repeat(noise, 3).reshape(-1, 3), rtol=0.08)  # 1.4 % each, and their plane


@pytest.mark.parametrize("turning_rad_s", [0.1, 0.5, 3.0])
@pytest.mark.parametrize("noise", [[150.0, 550.0], [330.0, 17.0]])  # beside the quiet one, the other's is no field
def test_of_two_sensors_the_noise_is_that_of_their_contrast(noise: list[float], turning_rad_s: float) -> None:
    found = output_noise(outputs(noise, turning_rad_s))
    assert found == pytest.approx(np.sqrt(np.mean(np.square(noise))), rel=0.05)


def test_a_current_that_no_model_knows_is_no_noise() -> None:
    """300 nT on one axis, two thousand times the noise, would tilt the plane of the outputs."""
    found = output_noise(outputs([0.15] * 4, 0.5, added=300.0))
    assert found.max() < 0.2
