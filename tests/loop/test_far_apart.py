"""Two sensors that differ by more than a tenth of the field: by a temperature, or by nothing that is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from loop_cases import BASE, adopted_names, scenario, verdict_of

from magtensor.errors import DataError

PAIR: dict[str, Any] = {
    "instrument": BASE["instrument"] | {"array": {"positions_m": [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]}},
    "rate_Hz": 1.0,
}
WARMED = {"type": "temperature_offset", "rms_nT": 9000.0, "sensors": ["S2"], "channel": "temperature"}


@pytest.mark.long
def test_what_a_temperature_makes_of_it_is_found(tmp_path: Path) -> None:
    told = verdict_of(tmp_path, scenario(4, WARMED, **PAIR), models=["temperature_offset", "offset_drift"])
    assert adopted_names(told) == {"temperature_offset"}
    before, after = (told["error"]["held_out"][k]["total_field_rms_nT"] for k in ("before", "after"))
    assert before["S2"] > 5000.0
    assert after["S2"] < 0.02 * before["S2"]  # of the noise of the log
    assert after["S1"] < 2.0


def test_what_nothing_explains_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="sensors 1, 2 do not see the field"):
        verdict_of(tmp_path, scenario(4, WARMED, **PAIR), models=["eddy_current"])
