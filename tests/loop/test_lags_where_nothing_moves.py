"""A lag is tried where its channel changes within the runs of a survey, elsewhere it is a mean over the log's noise; a
play where it is taken up, elsewhere it is a scale factor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import BASE, linear_state, loaded, scenario, synthetic

from magtensor.error_models.settings import profiled
from magtensor.registry import Registry

MOTIONS: dict[str, dict[str, Any]] = {
    "postures": {"type": "postures", "random_count": 60, "rest_s": 10.0, "turn_s": 5.0, "average": False},
    "tumbling": BASE["motion"],
    "tilts": {"type": "limited_tilt", "duration_s": 1200.0, "tilt_deg": 40.0},
}


@pytest.mark.parametrize(("motion", "still"), [("postures", True), ("tumbling", False), ("tilts", False)])
@pytest.mark.parametrize("seed", [95, 96, 97])
def test_a_frame_that_stands_still_has_no_lag(motion: str, still: bool, seed: int, tmp_path: Path) -> None:
    logging = {"acceleration": True, "acceleration_noise_m_s2": 0.05}
    record = loaded(tmp_path, scenario(seed, motion=MOTIONS[motion], logging=logging))
    x = linear_state(record).excitation
    lags = profiled(Registry.load().find("error_model", "frame_flexure"))["lag_s"].values(x)
    assert (lags == [0.0]) is still


@pytest.mark.parametrize("swing_nT", [20.0, 2000.0, 2e4])
def test_a_play_that_is_never_taken_up_is_not_tried(swing_nT: float) -> None:
    """Outputs that go so far up and down; half widths from 300 to 30 000 nT, each 2.5 times the one before."""
    x = linear_state(synthetic(98)).excitation
    swings = swing_nT * np.sin(np.arange(len(x.time)) / 50.0)
    x = replace(x, output=np.broadcast_to(2e4 + swings[:, None, None], x.output.shape))
    tried = profiled(Registry.load().find("error_model", "hysteresis"))["half_width_nT"].values(x)
    assert tried == [w for w in np.geomspace(300.0, 30000.0, 6).tolist() if w < swing_nT]
