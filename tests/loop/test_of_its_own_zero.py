"""Powers of a channel are about the zero that it has of its own; sensors without a part are left out in the end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, synthetic

from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.record import origin
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.on_fewer_sensors import on_those_that_show
from magtensor.loop.searching.outcome import judgement
from magtensor.loop.searching.rounds import with_lines
from magtensor.loop.searching.screening import candidates_of
from magtensor.loop.searching.search import search
from magtensor.registry import Registry

SAMPLES = 1500
REGISTRY = Registry.load()


@pytest.mark.parametrize(
    ("values", "units", "expected"),
    [
        ([0.5, 1.5], "A", 0.0),  # heat goes with the square of a current, not with that of its excess
        ([-1.0, 2.0], "V", 0.0),
        ([11.0, 13.0], "V", 12.0),
        ([-5.0, 15.0], "degC", 5.0),
        ([-5.0, 15.0], "nobody's unit", 0.0),
        ([[1.0, -1.0], [3.0, 2.0]], "m s-2", [2.0, 0.0]),
    ],
)
def test_where_a_channel_is_zero(values: list[float], units: str, expected: float | list[float]) -> None:
    np.testing.assert_array_equal(origin(np.array(values), units), expected)


def logging(record: Record, **channels: Array) -> Record:
    """The record with currents in A."""
    origins = {name: origin(values, "A") for name, values in channels.items()}
    logged = {name: values - origins[name] for name, values in channels.items()}
    return replace(record, logged=logged, origins=origins, units=dict.fromkeys(channels, "A"))


def held(seed: int, levels: list[float], times: int = 25) -> Array:
    """A current that holds each of some levels for a while."""
    out: Array = np.random.default_rng(seed).choice(levels, SAMPLES // times).repeat(times)
    return out


def test_the_square_of_a_current_needs_no_current_beside_it() -> None:
    """Its mean is not zero, and about the mean the square would be half a current."""
    current = held(2, [-2.0, -1.0, 0.0, 1.0, 2.0, 2.0, 3.0])
    per_A2 = np.random.default_rng(3).standard_normal((4, 3))
    added = 0.15 * (current**2)[:, None, None] * per_A2
    record = logging(synthetic(4, SAMPLES, turning_s=4.0, noise_nT=0.15, added=added), current_motor=current)
    models = [REGISTRY.find("error_model", name) for name in ("current_field", "channel_response")]
    found = search(record, models, Fitting()).last
    assert [(a.name, a.settings["power"]) for a in found.adopted] == [("channel_response", 2)]
    std = np.sqrt(np.diag(found.estimate.covariance)) if found.estimate is not None else np.full(12, np.nan)
    assert np.all(np.abs(found.theta[0] - 0.15 * per_A2.ravel()) < 5.0 * std)


def test_each_effect_ends_on_the_sensors_that_have_it() -> None:
    """Both were adopted on all sensors; one is of S1, the other of S3 and S4."""
    a, b = held(5, [0.0, 1.0]), held(6, [0.0, 1.0], 30)
    added = np.zeros((SAMPLES, 4, 3))
    added[:, 0] += a[:, None] * [1.0, -0.5, 0.8]
    added[:, 2:] += b[:, None, None] * [0.6, 0.9, -0.7]
    record = logging(synthetic(7, SAMPLES, turning_s=4.0, noise_nT=0.15, added=added), current_a=a, current_b=b)
    model = REGISTRY.find("error_model", "current_field")
    both = [Adopted(model, {"channel": name}) for name in ("current_a", "current_b")]
    state = joint_state(record, both, Fitting())
    assert [m.sensors for m in state.adopted] == [(), ()]
    after = on_those_that_show(record, state, Fitting(), 0)
    assert [m.sensors for m in after.adopted] == [("S1",), ("S3", "S4")]
    assert after.residual.square() < 1.01 * state.residual.square()
    fixed = on_those_that_show(record, state, Fitting(), 1)
    assert fixed.adopted[0].sensors == ()  # what a recipe declared stays as it is


def test_the_times_of_what_lasted_a_while_are_told_in_their_order() -> None:
    added = np.zeros((SAMPLES, 4, 3))
    added[500:900, 1] = [1.0, -2.0, 1.5]
    record = synthetic(8, SAMPLES, turning_s=4.0, noise_nT=0.15, added=added)
    state = with_lines(joint_state(record, [], Fitting()), record)
    (found,) = candidates_of(state, [REGISTRY.find("error_model", "offset_while")], {}, 0.005)
    first, last = found.model.settings["time_s"], found.model.settings["until_s"]
    for times in ((first, last), (last, first)):
        model = replace(found.model, settings=dict(zip(("time_s", "until_s"), times, strict=True)))
        told = judgement(replace(found, model=model))["settings"]
        assert told["time_s"] == pytest.approx(500, abs=2) and told["until_s"] == pytest.approx(900, abs=2)
