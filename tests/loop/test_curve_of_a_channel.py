"""Of a law of a channel that no model has, what a model leaves is no event, and not the law of another channel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from loop_cases import linear_state, synthetic
from numpy.typing import NDArray

from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.remainder.curve_of_a_channel import another_curve, event_of_a_curve
from magtensor.loop.searching import by_hand
from magtensor.loop.searching.gates import ALPHA, Candidate
from magtensor.registry import Registry

Array = NDArray[np.float64]
SAMPLES = 1800


def course(seed: int, period_s: float = 400.0) -> Array:
    """A slow channel, between -1 and 1."""
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 3)
    time = np.arange(SAMPLES)
    waves = [np.sin(2.0 * np.pi * time * f / period_s + p) for f, p in zip((0.7, 1.0, 1.6), phases, strict=True)]
    out: Array = np.sum(waves, axis=0) / 3.0
    return out


def logged(seed: int, added: Array, **channels: Array) -> Record:
    """A survey in which a series (N,) is added to each output in its own proportion, with logged channels."""
    share = np.random.default_rng(seed).uniform(0.5, 2.0, (4, 3))
    record = synthetic(seed, SAMPLES, added=added[:, None, None] * share)
    return replace(record, logged=channels, units=dict.fromkeys(channels, "1"), origins=dict.fromkeys(channels, 0.0))


def found(state: State, name: str, **settings: object) -> Candidate:
    return by_hand.candidate(Registry.load().find("error_model", name), settings, state, 30, ALPHA)


def beside_a_line(record: Record, channel: str) -> State:
    """The fit with what is in proportion to a channel."""
    model = Registry.load().find("error_model", "channel_response")
    return joint_state(record, [Adopted(model, {"channel": channel, "power": 1})], Fitting())


def events_of(state: State, name: str) -> tuple[Candidate, str]:
    event = found(state, name)
    theta = event.assessment.theta[-event.terms.count :]
    return event, event_of_a_curve(state, event.terms, theta, event.assessment.colours)


LAWS: dict[str, Callable[[Array], Array]] = {
    "dead zone": lambda v: np.sign(v) * np.maximum(np.abs(v) - 0.3, 0.0),
    "root": lambda v: np.sign(v) * np.sqrt(np.abs(v)),
    "square with a sign": lambda v: v * np.abs(v),
}


@pytest.mark.parametrize("law", ["dead zone", *(pytest.param(law, marks=pytest.mark.long) for law in list(LAWS)[1:])])
def test_what_a_line_leaves_of_another_law_is_no_event(law: str) -> None:
    """The best stretch of what is left is that of a curve of the channel."""
    values = course(3)
    state = beside_a_line(logged(5, 12.0 * LAWS[law](values), wind=values), "wind")
    event, channel = events_of(state, "offset_while")
    assert event.assessment.gain.total > 50.0  # it would be adopted for an event
    assert channel == "wind"


@pytest.mark.long
@pytest.mark.parametrize("size", [0.4, 1.5])
def test_an_event_is_no_curve_of_a_channel(size: float) -> None:
    """An offset for a while beside what is in proportion to a channel, weak and strong."""
    values = course(4)
    time = np.arange(SAMPLES)
    while_ = size * ((time > 700) & (time < 1100))
    state = beside_a_line(logged(6, 3.0 * values + while_, wind=values), "wind")
    event, channel = events_of(state, "offset_while")
    assert event.assessment.gain.total > 20.0
    assert channel == ""
    assert events_of(linear_state(logged(6, while_, wind=values)), "offset_while")[1] == ""  # nothing follows it


@pytest.mark.parametrize("law", ["dead zone", *(pytest.param(law, marks=pytest.mark.long) for law in list(LAWS)[1:])])
def test_the_law_of_one_channel_is_not_that_of_another(law: str) -> None:
    """A channel that nearly goes with the one whose law it is."""
    wind = course(7)
    rain = 0.85 * wind + 0.4 * course(8)
    assert np.corrcoef(wind, rain)[0, 1] > 0.8
    state = linear_state(logged(9, 6.0 * LAWS[law](wind), wind=wind, rain=rain))
    for name, other in (("rain", "wind"), ("wind", "")):
        one = found(state, "channel_response", channel=name, power=1, times_field=False)
        theta = one.assessment.theta[-one.terms.count :]
        model = Adopted(Registry.load().find("error_model", "channel_response"), one.model.settings)
        assert another_curve(state, model, one.terms, theta, one.assessment.colours) == other


def test_what_follows_a_vector_has_no_curve_to_be_compared_with() -> None:
    """An acceleration that acts through one of its components, beside a channel that goes with it."""
    wind = course(7)
    record = logged(9, 6.0 * wind, wind=wind)
    shaken = np.column_stack([wind, *0.01 * np.random.default_rng(2).standard_normal((2, SAMPLES))])
    record = replace(record, logged={**record.logged, "acceleration": shaken}, units={"wind": "1", "acceleration": "1"})
    record = replace(record, origins={"wind": np.zeros(()), "acceleration": np.zeros(3)})
    state = linear_state(record)
    one = found(state, "channel_response", channel="acceleration", power=1, times_field=False)
    model = Adopted(Registry.load().find("error_model", "channel_response"), one.model.settings)
    theta = one.assessment.theta[-one.terms.count :]
    assert another_curve(state, model, one.terms, theta, one.assessment.colours) == ""
