"""What acts in a part of a survey only is adopted if one part of that predicts another, and not for being there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loop_cases import BASE, Array, adopted_names, linear_state, scenario, synthetic, verdict_of

from magtensor.components import Component
from magtensor.loop.evidence.assessment import WHITE
from magtensor.loop.evidence.gains import LEAST_T, focused_folds
from magtensor.loop.evidence.grams import grams
from magtensor.loop.fitting.errors_before_after import folds_for
from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.separation import SECOND_ORDER
from magtensor.loop.fitting.trial import on_the_folds_of, trial
from magtensor.loop.searching.contribution import eliminate, removal
from magtensor.loop.searching.gates import ALPHA, Candidate
from magtensor.loop.searching.outcome import why
from magtensor.loop.searching.rivals import part_of_a_drift
from magtensor.loop.searching.screening import candidates_of
from magtensor.registry import Registry

SAMPLES = 1200  # one a second
RAN = slice(460, 640)  # most of it in one of ten folds of 120 s


def pump(rng: np.random.Generator) -> Array:
    """A, (N,): it ran once, on and off, for three minutes."""
    out = np.zeros(SAMPLES)
    out[RAN] = np.repeat(rng.permutation([1.0, 0.0] * 9), 10)
    return out


def model(name: str) -> Component:
    return Registry.load().find("error_model", name)


def survey_with(seed: int, current: Array, added: Array) -> Record:
    """A survey that logs a current, with `added` (N, S, 3) nT in the outputs."""
    record = synthetic(seed, samples=SAMPLES, noise_nT=0.2, added=added)
    logged = {"current_pump": current - current.mean()}
    return replace(record, logged=logged, origins={"current_pump": current.mean()}, units={"current_pump": "A"})


def looked_at(seed: int, current: Array, added: Array) -> Candidate:
    """The current's field as a candidate on such a survey."""
    (found,) = candidates_of(linear_state(survey_with(seed, current, added)), [model("current_field")], {}, ALPHA)
    return found


def test_a_pump_that_ran_once_is_found() -> None:
    rng = np.random.default_rng(5)
    current = pump(rng)

    found = looked_at(6, current, current[:, None, None] * rng.standard_normal((4, 3)) * 1.0)

    assert found.assessment.gain.t < LEAST_T < found.assessment.focused.t  # what the folds of equal length do not show
    assert found.predicts_where_it_acts and found.passes


@pytest.mark.long
def test_another_disturbance_while_it_ran_is_not_the_pump() -> None:
    for seed in range(7, 15):
        rng = np.random.default_rng(seed)
        current, other = pump(rng), np.zeros((SAMPLES, 4, 3))
        other[RAN] = np.cumsum(rng.standard_normal((180, 4, 3)), axis=0) / 6.0  # a random walk of a nT or two

        assert not looked_at(seed, current, other).passes


