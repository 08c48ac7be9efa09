"""What is slow and far beyond what noise of a sensor has is no noise, though no model explains it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import scenario, verdict_of


@pytest.mark.parametrize(("nT", "told"), [(0.0, False), (8.0, True)])
def test_an_offset_that_moves_within_a_minute_is_told(tmp_path: Path, nT: float, told: bool) -> None:
    """It is no step, no drift, and of no course that is logged."""

    def moved(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            elapsed = file["time"][()] - file["time"][0]
            course = np.clip((elapsed - 500.0) / 60.0, 0.0, 1.0)
            file["b_raw"][:, 1] += nT * course[:, None] * np.array([1.0, -0.7, 0.5])

    found = verdict_of(tmp_path, scenario(71), moved, models=["offset_step", "temperature_offset", "offset_drift"])
    left = found["unexplained"]
    assert found["adopted"] == [] and left["present"] is told
    assert ("follows nothing that is logged" in left["description"]) is told
    assert not told or "mostly on S2" in left["description"]


def test_noise_of_the_base_station_is_nothing_that_moved(tmp_path: Path) -> None:
    """2 nT in each reading, where a sensor has 0.15."""

    def noisier(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            field = file["reference/total_field"]
            field[:] += 2.0 * np.random.default_rng(8).standard_normal(len(field))

    found = verdict_of(tmp_path, scenario(72), noisier, models=["offset_step", "temperature_offset", "offset_drift"])
    left = found["unexplained"]
    assert found["adopted"] == [] and not left["present"], left["description"]


def test_noise_that_goes_with_1_over_f_has_no_more_than_three_times_its_white_part() -> None:
    """Over the longest surveys, at all frequencies: the white part as second differences have it."""
    rng = np.random.default_rng(5)
    count = 2**20
    frequency = np.fft.rfftfreq(count)
    spectrum = rng.standard_normal(len(frequency)) + 1j * rng.standard_normal(len(frequency))
    spectrum[1:] /= np.sqrt(frequency[1:])
    spectrum[0] = 0.0
    noise = np.fft.irfft(spectrum, count)
    white = np.median(np.abs(np.diff(noise, 2))) * 1.4826 / np.sqrt(6.0)
    assert np.sqrt(np.mean(noise**2) / white**2 - 1.0) < 3.5
