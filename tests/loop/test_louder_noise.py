"""Noise that is louder for a while is noise: no disturbance, no effect, and no reason to leave samples out."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from loop_cases import scenario, verdict_of

from magtensor.loop.evidence.stretches import louder_in

MODELS = ["offset_step", "passing_source", "eddy_current", "temperature_offset", "offset_drift", "scale_step"]


def test_louder_noise_is_kept_and_neither_a_spike_nor_what_passes_by() -> None:
    rng = np.random.default_rng(5)
    n = 4000
    values = rng.standard_normal((n, 9))
    values[2000:] *= 4.0
    values[500:503] += 20.0  # a spike
    values[1000:1200] += 8.0 * np.sin(np.pi * np.arange(200) / 200)[:, None]  # something passes
    square = np.sum(values**2, axis=1)
    found = louder_in(square < 45.0, [(9, values)])
    assert found[2000:].mean() > 0.99
    assert not found[500:503].any()
    assert not found[1050:1150].any()


def test_a_survey_whose_second_half_is_louder_is_calibrated_with_all_of_it(tmp_path: Path) -> None:
    def louder(path: Path) -> None:
        rng = np.random.default_rng(9)
        with h5py.File(path, "a") as file:
            raw = file["b_raw"][:]
            half = len(raw) // 2
            raw[half:] += rng.normal(0.0, 0.6, raw[half:].shape)
            file["b_raw"][:] = raw

    told = verdict_of(tmp_path, scenario(81), louder, MODELS)
    assert told["adopted"] == []
    assert "fit no calibration" not in told["unexplained"]["description"]
    # |b| - F of all samples: half of them with 0.15 nT of white noise, half with 0.62
    expected = np.sqrt((0.15**2 + 0.15**2 + 0.6**2) / 2)
    assert 0.9 < told["error"]["held_out"]["after"]["total_field_rms_nT"]["all"] / expected < 1.15