def test_folds_are_short_where_it_acts_and_the_same_whatever_the_data() -> None:
    current = pump(np.random.default_rng(9))

    def folds(nT: float) -> list[int]:
        state = linear_state(survey_with(3, current, nT * current[:, None, None] * np.ones((4, 3))))
        terms = model("current_field").function(state.excitation, channel="current_pump").at(state.residual.samples)
        blocks = grams(state.residual, terms, WHITE.across, WHITE.along, SAMPLES // 10)
        return [10 * int(edge) for edge in focused_folds(blocks, np.zeros(terms.count, dtype=bool))]

    assert folds(0.0) == folds(0.1) == folds(0.2)
    inner = np.array(folds(0.0)[1:-1])
    assert len(inner) >= 8 and np.all((inner > RAN.start) & (inner <= RAN.stop))


def test_the_folds_of_the_third_gate_divide_what_happens_once() -> None:
    record = survey_with(4, pump(np.random.default_rng(10)), np.zeros((SAMPLES, 4, 3)))
    steady = Adopted(model("nonlinearity_cubic"), {})
    once = Adopted(model("current_field"), {"channel": "current_pump"})
    passes = Adopted(model("passing_source"), {"time_s": 1000.0, "passage_s": 10.0})

    def folds(*adopted: Adopted) -> list[int]:
        return folds_for(joint_state(record, adopted, Fitting())).tolist()

    equal = [0, 240, 480, 720, 960, 1200]
    assert folds() == folds(steady) == equal
    while_it_ran = sorted(set(folds(steady, once)) - set(equal))
    assert len(while_it_ran) == 4 and RAN.start < while_it_ran[0] and while_it_ran[-1] < RAN.stop
    nearest = sorted(set(folds(passes)) - set(equal))
    assert len(nearest) == 4 and nearest[0] > 985 and nearest[-1] < 1015
    assert nearest[0] + nearest[-1] == pytest.approx(2000, abs=3)  # it is as long coming as it is going


PULSE = slice(300, 420)  # within the second of five folds, over one edge of ten


@pytest.mark.parametrize(
    "on",
    [PULSE, slice(350, 439), slice(1132, SAMPLES), slice(0, 232)],
    ids=["once", "hardly in the fold before", "from late on", "at first"],
)
def test_what_was_on_once_is_judged_on_folds_that_know_of_it(on: slice) -> None:
    """The others know nothing but the noise of the log: what they make of it is no judgement of the effect."""
    rng = np.random.default_rng(12)
    current = np.zeros(SAMPLES)
    current[on] = 1.5
    vectors = rng.standard_normal((4, 3))
    record = survey_with(13, current + 0.005 * rng.standard_normal(SAMPLES), current[:, None, None] * vectors)
    adopted = [Adopted(model("current_field"), {"channel": "current_pump"})]
    before, after = (trial(record, joint_state(record, models, Fitting()), Fitting()) for models in ([], adopted))
    inner = set(after.folds.tolist()) - {0, 240, 480, 720, 960, 1200}
    assert len(inner) == 4 and all(abs(edge - on.start) < 400 for edge in inner)
    assert on_the_folds_of(after, record, before, Fitting()).hurt_by(after) == []
    without, with_it = removal(after.state, 0)
    assert with_it == pytest.approx(0.2, rel=0.05) and without > 1.5 * with_it
    kept, dropped = eliminate(record, after.state, Fitting(), 0)
    assert [a.name for a in kept.adopted] == ["current_field"] and dropped == ()


@pytest.mark.parametrize(("log_noise", "instead"), [(0.005, True), (0.0, True), (1e-6, False)])
def test_what_was_on_once_is_the_current_whose_log_is_noisy(log_noise: float, instead: bool) -> None:
    """A heater of 30 nT for a while: without the noise of the log an offset meanwhile explains more, and is no more
    than the current. One that changed otherwise than its current, by far more than the log's noise, is."""
    rng = np.random.default_rng(15)
    current, added = np.zeros(SAMPLES), np.zeros((SAMPLES, 4, 3))
    current[PULSE] = 1.5
    vectors = 20.0 * rng.standard_normal((4, 3))
    added += current[:, None, None] * vectors
    if not instead:
        current[PULSE] *= np.linspace(0.9, 1.1, PULSE.stop - PULSE.start)
    record = survey_with(16, current + log_noise * rng.standard_normal(SAMPLES), added)
    state = linear_state(record)
    found = {c.model.name: c for c in candidates_of(state, [model("current_field"), model("offset_while")], {}, ALPHA)}
    event = found["offset_while"]
    assert event.passes
    lasting = part_of_a_drift(event, list(found.values()), state)
    assert (lasting is not None and lasting.passes) is instead


def test_a_channel_seen_elsewhere_if_less_divides_no_fold() -> None:
    """Two per cent of what is known is known from elsewhere: coefficients that err by seven times as much."""
    current = np.zeros(SAMPLES)
    current[PULSE] = 1.5
    current[800:] += 0.12 * np.sign(np.sin(np.arange(400) / 9.0))
    record = survey_with(14, current, np.zeros((SAMPLES, 4, 3)))
    adopted = [Adopted(model("current_field"), {"channel": "current_pump"})]
    assert folds_for(joint_state(record, adopted, Fitting())).tolist() == [0, 240, 480, 720, 960, 1200]


@pytest.mark.long
def test_a_vehicle_that_passed_is_found_wherever_the_folds_lie(tmp_path: Path) -> None:
    track = {"closest_m": [9.0, 0.0, -1.0], "velocity_m_s": [0.0, 0.6, 0.0]}
    passing = {"type": "passing_source", "rms_nT": 0.6, "time_s": 610.0} | track
    motion = BASE["motion"] | {"duration_s": 1000.0}
    models = ("passing_source", "reference_step", "reference_drift", "nonlinearity_cubic")

    told = verdict_of(tmp_path, scenario(31, passing, motion=motion), models=models)

    assert adopted_names(told) == {"passing_source"}
    settings = told["adopted"][0]["settings"]
    assert settings["time_s"] == pytest.approx(610.0, abs=2.0)
    assert settings["passage_s"] == pytest.approx(np.sqrt(82.0) / 0.6, rel=0.1)
    before, after = (told["error"]["held_out"][k]["total_field_rms_nT"]["all"] for k in ("before", "after"))
    assert after < 0.5 * before


def test_the_next_order_of_something_strong_is_no_effect() -> None:
    rng = np.random.default_rng(16)
    found = looked_at(17, pump(rng), 0.5 * pump(np.random.default_rng(16))[:, None, None] * rng.standard_normal((4, 3)))
    assert found.passes and not found.of_second_order

    beside = replace(found, beside=1.01 * found.assessment.gain.total / SECOND_ORDER)

    assert beside.of_second_order and not beside.passes
    assert "next order" in why(beside, None)
