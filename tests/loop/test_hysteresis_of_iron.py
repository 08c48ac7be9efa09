"""Iron beside a sensor hangs behind the field along one axis and shows in all three; a sensor's own axes each by
themselves."""

from __future__ import annotations

from pathlib import Path

import pytest
from loop_cases import scenario, verdict_of

MEMORY = ["hysteresis", "viscous_magnetisation", "eddy_current", "latent_source", "cross_field", "sampling_lag"]


@pytest.mark.long
@pytest.mark.parametrize(("kind", "of_iron"), [("iron_hysteresis", True), ("hysteresis", False)])
def test_play_of_iron_and_of_an_axis_are_told_apart(tmp_path: Path, kind: str, of_iron: bool) -> None:
    """Beside the play of each axis, that of the other two would leave room for slow iron: it was adopted as well."""
    effect = {"type": kind, "rms_nT": 0.6, "half_width_nT": [8000.0]}
    told = verdict_of(tmp_path, scenario(71, effect), models=MEMORY)
    assert [a["error_model"] for a in told["adopted"]] == ["hysteresis"]
    assert told["adopted"][0]["settings"]["of_iron"] is of_iron
    assert told["adopted"][0]["settings"]["half_width_nT"] == pytest.approx(8000.0, rel=0.1)
    assert told["unexplained"]["present"] is False
