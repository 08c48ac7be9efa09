"""Surveys that were computed without noise, as a first try of the software may be."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
from loop_cases import BASE, adopted_names, scenario, verdict_of

INSTRUMENT = copy.deepcopy(BASE["instrument"]) | {"noise": {"white_sd_nT": 0.0}}
STATION = {"rate_Hz": 2.0, "noise_sd_nT": 0.0}
MOTION = BASE["motion"] | {"duration_s": 600.0}
MODELS = ["temperature_offset", "nonlinearity_quadratic", "offset_drift", "latent_source"]


@pytest.mark.parametrize(
    "effect",
    [None, *(pytest.param(n, marks=pytest.mark.long) for n in ("nonlinearity_quadratic", "temperature_offset"))],
)
def test_what_is_there_is_found_and_nothing_is_made_of_rounding(effect: str | None, tmp_path: Path) -> None:
    effects: list[dict[str, Any]] = [] if effect is None else [{"type": effect, "rms_nT": 5.0}]
    told = verdict_of(
        tmp_path, scenario(3, *effects, instrument=INSTRUMENT, base_station=STATION, motion=MOTION), models=MODELS
    )
    assert adopted_names(told) == ({effect} if effect else set())
    # what the base station misses between its readings, and the log of its thermometer, is all that is left
    assert told["error"]["held_out"]["after"]["total_field_rms_nT"]["all"] < 0.02
    assert "combinations_by_prior" not in told["calibration"]  # near nominal
