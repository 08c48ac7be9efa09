"""The deviations that are stated of a tensor hold the slow noise of the sensors beside the white one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from loop_cases import BASE, scenario, survey_file

import magtensor

CALM = BASE["motion"] | {"duration_s": 900.0}


@pytest.mark.parametrize(("flicker", "low", "high"), [(0.0, 0.9, 1.1), (0.08, 0.8, 1.25)])
def test_the_error_on_another_survey_is_what_is_stated(tmp_path: Path, flicker: float, low: float, high: float) -> None:
    instrument = BASE["instrument"] | {"noise": {"white_sd_nT": 0.15, "flicker_nT_per_rtHz": flicker}}
    first, second = (
        survey_file(tmp_path, scenario(seed, motion=CALM, instrument=instrument), f"{seed}.h5") for seed in (61, 62)
    )
    found = magtensor.close_loop(first, search=["nonlinearity_cubic"])
    assert found.verdict["adopted"] == []
    given = found.calibration.apply(second)
    error = np.sqrt(np.mean(given["calibrated/tensor"].to_numpy() ** 2))
    stated = np.sqrt(np.mean(given["calibrated/tensor_std"].to_numpy() ** 2))
    assert low < error / stated < high
