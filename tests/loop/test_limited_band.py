"""A sensor that is read far more often than it answers has noise up to some frequency only: that is its noise."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import BASE, Array, linear_state, scenario, synthetic, verdict_of
from scipy.signal import butter, lfilter, sosfilt

from magtensor.loop.remainder.limited_band import limited_band

QUIET = copy.deepcopy(BASE["instrument"]) | {"noise": {"white_sd_nT": 0.01}}
SAMPLES = 4000
SLOWLY = 100.0  # samples, in which the platform turns: |b| - F has noise as fast as that turns it


def behind_a_filter(rng: np.random.Generator, shape: tuple[int, ...], part: float) -> Array:
    """Noise of unit rms behind a Butterworth filter of fourth order with its corner at a part of all frequencies."""
    noise = sosfilt(butter(4, part, output="sos"), rng.standard_normal((2000 + shape[0], *shape[1:])), axis=0)[2000:]
    out: Array = noise / noise.std()
    return out


@pytest.mark.parametrize("seed", [1, 2])
def test_noise_behind_a_filter_is_noise(seed: int, tmp_path: Path) -> None:
    def added(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            raw = file["b_raw"]
            raw[...] = raw[:] + 0.2 * behind_a_filter(np.random.default_rng(seed), raw.shape, 0.15)

    told: dict[str, Any] = verdict_of(tmp_path, scenario(seed, instrument=QUIET), added, ["offset_drift", "warm_up"])
    assert told["adopted"] == [] and told["unexplained"]["present"] is False, told["unexplained"]["description"]
    assert "noise of a limited band, as behind a filter: up to 0.1" in told["unexplained"]["description"]
    assert told["noise_floor_nT"] == pytest.approx(0.2, rel=0.03)
    assert told["unexplained"]["excess_rms_nT"] < 0.1  # the rms of the band is known to some per cent


@pytest.mark.parametrize("sensors", [1, 4])
def test_the_band_is_told_by_the_highest_frequencies(sensors: int) -> None:
    rng = np.random.default_rng(3)
    shape = (SAMPLES, sensors, 3)
    passed = behind_a_filter(rng, shape, 0.15)
    band = limited_band(linear_state(synthetic(3, SAMPLES, sensors, 0.01, passed, SLOWLY)).residual)
    assert band is not None
    assert band.rms_nT == pytest.approx(1.0, rel=0.05)
    assert band.part == pytest.approx(0.15, abs=0.03) and band.slow < 1.0
    white = synthetic(4, SAMPLES, sensors, 1.0, None, SLOWLY)
    assert limited_band(linear_state(white).residual) is None
    for noise_nT in (0.001, 0.1, 1.0, 10.0):
        wanders = lfilter([1.0], [1.0, -0.999], rng.standard_normal(shape), axis=0)  # to 22 nT rms
        band = limited_band(linear_state(synthetic(5, SAMPLES, sensors, noise_nT, wanders, SLOWLY)).residual)
        assert band is None or band.slow > 5.0


@pytest.mark.parametrize("noise_nT", [0.01, 0.2])
def test_what_one_sensor_has_alone_is_no_noise_of_a_band(noise_nT: float) -> None:
    """As of a sensor that comes late to a field that turns: no faster than that. What the others are told by has it."""
    one = np.zeros((SAMPLES, 4, 3))
    one[:, 1] = behind_a_filter(np.random.default_rng(6), (SAMPLES, 3), 0.15)
    assert limited_band(linear_state(synthetic(6, SAMPLES, 4, noise_nT, one)).residual) is None
