"""What explained more while another effect had no name gives way to the simpler model that does as well beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from loop_cases import BASE, adopted_names, scenario, verdict_of

MODELS = ("site_gradient", "fixed_source", "nonlinearity_cubic")
LOGGED: dict[str, Any] = {"motion": BASE["motion"] | {"duration_s": 600.0}, "logging": {"attitude": True}}


@pytest.mark.long
def test_a_gradient_beside_a_nonlinearity_is_no_source_near_the_rig(tmp_path: Path) -> None:
    effects = ({"type": "site_gradient", "rms_nT": 0.5}, {"type": "nonlinearity_cubic", "rms_nT": 0.3})
    told = verdict_of(tmp_path, scenario(31, *effects, **LOGGED), models=MODELS)

    assert told["steps"][0]["adopted"] == "fixed_source"  # what this is about
    assert adopted_names(told) == {"site_gradient", "nonlinearity_cubic"}
    gradient = next(a for a in told["adopted"] if a["error_model"] == "site_gradient")
    assert gradient["indistinguishable_from"] == ["fixed_source"] and gradient["evidence"]["z"] > 5.0
    assert "fewer coefficients" in told["steps"][-2]["refused"]["fixed_source"]
    why = {r["error_model"]: r["why"] for r in told["rejected"]}["fixed_source"]
    assert "not significant" in why  # beside the gradient


@pytest.mark.long
def test_a_source_near_the_rig_beside_a_nonlinearity_stays(tmp_path: Path) -> None:
    effects = (
        {"type": "fixed_source", "rms_nT": 1.0, "position_m": [2.0, 0.5, 0.3]},
        {"type": "nonlinearity_cubic", "rms_nT": 0.3},
    )
    told = verdict_of(tmp_path, scenario(32, *effects, **LOGGED), models=MODELS)

    assert adopted_names(told) == {"fixed_source", "nonlinearity_cubic"}
