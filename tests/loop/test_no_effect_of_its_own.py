"""What is more of an adopted effect, one of many switchings, or a part of a source is no effect of its own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import BASE, Array, adopted_names, linear_state, loaded, scenario, synthetic, verdict_of

from magtensor.loop.fitting.errors_before_after import folds_for
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.gates import OF_THE_LAW, Candidate
from magtensor.loop.searching.kin import drivers, explained_by_kin, may_be_its_law
from magtensor.registry import Registry

COURSE = np.sin(np.arange(1200) / 200.0)


def model(name: str, **settings: Any) -> Adopted:
    return Adopted(Registry.load().find("error_model", name), settings)


def logged(record: Record) -> Record:
    channels = {"temperature": COURSE, "current_pump": COURSE**2}
    return replace(record, logged=channels, units={"temperature": "degC", "current_pump": "A"})


def assessed(state: State, candidate: Adopted, sensor: str) -> tuple[Any, Any]:
    """Terms, and an assessment in which all that is explained is on one sensor."""
    terms = candidate.terms(state.excitation).at(state.residual.samples)
    theta = np.array([1.0 if s == sensor else 0.0 for s in terms.sensors])
    return terms, SimpleNamespace(estimate=SimpleNamespace(theta=theta, normal=np.eye(terms.count)))


def test_what_drives_a_model() -> None:
    x = linear_state(logged(synthetic(91))).excitation
    warm = drivers(model("temperature_scale", channel="temperature"), x)
    assert warm == drivers(model("temperature_alignment", channel="temperature"), x) == {"temperature"}
    assert not warm & drivers(model("current_field", channel="current_pump"), x)
    ageing = drivers(model("scale_drift", order=1, span_s=1199.0), x)
    assert ageing & drivers(model("alignment_drift", tau_s=600.0, span_s=1199.0), x)
    assert drivers(model("nonlinearity_quadratic"), x) == set()


def test_kin_have_one_driver_and_one_sensor() -> None:
    added = np.zeros((1200, 4, 3))
    added[:, 1] = 20.0 * COURSE[:, None]
    record = logged(synthetic(92, added=added))
    offset = replace(model("temperature_offset", channel="temperature"), sensors=("S2",))
    state = joint_state(record, [offset], Fitting())
    rate = model("temperature_rate", channel="temperature", tau_s=10.0)
    current = model("current_field", channel="current_pump")
    of_the_same = explained_by_kin(state, rate, *assessed(state, rate, "S2"))
    # three of four parts of what is added lie off the field that all sensors see, and a little along it
    assert of_the_same == pytest.approx(np.sum(added**2) * 0.75, rel=0.3)
    assert explained_by_kin(state, rate, *assessed(state, rate, "S3")) == 0.0  # another sensor
    assert explained_by_kin(state, current, *assessed(state, current, "S2")) == 0.0  # another driver
    assert explained_by_kin(state, offset, *assessed(state, offset, "S2")) == 0.0  # more of the same has another lag


@pytest.mark.parametrize(
    ("name", "settings", "cut_off"), [("fixed_source", {"degree": 4}, True), ("site_gradient", {}, False)]
)
def test_what_a_source_lacks_beyond_its_degree_follows_the_field(
    name: str, settings: dict[str, Any], cut_off: bool, tmp_path: Path
) -> None:
    effect = {"type": "fixed_source", "rms_nT": 3.0, "position_m": [0.8, 0.3, -0.6]}
    motion = BASE["motion"] | {"duration_s": 600.0}
    record = loaded(tmp_path, scenario(61, effect, motion=motion, logging={"attitude": True}))
    state = joint_state(record, [model(name, **settings)], Fitting())
    bent, warm = model("nonlinearity_cubic", of_field=False), model("temperature_scale", channel="temperature")
    elsewhere = model("position_error")
    assert (explained_by_kin(state, bent, *assessed(state, bent, "S2")) > 1e4) is cut_off
    assert explained_by_kin(state, elsewhere, *assessed(state, elsewhere, "S2")) == 0.0
    assert explained_by_kin(state, warm, *assessed(state, warm, "S2")) == 0.0


@pytest.mark.parametrize("kin", [False, True])
def test_what_turns_is_no_law_of_an_offset_unless_the_platform_hardly_does(kin: bool) -> None:
    added = np.zeros((1200, 4, 3))
    added[:, 1] = 20.0 * COURSE[:, None]
    plain = synthetic(94)
    if kin:  # turned by a degree or two about one attitude
        field = plain.raw.mean(axis=(0, 1)) + 0.02 * plain.raw
        plain = replace(plain, raw=field + np.array([20_000.0, 10_000.0, 40_000.0]))
    record = logged(replace(plain, raw=plain.raw + added))
    offset = replace(model("temperature_offset", channel="temperature"), sensors=("S2",))
    found = replace(linear_state(logged(synthetic(94))), adopted=(offset,))
    x = replace(found.excitation, output=record.raw)
    turned = model("temperature_scale", channel="temperature").terms(x).at(found.residual.samples)
    theta = np.array([1.0 if s == "S2" else 0.0 for s in turned.sensors])
    assert may_be_its_law(offset, turned, theta, replace(found, excitation=x)) is kin


def test_an_event_beside_a_response_that_has_no_law_is_of_its_kind() -> None:
    """Its time was sought in what the response leaves, which nobody knows the law of."""
    added = np.zeros((1200, 4, 3))
    added[:, 1] = 20.0 * COURSE[:, None]
    settings = {"channel": "temperature", "power": 1}
    response = replace(model("channel_response", **settings), sensors=("S2",))
    state = joint_state(logged(synthetic(92, added=added)), [response], Fitting())
    event, scale = model("offset_step", time_s=500.0), model("scale_drift", order=1, span_s=1199.0)
    of_the_same = explained_by_kin(state, event, *assessed(state, event, "S2"))
    assert of_the_same == pytest.approx(np.sum(added**2) * 0.75, rel=0.3)
    assert explained_by_kin(state, event, *assessed(state, event, "S3")) == 0.0  # another sensor
    assert explained_by_kin(state, scale, *assessed(state, scale, "S2")) == 0.0  # it lasts
    named = joint_state(
        logged(synthetic(92, added=added)), [model("temperature_offset", channel="temperature")], Fitting()
    )
    assert explained_by_kin(named, event, *assessed(named, event, "S2")) == 0.0  # of a law that is known


@pytest.mark.parametrize(("gain", "refused"), [(0.9, True), (1.1, False)])
def test_what_the_law_of_its_kin_may_miss_is_refused(gain: float, refused: bool) -> None:
    kin = 4e5
    of_gain, estimate = SimpleNamespace(total=gain * OF_THE_LAW * kin), SimpleNamespace(rank=12)
    assessment: Any = SimpleNamespace(gain=of_gain, estimate=estimate)
    terms: Any = None
    found = Candidate(model("temperature_scale"), 1.0, terms, assessment, 0.0, 0.0, 0.0, kin=kin)
    assert found.of_the_law is refused
    assert not refused or not found.predicts


def test_what_is_added_to_the_axes_and_what_turns_with_the_field() -> None:
    x = linear_state(logged(synthetic(93))).excitation
    added = [
        model("temperature_offset", channel="temperature"),
        model("offset_step", time_s=300.0),
        model("reference_drift", order=1, span_s=1199.0),
    ]
    turned = [
        model("temperature_scale", channel="temperature"),
        model("turn_step", time_s=300.0),
        model("nonlinearity_quadratic"),
        model("hysteresis", half_width_nT=2000.0),
    ]
    assert all(m.terms(x).adds_to_axes for m in added)
    assert not any(m.terms(x).adds_to_axes for m in turned)


def telegraph(seed: int, time: Array, dwell_s: float) -> Array:
    """(N,) 0 or 1, random switchings."""
    rng = np.random.default_rng(seed)
    at = np.cumsum(rng.exponential(dwell_s, 200))
    return np.asarray(np.searchsorted(at, time) % 2, dtype=float)


@pytest.mark.long
@pytest.mark.parametrize(
    ("survey", "seed", "dwell_s", "size", "models", "words"),
    [
        (96, 7, 40.0, 0.3, ["offset_while", "turn_step"], "what stays along its vector goes in jumps too"),
        (94, 5, 90.0, 1.0, ["offset_while", "offset_step"], "it acts at other times too"),
    ],
    ids=["one is found", "several are found"],
)
def test_a_sensor_that_switches_has_no_offsets_for_a_while(
    survey: int, seed: int, dwell_s: float, size: float, models: list[str], words: str, tmp_path: Path
) -> None:
    def change(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            course = telegraph(seed, np.asarray(file["time"][:] - file["time"][0]), dwell_s)
            file["b_raw"][:, 1] += course[:, None] * size * np.array([0.5, -0.7, -1.2])

    told = verdict_of(tmp_path, scenario(survey), change, models=models)
    assert told["adopted"] == []
    assert told["unexplained"]["present"]
    assert words in json.dumps(told["rejected"])
    assert "offset_while" in [s["adopted"] for s in told["steps"]]  # what this is about


@pytest.mark.long
@pytest.mark.parametrize("sensors", [None, pytest.param(["S1"], marks=pytest.mark.long)])
def test_a_warming_up_that_is_soon_over(tmp_path: Path, sensors: list[str] | None) -> None:
    """A twentieth of the survey: nothing of it is known without the first fold."""
    effect = {"type": "warm_up", "rms_nT": 0.45, "tau_s": 60.0, "sensors": sensors}
    told = verdict_of(tmp_path, scenario(95, effect), models=["warm_up", "channel_response", "temperature_offset"])
    assert adopted_names(told) == {"warm_up"}
    assert told["adopted"][0]["settings"]["tau_s"] == pytest.approx(60.0, rel=0.05)
    assert not told["unexplained"]["present"]


def test_folds_for_what_is_soon_over() -> None:
    record = synthetic(96)
    long, short = (folds_for(joint_state(record, [model("warm_up", tau_s=tau)], Fitting())) for tau in (600.0, 60.0))
    assert len(long) == 6
    assert len(short) > 6 and short[1] < 60
