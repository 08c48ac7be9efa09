"""A lag is tried where its channel changes within the runs of a survey; elsewhere it is a mean over the log's noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from loop_cases import BASE, linear_state, loaded, scenario

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
