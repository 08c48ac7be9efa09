"""A response to a channel that a model names is that model's, wherever its own search of settings ended."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import linear_state, looked_at, synthetic

from magtensor.loop.fitting.model import Adopted, State
from magtensor.loop.searching.by_its_name import by_its_name
from magtensor.loop.searching.gates import Candidate
from magtensor.registry import Registry

SAMPLES = 1200
CHANNELS = {"current_heater": "A", "temperature": "degC"}


def state() -> State:
    rng = np.random.default_rng(5)
    logged = {
        "current_heater": (np.cumsum(rng.uniform(size=SAMPLES) < 0.03) % 2).astype(float),
        "temperature": 20.0 + np.sin(np.arange(SAMPLES) / 150.0),
    }
    added = 4.0 * logged["current_heater"][:, None, None] * rng.standard_normal((4, 3))
    record = synthetic(6, SAMPLES, added=added)
    return linear_state(replace(record, logged=logged, origins=dict.fromkeys(logged, 0.0), units=CHANNELS))


def looked(at: State, name: str, **settings: object) -> Candidate:
    component = Registry.load().find("error_model", name)
    plain = {setting: p.default for setting, p in component.parameters.items()}
    return looked_at(at, Adopted(component, plain | settings))


@pytest.mark.parametrize(
    ("channel", "form", "other", "settings"),
    [
        ("current_heater", {}, "current_field", {"lag_s": 3.0}),
        ("temperature", {}, "temperature_offset", {"lag_s": 40.0}),
        ("temperature", {"times_field": True}, "temperature_scale", {"lag_s": 40.0}),
    ],
)
def test_it_has_the_name_of_the_effect_that_is_the_same(
    channel: str, form: dict[str, bool], other: str, settings: dict[str, float]
) -> None:
    at = state()
    chosen = looked(at, "channel_response", channel=channel, **form)
    elsewhere = looked(at, other, channel=channel, **settings)
    found = by_its_name(chosen, [elsewhere], at)
    assert (found.model.name, found.model.settings["lag_s"]) == (other, 0.0)
    x = at.excitation
    moved = [c.model.terms(x).series - c.model.terms(x).series.mean(axis=0) for c in (found, chosen)]
    np.testing.assert_allclose(*moved, atol=1e-5)


def test_another_law_or_channel_stays_what_it_is() -> None:
    at = state()
    current = looked(at, "current_field", channel="current_heater")
    for chosen in (
        looked(at, "channel_response", channel="current_heater", times_field=True),
        looked(at, "channel_response", channel="temperature"),
        looked(at, "channel_rate", channel="current_heater"),
        current,
    ):
        assert by_its_name(chosen, [current], at) is chosen
