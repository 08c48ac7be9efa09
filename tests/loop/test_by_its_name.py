"""A response to a channel that a model names is that model's, wherever its own search of settings ended."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import linear_state, looked_at, synthetic

from magtensor.loop.fitting.model import Adopted, Record, State
from magtensor.loop.searching.by_its_name import by_its_name
from magtensor.loop.searching.choosing import Choosing
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.keeping import UNEARNED
from magtensor.registry import Registry

SAMPLES = 1200
CHANNELS = {"current_heater": "A", "temperature": "degC"}


def record() -> Record:
    rng = np.random.default_rng(5)
    logged = {
        "current_heater": (np.cumsum(rng.uniform(size=SAMPLES) < 0.03) % 2).astype(float),
        "temperature": 20.0 + np.sin(np.arange(SAMPLES) / 150.0),
    }
    added = 4.0 * logged["current_heater"][:, None, None] * rng.standard_normal((4, 3))
    return replace(
        synthetic(6, SAMPLES, added=added), logged=logged, origins=dict.fromkeys(logged, 0.0), units=CHANNELS
    )


def state() -> State:
    return linear_state(record())


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
        looked(at, "channel_response", channel="current_heater", lag_s=0.6 * SAMPLES),
        current,
    ):
        assert by_its_name(chosen, [current], at) is chosen


def test_it_has_that_name_though_the_effect_was_refused_with_the_settings_it_had() -> None:
    at = state()
    lagging = looked(at, "current_field", channel="current_heater", lag_s=3.0)
    response = looked(at, "channel_response", channel="current_heater")
    left = Choosing(record(), at, [lagging, response], 2, lambda _: [], lambda _: "", None)
    left.fails(lagging, UNEARNED)
    assert left.best is response and left.refused == {"current_field": UNEARNED}
    proposal = left.proposed(response)
    assert proposal is not None and proposal.chosen.model.name == "current_field"
    assert proposal.chosen.model.settings["lag_s"] == 0.0 and "channel_response" in proposal.rivals
    assert not left.refused  # with these settings
    left.fails(proposal.chosen, UNEARNED)
    assert left.best is None and set(left.refused) == {"current_field"}  # nor the response by another name
