"""A sensor that turns in its mount: with the temperature, slowly with time, or at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import scenario, synthetic, verdict_of
from test_changing_matrix import warmth, with_channels

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.registry import Registry

MODELS = [
    "temperature_alignment",
    "alignment_drift",
    "turn_step",
    "temperature_scale",
    "scale_drift",
    "frame_flexure",
    "channel_response",
]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "true", "sensors"),
    [
        ("temperature_alignment", {"lag_s": 60.0}, ["S1", "S2", "S3", "S4"]),
        ("temperature_alignment", {"lag_s": 60.0}, ["S3"]),
        ("alignment_drift", {"tau_s": 600.0}, ["S2"]),
        ("turn_step", {"time_s": 500.0}, ["S2"]),
    ],
)
def test_each_is_told_from_the_others(name: str, true: dict[str, Any], sensors: list[str], tmp_path: Path) -> None:
    effect = {"type": name, "rms_nT": 1.0, "sensors": sensors} | true
    told = verdict_of(tmp_path, scenario(12, effect), models=MODELS)
    (adopted,) = told["adopted"]
    assert adopted["error_model"] == name and adopted["sensors"] == sensors
    for setting, value in true.items():
        assert adopted["settings"][setting] == pytest.approx(value, rel=0.2)
    assert adopted["settings"].get("angles", 3) == 3
    assert not told["unexplained"]["present"], told["unexplained"]["description"]


@pytest.mark.parametrize(("apart", "seen"), [(0.01, False), (0.3, True)])
def test_thermometers_that_differ_by_a_hundredth_say_nothing_of_a_turn_of_all(apart: float, seen: bool) -> None:
    """What turns both sensors alike is seen only in the difference of their thermometers, as if by a lens: what else
    differs between the sensors by some nT would be a turn of both by minutes of arc."""
    rng = np.random.default_rng(8)
    common, own = warmth(rng, 1200), warmth(rng, 1200)
    added = np.zeros((1200, 2, 3))
    added[:, 0] = 3.0 * own[:, None]  # what nobody has named yet
    warm = np.column_stack([common, (1.0 - apart) * common + apart * own])
    record = with_channels(synthetic(8, sensors=2, added=added), temperature=warm)
    model = Adopted(Registry.load().find("error_model", "temperature_alignment"), {"channel": "temperature"})
    state = joint_state(record, [model], Fitting())
    assert state.estimate is not None
    assert state.estimate.rank == (6 if seen else 3)
    first, second = state.theta[0].reshape(3, 2).T
    assert (np.abs(first + second).max() < 0.02 * np.abs(first - second).max()) is not seen
