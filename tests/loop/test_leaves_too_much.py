"""An effect on one sensor so large that a part of it, which its law misses, is more than the noise of the others: it is
not refused for what the fit makes of that on them."""

from __future__ import annotations

from pathlib import Path

import pytest
from loop_cases import BASE, linear_state, loaded, looked_at, scenario

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.trial import trial
from magtensor.loop.searching.keeping import fitted
from magtensor.registry import Registry

NONE = [1e-9, 1e-9, 1e-9]  # s


@pytest.mark.long
def test_filters_of_one_sensor_are_kept_though_their_rest_reaches_the_others(tmp_path: Path) -> None:
    """Axes with time constants of 20 to 80 ms, and a law of one: a tenth of their 800 nT stays."""
    quick = {"rate_Hz": 10.0, "motion": BASE["motion"] | {"duration_s": 200.0, "rate_rms_deg_s": 50.0}}
    slow = {"type": "bandwidth", "tau_s": [NONE, [0.08, 0.04, 0.02], NONE, NONE]}
    record, how = loaded(tmp_path, scenario(5, slow, **quick)), Fitting()
    before = trial(record, linear_state(record), how)
    filters = Adopted(Registry.load().find("error_model", "bandwidth"), {"tau_s": 0.05})
    found = fitted(record, before, looked_at(before.state, filters), how)
    assert found.after is not None and found.after.blocks is not None and before.blocks is not None
    assert before.hurt_by(found.after) == ["S1", "S3", "S4"]  # what this is about
    assert not found.why and found.after.state.adopted[0].sensors == ("S2",)
    assert found.after.blocks.rms()["S2"] < 0.1 * before.blocks.rms()["S2"]
