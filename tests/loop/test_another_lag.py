"""Heat that reaches a sensor in two ways, through two thermal masses, beside one thermometer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import linear_state, looked_at, synthetic

from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.adopting import polished
from magtensor.loop.searching.another_lag import with_another_lag
from magtensor.registry import Registry

SAMPLES, STEPS = 600, 20  # of a second each, in so many steps


def behind(driven: np.ndarray, tau_s: float) -> np.ndarray:
    """tau x' + x = driven, from equilibrium, step by step."""
    out, x = np.empty_like(driven), driven[0]
    for i, value in enumerate(driven):
        x += (value - x) / (STEPS * tau_s)
        out[i] = x
    return out


def warmed(seed: int, course: str, along: bool = True) -> Record:
    """A rig whose temperature sways; three fifths of what heat adds come through 15 s and the rest through 200 s, or as
    something that warms up, or drifts, by itself."""
    rng = np.random.default_rng(100 + seed)
    time = np.arange(SAMPLES * STEPS) / STEPS
    waves = ((period, *rng.uniform(0.5, 1.0, 1), rng.uniform(0.0, 2.0 * np.pi)) for period in (55.0, 130.0, 280.0))
    temperature = 18.0 + 2.0 * sum(size * np.sin(2.0 * np.pi * time / period + phase) for period, size, phase in waves)
    quick = behind(temperature, 15.0)
    slow = {
        "heat": behind(temperature, 200.0),
        "warm_up": -6.0 * np.exp(-time / 150.0),
        "offset_drift": 6.0 * time / time[-1],
    }[course]
    vectors = rng.normal(scale=1.0, size=(4, 3))
    others = vectors if along else rng.normal(scale=1.0, size=(4, 3))
    added = 0.6 * quick[:, None, None] * vectors + 0.4 * slow[:, None, None] * others
    return replace(
        synthetic(seed, SAMPLES, noise_nT=0.2, turning_s=4.0, added=added[::STEPS]),
        logged={"temperature": temperature[::STEPS]}, origins={"temperature": np.zeros(())},
        units={"temperature": "degC"},
    )  # fmt: skip


def with_a_course(record: Record, name: str) -> State:
    """The fit with a response through one lag and a course of time, as a search comes to it."""
    registry, how = Registry.load(), Fitting()
    heat, course = (registry.find("error_model", each) for each in ("temperature_offset", name))
    settings = {"order": 1, "channel": "temperature", "lag_s": 15.0, "delayed": False, "at_start": 0.0, "bends": ()}
    of_time = {"warm_up": {"tau_s": 150.0}, "offset_drift": {"order": 1, "span_s": float(SAMPLES), "law": "time"}}
    response = looked_at(linear_state(record), Adopted(heat, settings)).model
    return polished(record, joint_state(record, [response, Adopted(course, of_time[name])], how), how)


@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.long), pytest.param(11, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", ["warm_up", "offset_drift"])
def test_a_second_lag_takes_the_place_of_a_course_of_time(seed: int, name: str) -> None:
    record = warmed(seed, "heat")
    found = with_another_lag(record, with_a_course(record, name), Fitting(), 0, 40, 0.005)
    assert found is not None
    after, step = found
    assert [a.name for a in after.state.adopted] == ["temperature_offset", "temperature_offset"]
    assert step.refused == {name: "temperature_offset with a second lag is likelier beside the others"}
    quick, slow = sorted(float(a.settings["lag_s"]) for a in after.state.adopted)
    assert quick == pytest.approx(15.0, abs=1.5)
    assert slow == pytest.approx(200.0, rel=0.15)


@pytest.mark.parametrize("seed", [4, pytest.param(5, marks=pytest.mark.long), pytest.param(6, marks=pytest.mark.long)])
@pytest.mark.parametrize("course", ["warm_up", "offset_drift"])
@pytest.mark.parametrize("along", [True, False])
def test_a_course_of_time_stays(seed: int, course: str, along: bool) -> None:
    """Whether it has the vectors of the response or its own."""
    record = warmed(seed, course, along)
    assert with_another_lag(record, with_a_course(record, course), Fitting(), 0, 40, 0.005) is None
