"""A gain that wanders has its largest step and a trend, and neither is an effect; one that steps or drifts has."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loop_cases import synthetic
from numpy.typing import NDArray

from magtensor.loop.fitting.model import Adopted, Fitting, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.search import search
from magtensor.loop.searching.wandering_gain import of_a_wandering_gain
from magtensor.registry import Registry

Array = NDArray[np.float64]
SAMPLES = 1500
MODELS = ("offset_drift", "scale_drift", "offset_step", "scale_step", "turn_step")


def gained(seed: int, change_nT: Array) -> Any:
    """A survey in which the gain of the first sensor changes by so much (N,) of 50 000 nT."""
    record = synthetic(seed, SAMPLES)
    raw = record.raw.copy()
    raw[:, 0] *= 1.0 + change_nT[:, None] / 50_000.0
    return replace(record, raw=raw)


def walk(seed: int) -> Array:
    """Within some nT, of which a step explains the most."""
    out: Array = 0.12 * np.cumsum(np.random.default_rng(seed + 5000).standard_normal(SAMPLES))
    return out


def adopted(record: Any) -> list[str]:
    registry = Registry.load()
    found = search(record, [registry.find("error_model", name) for name in MODELS], Fitting())
    return [a.name for a in found.last.adopted]


@pytest.mark.parametrize("seed", [5, *(pytest.param(seed, marks=pytest.mark.long) for seed in (8, 17))])
def test_a_walk_has_no_step(seed: int) -> None:
    assert adopted(gained(seed, walk(seed))) == []


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.long)])
def test_a_step_stays_one(seed: int) -> None:
    assert adopted(gained(seed, 2.0 * (np.arange(SAMPLES) > 700))) == ["scale_step"]


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.long)])
def test_a_drift_stays_one(seed: int) -> None:
    assert adopted(gained(seed, 4.0 * np.arange(SAMPLES) / SAMPLES)) == ["scale_drift"]


def with_a_step(change_nT: Array) -> State:
    model = Registry.load().find("error_model", "scale_step")
    return joint_state(gained(6, change_nT), [Adopted(model, {"time_s": 700.5}, ("S1",))], Fitting())


def test_by_how_much_it_wanders_beside_a_step() -> None:
    """By a third of the step is too much, by a tenth is not; of one sensor nobody knows."""
    step, slow = 6.0 * (np.arange(SAMPLES) > 700), np.sin(np.arange(SAMPLES) / 40.0)
    places, why = of_a_wandering_gain(with_a_step(step + 2.0 * slow), 0) or ([], "")
    assert places == [0] and "whose gain wanders by" in why
    assert of_a_wandering_gain(with_a_step(step + 0.4 * slow), 0) is None
    assert of_a_wandering_gain(with_a_step(step + 2.0 * slow), 1) is None  # it was declared
    state = with_a_step(step + 2.0 * slow)
    alone: Any = SimpleNamespace(residual=SimpleNamespace(across=None), excitation=state.excitation, adopted=())
    assert of_a_wandering_gain(alone, 0) is None


def test_a_slip_of_the_samples_is_no_gain() -> None:
    """What it adds is no series of its own, to first order: it is not asked."""
    record = synthetic(6, SAMPLES, turning_s=8.0)
    raw = record.raw.copy()
    raw[701:, 0] = record.raw[700:-1, 0]
    raw[:, 0] *= 1.0 + 4e-5 * np.sin(np.arange(SAMPLES) / 40.0)[:, None]
    model = Registry.load().find("error_model", "lag_step")
    slip = Adopted(model, {"time_s": 700.5, "span_s": SAMPLES - 1.0}, ("S1",))
    state = joint_state(replace(record, raw=raw), [slip], Fitting())
    assert state.theta[0][0] == pytest.approx(1.0, abs=0.05)
    assert of_a_wandering_gain(state, 0) is None
