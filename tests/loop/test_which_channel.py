"""Which of two thermometers an effect follows, where they hardly differ and where they do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loop_cases import linear_state, loaded, scenario

from magtensor.loop.fitting.model import CHANNEL, Record, State
from magtensor.loop.searching.by_hand import candidate
from magtensor.loop.searching.gates import ALPHA, Candidate
from magtensor.loop.searching.rivals import by_a_worse_log
from magtensor.loop.searching.which_channel import nearest
from magtensor.registry import Registry

MODEL = "temperature_offset"
LOG_NOISE_DEGC = 0.01


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """Of a survey in which every sensor has a thermometer of its own."""
    folder: Path = tmp_path_factory.mktemp("thermometers")
    found = loaded(folder, scenario(12, {"type": MODEL, "rms_nT": 1.0}))
    noise = LOG_NOISE_DEGC * np.random.default_rng(2).standard_normal((len(found.time), len(found.sensors)))
    return replace(found, logged={**found.logged, "temperature": found.logged["temperature"][:, None] + noise})


def beside(record: Record, air: np.ndarray) -> State:
    """The linear fit of the survey, in which one more thermometer was logged."""
    return linear_state(
        replace(
            record,
            logged={**record.logged, "temperature_air": air - air.mean()},
            origins={**record.origins, "temperature_air": np.asarray(air.mean())},
            units={**record.units, "temperature_air": "degC"},
        )
    )


def following(channel: str, state: State) -> Candidate:
    component = Registry.load().find("error_model", MODEL)
    found = candidate(component, {"channel": channel}, state, 30, ALPHA)
    assert found.passes
    return replace(found, model=replace(found.model, component=component))  # its channel is open again


def test_the_sensors_own_is_taken_and_the_other_is_named(record: Record) -> None:
    state = beside(record, record.logged["temperature"].mean(axis=1))
    for channel in ("temperature", "temperature_air"):
        chosen, others = nearest(following(channel, state), state, 30)
        assert chosen.model.settings["channel"] == "temperature" and others == ("temperature_air",)
        assert chosen.passes and chosen.model.component.name == MODEL


def test_one_that_differs_is_no_other_log_of_it(record: Record) -> None:
    wander = np.cumsum(np.random.default_rng(3).standard_normal(len(record.time)))
    state = beside(record, record.logged["temperature"].mean(axis=1) + wander / wander.std())
    chosen, others = nearest(following("temperature", state), state, 30)
    assert chosen.model.settings["channel"] == "temperature" and not others


def test_what_follows_no_channel_stays_as_it_is(record: Record) -> None:
    state = linear_state(record)
    drift = candidate(Registry.load().find("error_model", "offset_drift"), {}, state, 30, ALPHA)
    assert nearest(drift, state, 30) == (drift, ())


def test_channels_are_compared_beside_one_fit(record: Record) -> None:
    """The candidate was judged at a fit of its own, which leaves half of what the common one does."""
    state = beside(record, record.logged["temperature"].mean(axis=1))
    left = state.residual
    assert left.across is not None and left.along is not None
    half = replace(state, residual=replace(left, across=0.5 * left.across, along=0.5 * left.along))
    chosen, others = nearest(replace(following("temperature", state), before=half), state, 30)
    assert chosen.model.settings["channel"] == "temperature" and others == ("temperature_air",)


def with_load(record: Record, noise_degC: float, another_course: float) -> State:
    """The linear fit of the survey with one thermometer, and a channel of another name that goes as it does."""
    one = record.logged["temperature"].mean(axis=1)
    rng = np.random.default_rng(4)
    wander = np.cumsum(rng.standard_normal(len(one)))
    other = one + noise_degC * rng.standard_normal(len(one)) + another_course * wander / wander.std()
    assert abs(np.corrcoef(one, other)[0, 1]) > 0.7
    return linear_state(
        replace(
            record,
            logged={**record.logged, "temperature": one, "load": other},
            origins={**record.origins, "temperature": np.asarray(0.0), "load": np.asarray(0.0)},
            units={**record.units, "load": "1"},
        )
    )


@pytest.mark.parametrize(("noise_degC", "another_course", "named"), [(0.3, 0.0, True), (0.02, 0.6, False)])
def test_a_channel_of_another_name_is_named_where_the_noise_of_its_log_is_all_that_it_is_behind_by(
    noise_degC: float, another_course: float, named: bool, record: Record
) -> None:
    state, anything = with_load(record, noise_degC, another_course), Registry.load().find("error_model", CHANNEL)
    chosen, others = nearest(following("temperature", state), state, 30, anything)
    assert chosen.model.settings["channel"] == "temperature"
    assert others == (("load",) if named else ())
    behind = candidate(anything, {"channel": "load", "power": 1}, state, 30, ALPHA)
    behind = replace(behind, model=replace(behind.model, component=anything))
    assert by_a_worse_log(chosen, [behind], state) == ({CHANNEL} if named else set())
    assert by_a_worse_log(chosen, [chosen], state) == set()
