"""Two effects of one trend: each alone is fitted with the other's part in it, and predicts blocks worse than none."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loop_cases import BASE, loaded, scenario

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.trial import BlockErrors, Trial
from magtensor.loop.searching import adopting, rounds
from magtensor.loop.searching.keeping import UNEARNED, Fitted
from magtensor.loop.searching.search import search
from magtensor.registry import Registry

WARMS_UP = {
    "temperature": {
        "type": "temperature",
        "ambient_degC": 20.0,
        "self_heating_degC": 15.0,
        "tau_s": 150.0,
        "log_noise": 0.02,
    }
}


@pytest.mark.long
def test_an_offset_and_a_scale_that_follow_one_thermometer_are_found(tmp_path: Path) -> None:
    """`temperature_scale` alone earns no place on held-out blocks; with the offsets beside it does, and has no lag."""
    told: list[str] = []
    survey = scenario(
        2,
        {"type": "temperature_offset", "rms_nT": 1.5, "lag_s": 150.0},
        {"type": "temperature_scale", "rms_nT": 0.7},
        channels=WARMS_UP,
        motion=BASE["motion"] | {"duration_s": 600.0},
    )
    names = ("temperature_offset", "temperature_scale", "offset_drift", "scale_drift", "channel_response")
    models = [Registry.load().find("error_model", name) for name in names]
    found = search(loaded(tmp_path, survey), models, Fitting(), say=told.append)
    lags = {a.name: a.settings["lag_s"] for a in found.last.adopted}
    assert set(lags) == {"temperature_offset", "temperature_scale"}
    assert lags["temperature_offset"] == pytest.approx(150.0, abs=5.0) and lags["temperature_scale"] == 0.0
    assert [s.adopted.model.name for s in found.steps if s.adopted] == ["temperature_scale", "temperature_offset"]
    assert found.last.residual.square() < 1.3


@pytest.mark.parametrize("lag_s", [0.0, 90.0])
def test_a_lag_that_nothing_asks_for_is_given_up(lag_s: float, tmp_path: Path) -> None:
    """A model with the lag that it has, and with one that it has not, both a little off."""
    effect = {"type": "temperature_offset", "rms_nT": 0.6, "lag_s": lag_s}
    record = loaded(tmp_path, scenario(3, effect, rate_Hz=1.0))
    model = Registry.load().find("error_model", "temperature_offset")
    settings = {"channel": "temperature", "order": 1, "lag_s": lag_s or 4.0, "delayed": False, "at_start": 0.0}
    state = joint_state(record, [Adopted(model, settings)], Fitting())
    found = adopting._with_lags_that_show(record, state, Fitting())
    assert found.adopted[0].settings["lag_s"] == lag_s


@pytest.mark.parametrize(
    ("effect", "setting", "others", "abs_s"),
    [
        (
            {"type": "temperature_offset", "rms_nT": 1.5, "lag_s": 60.0},
            "lag_s",
            {"channel": "temperature", "order": 1, "delayed": False, "at_start": 0.0},
            10.0,
        ),
        ({"type": "eddy_current", "rms_nT": 5.0, "tau_s": 0.02}, "tau_s", {}, 0.003),
    ],
)
def test_a_lag_that_shows_only_now_is_taken(
    effect: dict[str, Any], setting: str, others: dict[str, Any], abs_s: float, tmp_path: Path
) -> None:
    """A model that was adopted without its lag, while others hid it: one between two of the grid, and one below all."""
    record = loaded(tmp_path, scenario(3, effect, rate_Hz=4.0))
    model = Registry.load().find("error_model", effect["type"])
    state = joint_state(record, [Adopted(model, {**others, setting: 0.0})], Fitting())
    found = adopting.polished(record, state, Fitting())
    assert found.adopted[0].settings[setting] == pytest.approx(effect[setting], abs=abs_s)


@pytest.mark.parametrize(
    ("after", "objection", "kept"),
    [
        ({"S1": 0.4, "S2": 0.5}, "", True),
        ({"S1": 1.02, "S2": 0.5}, "", False),  # hurt alone, and not helped by both
        ({"S1": 0.4, "S2": 1.3}, "", False),  # the second hurts another
        ({"S1": 0.4, "S2": 0.5}, "fitted, it would have to be of all alike", False),
    ],
)
def test_what_fails_alone_is_kept_if_both_help(
    after: dict[str, float], objection: str, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second is found beside the first, and both together have to help the sensors that the first alone hurt."""
    folds = np.arange(3)

    def standing(error: dict[str, float], adopted: int) -> Trial:
        fit = SimpleNamespace(keep=np.ones(3, dtype=bool))
        state: Any = SimpleNamespace(adopted=(None,) * adopted, excitation=None, fit=fit)
        squares = np.array([list(error.values())] * 2) ** 2
        return Trial(state, BlockErrors(tuple(error), np.ones((2, 2), dtype=int), squares, squares), folds)

    before, alone = standing({"S1": 1.0, "S2": 1.0}, 0), standing({"S1": 1.2, "S2": 0.9}, 1)
    first: Any = SimpleNamespace(model=SimpleNamespace(name="temperature_scale"), passes=True)
    second: Any = SimpleNamespace(model=SimpleNamespace(name="temperature_offset"), passes=True)
    given: Any = None
    monkeypatch.setattr(rounds, "with_lines", lambda state, *_: state)
    monkeypatch.setattr(rounds, "testable", lambda *_: [])
    monkeypatch.setattr(rounds, "why_not", lambda *_: objection)
    monkeypatch.setattr(rounds.Rounds, "candidates", lambda *_: [second])
    asked: list[bool] = []

    def first_kept(self: Any, record: Any, state: Any, found: Any, how: Any, models: int, **others: Any) -> Any:
        asked.append(others["with_others"])
        return rounds.Kept(standing(after, 2), second)

    monkeypatch.setattr(rounds.Rounds, "first_kept", first_kept)
    looking = rounds.Rounds([], 0, 8, 0.005, None, None)
    hurt = Fitted(alone, "fitted, it raises the held-out error of S1", ("S1",))
    both = looking.with_another(given, before, first, hurt, given)
    assert looking.with_another(given, before, first, hurt, given) is None
    assert asked == [False]  # no third one is looked for, nor the second once more
    assert (both is not None) == kept
    if both is not None:
        assert both.standing is not None and both.standing.blocks is not None
        assert both.standing.blocks.rms() == after
        assert both.chosen is first and [step.adopted for step in both.then] == [second]
    # with no room for two nothing is tried
    assert rounds.Rounds([], 0, 1, 0.005, None, None).with_another(given, before, first, hurt, given) is None
    assert looking.with_another(given, before, first, Fitted(None, UNEARNED), given) is None
