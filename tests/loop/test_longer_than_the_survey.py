"""A channel that is seen through a lag of more than half the survey may be any course of time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import BASE, linear_state, scenario, synthetic, verdict_of

from magtensor.error_models import first_order
from magtensor.loop.searching import rivals
from magtensor.loop.searching.by_hand import candidate
from magtensor.loop.searching.course_of_time import beside_time
from magtensor.loop.searching.gates import ALPHA
from magtensor.loop.searching.rivals import hardly_begun, simplest, still_settling
from magtensor.loop.searching.rounds import with_lines
from magtensor.loop.searching.screening import candidates_of
from magtensor.registry import Registry

SAMPLES = 600


def test_what_follows_another_channel_at_once_comes_first() -> None:
    """Scale factors that follow the humidity, beside a thermometer that shows the same through a lag of three surveys:
    the named cause is a rival, and no better known."""
    time = np.arange(SAMPLES, dtype=float)
    temperature = 2.0 * np.sin(time / 110.0) + 0.004 * time
    humidity = first_order.straight(time, temperature, 3.0 * SAMPLES)
    humidity = (humidity - humidity.mean()) / humidity.std()
    added = np.zeros((SAMPLES, 4, 3))
    bare = synthetic(5, SAMPLES, noise_nT=0.15, turning_s=4.0)
    added += 3e-5 * humidity[:, None, None] * bare.raw * np.array([1.0, -1.0, 1.0])
    logged = {"temperature": temperature - temperature.mean(), "rel_hum": humidity}
    record = replace(
        synthetic(5, SAMPLES, noise_nT=0.15, turning_s=4.0, added=added),
        logged=logged, units={"temperature": "degC", "rel_hum": "%"}, origins=dict.fromkeys(logged, np.zeros(1)),
    )  # fmt: skip
    state = with_lines(linear_state(record), record)
    registry = Registry.load()
    models = [registry.find("error_model", name) for name in ("temperature_scale", "channel_response")]
    found = {c.model.name: c for c in candidates_of(state, models, {}, ALPHA)}
    named, generic = found["temperature_scale"], found["channel_response"]
    assert hardly_begun(named.model, state.excitation) and generic.model.settings["channel"] == "rel_hum"
    for best in (named, generic):
        chosen, others = simplest(best, [named, generic], state)
        assert chosen is generic and others == ("temperature_scale",)


@pytest.mark.parametrize(("share", "drift"), [(0.8, True), (0.2, False)])
def test_what_settles_as_slowly_as_the_survey_lasts_is_a_drift(
    share: float, drift: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where nothing separates the two: applied elsewhere a warming up begins anew, and a drift goes on."""
    elapsed = np.arange(SAMPLES, dtype=float)
    added = 0.6 * np.exp(-elapsed / (share * SAMPLES))[:, None, None] * np.random.default_rng(4).standard_normal((4, 3))
    record = synthetic(6, SAMPLES, noise_nT=0.3, turning_s=4.0, added=added)
    state = with_lines(linear_state(record), record)
    registry = Registry.load()
    models = [registry.find("error_model", name) for name in ("warm_up", "offset_drift")]
    found = candidates_of(state, models, {}, ALPHA)
    settling = next(c for c in found if c.model.name == "warm_up")
    assert all(c.passes for c in found) and still_settling(settling.model, state.excitation) is drift
    monkeypatch.setattr(rivals, "separated", lambda *_: False)
    chosen, others = simplest(settling, found, state)
    assert {chosen.model.name, *others} == {"warm_up", "offset_drift"}
    assert chosen.model.name == ("offset_drift" if drift else "warm_up")


def test_a_channel_that_shows_nothing_beside_courses_of_time_is_a_drift_through_such_a_lag() -> None:
    """A thermometer that rose soon after the start, and offsets that drift: through a lag of four surveys what it shows
    is a straight line."""
    elapsed = np.arange(SAMPLES, dtype=float)
    vectors = 0.6 * np.random.default_rng(4).standard_normal((4, 3))
    temperature = 22.0 - 2.0 * np.exp(-elapsed / 10.0)
    added = (elapsed / SAMPLES)[:, None, None] * vectors
    record = replace(
        synthetic(6, SAMPLES, noise_nT=0.15, turning_s=4.0, added=added),
        logged={"temperature": temperature - temperature.mean()}, units={"temperature": "degC"},
        origins={"temperature": np.asarray(temperature.mean())},
    )  # fmt: skip
    state = with_lines(linear_state(record), record)
    model = Registry.load().find("error_model", "temperature_offset")
    settings = {"order": 1, "channel": "temperature", "lag_s": 4.0 * SAMPLES}
    slow = candidate(model, settings, state, 30, ALPHA)
    slow = replace(slow, model=replace(slow.model, component=model))  # its settings are open again
    assert slow.passes and hardly_begun(slow.model, state.excitation)
    told = beside_time(slow, state)
    assert not told.seen and "a drift like any other" in told.refused


@pytest.mark.long
def test_the_sum_of_a_current_over_time_is_no_lag(tmp_path: Path) -> None:
    """Iron that a current magnetises a little more each second: as a response that lags by many surveys, with a drift
    that takes off most of it again, it would go anywhere in another survey."""

    def summed(path: Path) -> None:
        with h5py.File(path, "a") as file:
            done = np.cumsum(file["current_heater"][:]) * np.median(np.diff(file["time"][:]))
            vectors = 0.004 * np.random.default_rng(8).standard_normal((4, 3))
            file["b_raw"][:] = file["b_raw"][:] + done[:, None, None] * vectors

    survey = scenario(23, motion=BASE["motion"] | {"duration_s": 600.0})
    told = verdict_of(tmp_path, survey, summed, ["offset_drift", "channel_response", "current_field"])
    assert all(a["settings"].get("lag_s", 0.0) < 600.0 for a in told["adopted"])
    assert "follows the sum of current_heater over time" in told["unexplained"]["description"]
