"""How much is left above white noise, in nT, of sensors whose noise differs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import linear_state, synthetic

from magtensor.loop.fitting.model import Record
from magtensor.loop.remainder.excess import excess_rms, white_noise

SAMPLES, HELD = 2400, 10


def with_noise(noise: list[float], seed: int, sensor: int | None = None, rms: float = 0.0) -> Record:
    """White noise of so many nT of each sensor, and of one of them values of that rms that hold for ten samples."""
    rng = np.random.default_rng(seed)
    added = np.array(noise)[:, None] * rng.standard_normal((SAMPLES, len(noise), 3))
    if sensor is not None:
        values = rng.standard_normal((SAMPLES // HELD, 3))
        added[:, sensor] += np.repeat(rms * values / np.sqrt(np.mean(values**2)), HELD, axis=0)
    return synthetic(seed, SAMPLES, len(noise), 0.0, added, turning_s=4.0)


@pytest.mark.parametrize(
    ("noise", "sensor", "rms"),
    [
        ([0.3, 0.3, 0.3, 10.0], 0, 1.0),
        ([0.3, 0.3, 0.3, 10.0], 3, 8.0),
        ([0.1, 1.0, 1.0, 1.0], 0, 1.0),
        ([0.1, 1.0, 1.0, 1.0], 2, 1.0),
        ([0.3, 0.3, 10.0], 1, 1.0),
        ([0.2, 1.0], 1, 2.0),
        ([0.5, 0.5, 0.5, 0.5], 1, 1.0),
    ],
)
def test_a_remainder_counts_in_nT_whoever_has_it(noise: list[float], sensor: int, rms: float) -> None:
    """Its error is what white noise makes of a mean square; the affine freedom of C takes one part in 60 of it."""
    found = excess_rms(linear_state(with_noise(noise, 3, sensor, rms)))
    assert found == pytest.approx(rms / np.sqrt(len(noise)), rel=0.12)


@pytest.mark.parametrize("noise", [[0.3, 0.3, 0.3, 10.0], [0.1, 1.0, 1.0, 1.0], [0.3, 0.3, 10.0], [1.0, 1.0]])
def test_without_one_there_is_no_more_than_chance_makes_of_the_quiet(noise: list[float]) -> None:
    found = [excess_rms(linear_state(with_noise(noise, seed))) for seed in range(4)]
    assert np.median(found) < 0.1 * max(noise) / np.sqrt(len(noise))


def test_an_error_of_the_total_field_is_one_along_the_field() -> None:
    record = with_noise([0.3, 0.3, 0.3, 10.0], 5)
    assert record.total_field is not None
    values = np.random.default_rng(6).standard_normal(SAMPLES // HELD)
    off = np.repeat(values / np.sqrt(np.mean(values**2)), HELD)
    found = excess_rms(linear_state(replace(record, total_field=record.total_field + off)))
    assert found == pytest.approx(1.0 / np.sqrt(3.0), rel=0.1)  # of its square each axis has a third


@pytest.mark.parametrize("seed", range(3))
def test_the_noise_is_told_from_much_that_turns_with_the_platform(seed: int) -> None:
    """A law of the attitude, a thousand times the noise, that turns in some ten samples: what is fastest holds the
    least of it. Where there is none, the noise is what the residual is divided by."""
    rng = np.random.default_rng(seed)
    plain = synthetic(seed, SAMPLES, noise_nT=0.15, turning_s=12.0)
    turned = plain.raw[:, :1] * plain.raw[:, :1, ::-1] / 5e4**2
    bent = replace(plain, raw=plain.raw + 400.0 * turned * rng.standard_normal((4, 3)))
    residual = linear_state(bent).residual
    assert 0.14 < white_noise(residual) < 0.5 * residual.scale
    residual = linear_state(plain).residual
    assert white_noise(residual) == residual.scale == pytest.approx(0.15, rel=0.05)
