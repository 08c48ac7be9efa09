"""The study that puts effects into measured recordings: what it puts in, and how it judges."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

import injected

TIME = 0.5 * np.arange(600.0)
TURNED = np.column_stack([np.cos(TIME / 7.0), np.sin(TIME / 7.0), np.sin(TIME / 11.0)])
RAW = np.repeat(30_000.0 * TURNED[:, None], 2, axis=1)
VALUES = {"b_raw": RAW, "temperature": 20.0 + np.sin(TIME / 40.0)}
SURVEY: Any = SimpleNamespace(time=TIME, values=VALUES.__getitem__, good=np.ones(600, dtype=bool), sensors=["A", "B"])
PUT = injected.Put(np.zeros((600, 2, 3)), (0,), np.array([1.0, 2.0, 2.0]), {})


def test_a_body_follows_as_its_heat_capacity_says() -> None:
    time = np.linspace(0.0, 200.0, 2001)
    outside = 20.0 + 3.0 * np.sin(time / 25.0)
    solved = solve_ivp(
        lambda t, y: (20.0 + 3.0 * np.sin(t / 25.0) - y) / 60.0, (0.0, 200.0), [20.0], t_eval=time, rtol=1e-8
    )
    assert np.max(np.abs(injected.followed(time, outside, 60.0) - solved.y[0])) < 0.01


@pytest.mark.parametrize("effect", sorted({e for effects in injected.EFFECTS.values() for e in effects}))
def test_what_is_put_in_has_its_size_on_its_sensors(effect: str) -> None:
    put = injected.put_into(SURVEY, effect, 7.0)
    every = put.added[:, list(put.sensors)]
    within = every - every.mean(axis=0)
    assert np.sqrt(np.mean(within**2)) == pytest.approx(7.0, rel=0.02)
    others = [s for s in range(2) if s not in put.sensors]
    assert not put.added[:, others].any()
    assert ("current_heater" in put.channels) is (effect == "current_field")


def test_samples_that_come_late_are_those_of_before() -> None:
    put = injected.put_into(SURVEY, "sampling_lag", 200.0)
    (late,) = put.coefficients
    assert 0.0 < late < 0.5
    before = 30_000.0 * np.cos((TIME[5:] - late) / 7.0)
    assert np.max(np.abs((RAW + put.added)[5:, 0, 0] - before)) < 25.0  # nT: read along straight lines


def verdict(*adopted: dict[str, Any], looks_like: tuple[str, ...] = (), excess: float = 0.0) -> dict[str, Any]:
    left = {"present": excess > 0.0, "excess_rms_nT": excess, "looks_like": list(looks_like)}
    return {"adopted": list(adopted), "unexplained": left}


def effect(name: str, *values: float, rivals: tuple[str, ...] = (), **settings: Any) -> dict[str, Any]:
    coefficients = [{"sensor": "A", "value": v} for v in values]
    return {
        "error_model": name, "settings": settings, "sensors": ["A"], "indistinguishable_from": list(rivals),
        "coefficients": coefficients,
    }  # fmt: skip


STEP = effect("offset_step", 1.0, 2.0, 2.3)


@pytest.mark.parametrize(("before", "now", "outcome", "beside"), [
    (verdict(), verdict(STEP), "right", []),
    (verdict(), verdict(effect("warm_up"), STEP), "right", ["warm_up"]),
    (verdict(effect("warm_up")), verdict(effect("warm_up"), STEP), "right", []),
    (verdict(), verdict(effect("scale_step", rivals=("offset_step",))), "rival", []),
    (verdict(), verdict(effect("scale_step")), "wrong", ["scale_step"]),
    (verdict(), verdict(looks_like=("offset_step",), excess=1.0), "told", []),
    (verdict(excess=1.0), verdict(excess=1.5), "told", []),
    (verdict(excess=1.0), verdict(excess=1.05), "missed", []),
    (verdict(STEP), verdict(effect("offset_step", 0.1, 0.2, 0.1)), "missed", []),  # the recording's own
])  # fmt: skip
def test_an_outcome_is_judged_beside_what_there_was(
    before: dict[str, Any], now: dict[str, Any], outcome: str, beside: list[str]
) -> None:
    found = injected.judged("offset_step", ["A"], PUT, before, now)
    assert found["outcome"] == outcome and found["beside"] == beside
    if outcome == "right":
        assert found["off"] == pytest.approx(0.1)


def test_a_channel_that_was_put_in_has_to_be_the_one_that_is_found() -> None:
    put = PUT._replace(channels={"current_heater": (TIME, "A")})
    mine, other = (effect("current_field", 1.0, 2.0, 2.0, channel=c) for c in ("current_heater", "current_battery"))
    before = verdict(other)
    assert injected.judged("current_field", ["A"], put, before, verdict(other))["outcome"] == "missed"
    assert injected.judged("current_field", ["A"], put, before, verdict(other, mine))["outcome"] == "right"
