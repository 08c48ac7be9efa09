"""What the verdict says of a rest that no error model describes: converters, louder noise, a base station elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import BASE, Array, linear_state, looked_at, scenario, synthetic, verdict_of

from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.refit import joint_state, loud_stretches, rounding
from magtensor.loop.remainder.flagged import flagged_words
from magtensor.loop.remainder.loud import Loud
from magtensor.loop.remainder.predictable import converter_words
from magtensor.loop.searching.found import Search, Step
from magtensor.loop.searching.unexplained import unexplained
from magtensor.registry import Registry
from magtensor.verdict_words import sentence

SAMPLES = 3000


def told(record: Record) -> dict[str, object]:
    state = linear_state(record)
    return unexplained(Search(state, state, (), {}, {}, record, None, Fitting()), record)


def converted(shape: str, seed: int, size: float = 0.4) -> Record:
    """A converter of S2's y that is off by what its own output says: a wave, or the steps of a missing code."""
    clean = synthetic(seed, SAMPLES, turning_s=4.0, noise_nT=0.15)
    output = clean.raw[:, 1, 1]
    wave = np.sin(2.0 * np.pi * output / 8000.0) if shape == "wave" else np.sign((output % 20000.0) - 10000.0)
    added = np.zeros((SAMPLES, 4, 3))
    added[:, 1, 1] = size * wave
    return replace(clean, raw=clean.raw + added)


@pytest.mark.parametrize("shape", ["wave", "steps"])
def test_a_converter_that_is_not_linear_is_told(shape: str) -> None:
    found = told(converted(shape, 5))
    assert found["present"]
    assert "S2 (y) add follows from what they read" in str(found["description"])


@pytest.mark.parametrize("seed", range(6))
def test_no_converter_is_accused_by_noise(seed: int) -> None:
    added = np.zeros((SAMPLES, 4, 3))
    added[:, 2] = np.cumsum(np.random.default_rng(seed).standard_normal((SAMPLES, 3)), axis=0) / 60.0
    assert converter_words(linear_state(synthetic(seed, SAMPLES, turning_s=4.0, noise_nT=0.15))) == []
    assert converter_words(linear_state(synthetic(seed, SAMPLES, turning_s=4.0, noise_nT=0.15, added=added))) == []
    assert converter_words(linear_state(synthetic(seed, 150, noise_nT=0.15))) == []  # too few to ask


@pytest.mark.parametrize("sensors", [slice(2, 3), slice(0, 4)])
def test_noise_that_is_louder_for_a_while_is_dated(sensors: slice) -> None:
    """Of all sensors in one sentence."""
    rng = np.random.default_rng(3)
    added = np.zeros((SAMPLES, 4, 3))
    added[1000:1400, sensors] = 0.6 * rng.standard_normal((400, 4, 3))[:, sensors]
    record = synthetic(3, SAMPLES, turning_s=4.0, noise_nT=0.15, added=added)
    (words,) = Loud.of(linear_state(record), record, Fitting()).words
    begin, end = (float(words.split()[i]) for i in (1, 3))
    assert ("the noise of S3" in words) is (sensors.start == 2) and ("all other sensors" in words) is (
        sensors.stop == 4
    )
    assert begin == pytest.approx(1000, abs=15) and end == pytest.approx(1400, abs=15)
    quiet = synthetic(3, SAMPLES, turning_s=4.0, noise_nT=0.15)
    assert Loud.of(linear_state(quiet), quiet, Fitting()).words == []


def test_noise_that_grows_is_told() -> None:
    """It is nowhere twice as loud as usual, and at the end four times as at the beginning."""
    rng = np.random.default_rng(4)
    added = np.zeros((SAMPLES, 4, 3))
    added[:, 1] = np.linspace(0.0, 0.6, SAMPLES)[:, None] * rng.standard_normal((SAMPLES, 3))
    record = synthetic(4, SAMPLES, turning_s=4.0, noise_nT=0.15, added=added)
    (words,) = Loud.of(linear_state(record), record, Fitting()).words
    times, here, there = (float(words.split()[i]) for i in (5, 10, 16))
    assert "the noise of S2 is" in words
    assert times == pytest.approx(np.hypot(0.57, 0.15) / np.hypot(0.03, 0.15), rel=0.2)  # the last tenth and the first
    assert here == pytest.approx(0.9 * SAMPLES, abs=0.11 * SAMPLES) and there < 0.21 * SAMPLES


@pytest.mark.parametrize(
    ("where", "told_of"),
    [
        ("largest", "where current_heater is largest"),
        ("smallest", "where current_heater is smallest"),
        ("anywhere", ""),
    ],
)
def test_flagged_samples_at_an_end_of_a_channel_are_told_as_such(where: str, told_of: str) -> None:
    """A current whose field saturates: the largest currents fit no straight line."""
    rng = np.random.default_rng(11)
    current = rng.normal(0.0, 1.0, SAMPLES)
    added = 3.0 * current[:, None, None] * rng.normal(0.0, 1.0, (4, 3))
    record = replace(
        synthetic(11, SAMPLES, turning_s=4.0, noise_nT=0.15, added=added),
        logged={"current_heater": current}, units={"current_heater": "A"}, origins={"current_heater": np.zeros(1)},
    )  # fmt: skip
    model = Adopted(Registry.load().find("error_model", "current_field"), {"channel": "current_heater", "lag_s": 0.0})
    state = joint_state(record, [model], Fitting())
    by = {"largest": -current, "smallest": current, "anywhere": rng.standard_normal(SAMPLES)}[where]
    flagged = np.isin(np.arange(SAMPLES), np.argsort(by)[:40])
    words, _ = flagged_words(flagged, state, record)
    assert told_of in words and ("mostly where" in words) is bool(told_of)


def beside(difference: Array) -> Record:
    record = synthetic(7, SAMPLES, turning_s=4.0, noise_nT=0.15)
    assert record.total_field is not None
    return replace(record, total_field=record.total_field + difference, quiet_field=record.total_field + difference)


def test_a_field_that_the_base_station_does_not_see_is_no_noise() -> None:
    """A railway: direct current that comes and goes."""
    rng = np.random.default_rng(8)
    railway = np.repeat(rng.choice([0.0, 0.8, 2.0, -1.0], SAMPLES // 30), 30)
    found = told(beside(railway - railway.mean()))
    assert found["present"] and "in all sensors alike" in str(found["description"])
    assert "above the white noise, mostly in |b| - F, alike in all sensors" in str(found["description"])


@pytest.mark.parametrize(("amplitude_nT", "told_of"), [(0.6, True), (0.0, False)])
def test_a_tone_of_the_base_station_is_told_with_its_period(amplitude_nT: float, told_of: bool) -> None:
    """Beside something that wanders, which has none."""
    walk = np.cumsum(np.random.default_rng(5).standard_normal(SAMPLES))
    tone = amplitude_nT * np.sin(2.0 * np.pi * np.arange(SAMPLES) / 40.0)
    words = str(told(beside(0.5 * walk / walk.std() + tone))["description"])
    assert ("a line of |b| - F at 0.025 Hz (period 40 s), 0.4" in words) is told_of
    assert told_of or "a line" not in words


def test_a_base_station_that_wanders_a_little_is() -> None:
    found = told(beside(0.2 * np.sin(np.arange(SAMPLES) / 150.0)))
    assert not found["present"]


def of_errors(here: tuple[float, float], there: tuple[float, float], kind: str = "instrument") -> dict[str, Any]:
    """An outcome with errors of |b| - F before and after, on held-out blocks and on a verification survey."""

    def block(error: float) -> dict[str, object]:
        return {"total_field_rms_nT": {"all": error}, "tensor_rms_nT_per_m": None}

    return {
        "declared": ["linear"],
        "noise_floor_nT": 0.1,
        "adopted": [{"error_model": "some", "kind": kind}],
        "unexplained": {"present": False, "description": "", "excess_rms_nT": 0.0, "looks_like": []},
        "error": {
            name: {"before": block(errors[0]), "after": block(errors[1])}
            for name, errors in (("held_out", here), ("verify", there))
        },
    }


@pytest.mark.parametrize(
    ("before_nT", "after_nT", "told_of"),
    [(0.62, 0.59, "11% only"), (0.62, 0.25, ""), (0.22, 0.21, ""), (0.21, 0.215, "")],
    ids=["hardly any of it", "most of it", "there is none", "noise"],
)
def test_what_takes_off_little_of_another_survey_may_be_of_another_law(
    before_nT: float, after_nT: float, told_of: str
) -> None:
    said = sentence(of_errors((0.6, 0.2), (before_nT, after_nT)))
    assert told_of in said and ("the law may be another one" in said) is bool(told_of)


@pytest.mark.parametrize(
    ("kind", "words"), [("site", "modelled, not taken off"), ("instrument", "does not carry over")]
)
def test_a_site_that_was_modelled_is_in_another_survey_too(kind: str, words: str) -> None:
    assert words in sentence(of_errors((2.0, 0.2), (2.0, 3.0), kind))


@pytest.mark.parametrize(
    ("there", "left_by_any_nT", "said"),
    [
        ((2.0, 3.0), None, "does not carry over (channel_response: pressure"),
        ((0.6, 0.55), None, "the law may be another one (channel_response: pressure"),
        ((5.0, 3.0), 0.2, "too little of what the second needs (channel_response: pressure"),
        (
            (5.0, 3.0),
            2.9,
            "was added, or what an effect comes to beyond what is known of it (channel_response: pressure",
        ),
    ],
)
def test_an_effect_beyond_what_is_known_of_it_may_be_why_another_survey_disagrees(
    there: tuple[float, float], left_by_any_nT: float | None, said: str
) -> None:
    outcome = of_errors((1.0, 0.2), there)
    outcome["error"]["verify"]["left_by_any_calibration_nT"] = left_by_any_nT
    assert said not in sentence(outcome)
    outcome["error"]["verify"]["extrapolated"] = "channel_response: pressure goes 27 hPa beyond"
    assert said in sentence(outcome)


@pytest.mark.parametrize(
    ("there", "said"),
    [((1.0, 0.9), "C and o help there, fitted beside what"), ((1.0, 1.05), "nearer to the verification survey's")],
)
def test_what_is_better_not_taken_off_is_no_contradiction_of_the_figures(there: tuple[float, float], said: str) -> None:
    outcome = of_errors((1.0, 0.2), there)
    outcome["error"]["verify"]["contradicted"] = "current_field"
    assert said in sentence(outcome)
    assert ("were not taken off" in sentence(outcome)) is (there[1] < there[0])


@pytest.mark.parametrize(
    ("after_nT", "said"), [(2.0, "the field of the site was modelled"), (20.0, "disagrees with the calibration")]
)
def test_a_field_of_the_site_is_no_reason_for_more_than_it_made(after_nT: float, said: str) -> None:
    """It made 1 nT of the first survey; a verification survey of another instrument errs by far more."""
    told = sentence(of_errors((1.0, 0.2), (after_nT, after_nT), kind="site"))
    assert said in told and ("field of the site" in told) is (after_nT < 3.0)


@pytest.mark.parametrize(("tensor", "said"), [(0.6, False), (150.0, True)])
def test_a_tensor_that_errs_where_the_length_does_not_is_told(tensor: float, said: bool) -> None:
    outcome = of_errors((1.0, 0.2), (1.0, 0.2))
    for name, value in (("held_out", 0.5), ("verify", tensor)):
        outcome["error"][name]["after"]["tensor_rms_nT_per_m"] = {"all": value}
    assert ("300 times as much as on held-out blocks" in sentence(outcome)) is said


@pytest.mark.parametrize(("wandering_nT", "told_of"), [(0.0, True), (2.0, False)])
def test_a_line_is_told_where_it_is_much_of_what_is_left(wandering_nT: float, told_of: bool) -> None:
    time = np.arange(SAMPLES)
    added = np.zeros((SAMPLES, 4, 3))
    added[:, 1] = 0.1 * np.sin(2.0 * np.pi * time / 7.3)[:, None] * np.array([0.6, -0.6, 0.5])
    walk = np.cumsum(np.random.default_rng(4).standard_normal((SAMPLES, 3)), axis=0)
    added[:, 2] = wandering_nT * walk / walk.std(axis=0)
    words = str(told(synthetic(4, SAMPLES, turning_s=4.0, noise_nT=0.15, added=added))["description"])
    assert ("a line at 0.137 Hz" in words) is told_of


@pytest.mark.parametrize(
    ("total_field", "tensor", "head"),
    [(1.0, 1.0, "traced to"), (1.04, 0.9, "traced to"), (1.04, 1.1, "No error falls"), (1.04, None, "No error falls")],
)
def test_what_lowers_no_error_is_not_called_traced(total_field: float, tensor: float | None, head: str) -> None:
    def block(total: float, of_tensor: float | None) -> dict[str, Any]:
        return {
            "total_field_rms_nT": {"all": total},
            "tensor_rms_nT_per_m": None if of_tensor is None else {"all": of_tensor},
        }

    before, after = block(1.0, None if tensor is None else 1.0), block(total_field, tensor)
    outcome = {
        "declared": ["linear"],
        "adopted": [{"error_model": "temperature_scale", "settings": {}, "kind": "instrument"}],
        "noise_floor_nT": 0.1,
        "unexplained": {"present": True, "description": "much", "excess_rms_nT": 3.0, "looks_like": []},
        "error": {"fit": after, "held_out": {"before": before, "after": after}},
    }
    assert head in sentence(outcome)


@pytest.mark.parametrize(
    ("verified", "head"), [(0.161, "traced to lag_step: total field 0.9 -> 0.16 nT rms on held-out"), (0.3, "No error")]
)
def test_what_another_survey_does_not_show_is_told_by_held_out_blocks(verified: float, head: str) -> None:
    def block(error: float) -> dict[str, Any]:
        return {"total_field_rms_nT": {"all": error}, "tensor_rms_nT_per_m": None}

    outcome: dict[str, Any] = {
        "declared": ["linear"],
        "adopted": [{"error_model": "lag_step", "settings": {}, "kind": "instrument"}],
        "noise_floor_nT": 0.15,
        "unexplained": {"present": False, "description": "nothing", "excess_rms_nT": 0.0, "looks_like": []},
        "error": {
            "fit": block(0.16),
            "held_out": {"before": block(0.9), "after": block(0.16)},
            "verify": {"before": block(0.16), "after": block(verified)},
        },
    }
    assert head in sentence(outcome)
    of_its_own = {"before": block(1.20), "after": block(1.21)}  # another error, which no block of the first shows
    assert "No error falls" in sentence({**outcome, "error": {**outcome["error"], "verify": of_its_own}})
    assert "No error falls" in sentence({**outcome, "error": {**outcome["error"], "held_out": None}})


def test_what_was_adopted_more_than_once_is_counted_and_a_channel_named() -> None:
    blocks = {"total_field_rms_nT": {"all": 1.0}, "tensor_rms_nT_per_m": None}
    adopted = [
        {"error_model": name, "settings": {"channel": channel}, "kind": "instrument"}
        for name, channel in (("offset_step", ""), ("offset_step", ""), ("channel_response", "throttle"))
    ]
    outcome = {
        "declared": ["linear"],
        "adopted": adopted,
        "noise_floor_nT": 0.1,
        "unexplained": {"present": False, "description": "nothing", "excess_rms_nT": 0.0, "looks_like": []},
        "error": {"fit": blocks, "held_out": {"before": blocks, "after": blocks}},
    }
    assert "traced to 2 x offset_step, channel_response of throttle:" in sentence(outcome)
    adopted[2] |= {"error_model": "temperature_offset", "channels_as_good": ["intake", "room"]}
    assert "2 x offset_step, temperature_offset of throttle (or of intake or room):" in sentence(outcome)


def test_when_something_happened_is_told_though_it_is_not_adopted() -> None:
    """A jump, and an offset for a while, that passed and were refused."""
    added = np.zeros((1200, 4, 3))
    added[700:, 0] = [9.0, 6.0, -5.0]
    added[300:600, 1] = [-4.0, 6.0, 5.0]
    record = synthetic(53, noise_nT=0.5, turning_s=4.0, added=added)
    state, find = linear_state(record), Registry.load().find
    jump = Adopted(find("error_model", "offset_step"), {"time_s": 700.0}, ("S1",))
    part = Adopted(find("error_model", "offset_while"), {"time_s": 300.0, "until_s": 600.0}, ("S2",))
    seen = [looked_at(state, model) for model in (jump, part)]
    step = Step(state, tuple(seen), None, refused={"offset_step": "for a reason"})
    found = Search(state, state, (step,), {}, {}, record, None, Fitting())
    words = str(unexplained(found, record)["description"])
    assert "offset_step at 700 s (for a reason)" in words and "offset_while from 300 to 600 s" in words


@pytest.mark.parametrize(
    ("left", "each", "changed", "own"),
    [
        (0.16, {"S1": 0.2, "S2": 500.0}, "disagrees with the calibration of S2: something changed", ""),
        (3.0, {"S1": 0.2, "S2": 500.0}, "disagrees with the calibration of S2: ", "3 nT rms of |b| - F of S2 that no"),
        (300.0, {"S1": 500.0, "S2": 500.0}, "", "300 nT rms of |b| - F that no calibration would take off"),
        (0.16, {"S1": 0.2, "S2": 0.2}, "", ""),
    ],
)
def test_where_another_survey_disagrees_is_told(left: float, each: dict[str, float], changed: str, own: str) -> None:
    """A sensor put where another had been: noise of its own is the least of what that survey shows."""

    def block(each: dict[str, float]) -> dict[str, Any]:
        rms = float(np.sqrt(np.mean(np.square([*each.values()]))))
        return {"total_field_rms_nT": {**each, "all": rms}, "tensor_rms_nT_per_m": None}

    here, there = block({"S1": 0.16, "S2": 0.16}), block(each)
    outcome = {
        "declared": ["linear"],
        "adopted": [],
        "noise_floor_nT": 0.15,
        "unexplained": {"present": False, "description": "nothing", "excess_rms_nT": 0.0, "looks_like": []},
        "error": {
            "fit": here,
            "held_out": {"before": here, "after": here},
            "verify": {"before": there, "after": there, "left_by_any_calibration_nT": left},
        },
    }  # fmt: skip
    said = sentence(outcome)
    assert changed in said and own in said
    assert "unexplained here too" not in said
    rest = {"present": True, "description": "something", "excess_rms_nT": 0.0, "looks_like": []}
    assert ("or what is unexplained here too" in sentence(outcome | {"unexplained": rest})) is bool(own)
    assert ("disagrees" in said) is bool(changed) and ("no calibration" in said) is bool(own)


def test_outputs_in_coarse_steps_have_no_loud_stretches() -> None:
    """Between postures everything changes, at rest next to nothing does: that is no noise that is louder."""
    clean = synthetic(5, SAMPLES, turning_s=4.0, noise_nT=0.15)
    at_rest = np.repeat(clean.raw[::20], 20, axis=0) + 0.15 * np.random.default_rng(5).standard_normal(clean.raw.shape)
    coarse = replace(clean, raw=np.round(at_rest / 2.0) * 2.0)
    state = linear_state(coarse)
    assert loud_stretches(coarse, state, Fitting()) == ()
    (words,) = Loud.of(state, coarse, Fitting()).words
    assert words == "the outputs come in steps of 2 nT, whose rounding makes most of the noise"
    assert rounding(clean, linear_state(clean)) == 0.0


@pytest.mark.parametrize(("noise_nT", "told"), [(0.5, True), (3.0, False)])
def test_steps_are_told_of_outputs_that_never_repeat_one(noise_nT: float, told: bool) -> None:
    """A platform that turns sweeps over twelve thousand steps of 8 nT; they make 2.3 nT of noise."""
    record = synthetic(6, SAMPLES, noise_nT=noise_nT)
    coarse = replace(record, raw=np.round(record.raw / 8.0) * 8.0)
    words = Loud.of(linear_state(coarse), coarse, Fitting()).words
    assert ("the outputs come in steps of 8 nT, whose rounding makes most of the noise" in words) is told


@pytest.mark.parametrize(("unseen_nT", "told"), [(4.0, True), (0.3, False)])
def test_a_calibration_that_does_not_carry_over_is_told(unseen_nT: float, told: bool) -> None:
    fit, unseen = ({"total_field_rms_nT": {"all": nT}} for nT in (0.2, unseen_nT))
    outcome = {
        "declared": ["linear"],
        "noise_floor_nT": 0.2,
        "adopted": [],
        "unexplained": {"present": False, "excess_rms_nT": 0.0, "description": "", "looks_like": []},
        "error": {"fit": fit, "held_out": {"before": unseen, "after": unseen}},
    }
    assert ("the survey is too short to determine it" in sentence(outcome)) is told


@pytest.mark.long
@pytest.mark.parametrize("noise_deg", [0.1, 1.0])
def test_what_an_attitude_s_error_leaves_of_a_gradient_is_noted_and_not_unexplained(
    noise_deg: float, tmp_path: Path
) -> None:
    """Of 40 nT some 0.1 nT at a sensor, where a sample has 0.15 nT of noise on each axis; or more, as noise."""
    survey = scenario(
        5, {"type": "site_gradient", "tensor_nT_per_m": [300.0, 90.0, 0.0, -150.0, 30.0]},
        motion=BASE["motion"] | {"duration_s": 600.0}, logging={"attitude": True, "attitude_noise_deg": noise_deg},
    )  # fmt: skip
    verdict = verdict_of(tmp_path, survey, models=["site_gradient", "latent_source"])
    assert [a["error_model"] for a in verdict["adopted"]] == ["site_gradient"]
    assert not verdict["unexplained"]["present"]
    assert "less than 5 % of what is adopted, whose laws may leave it" in verdict["unexplained"]["description"]


@pytest.mark.parametrize(("louder", "of_the_tensor"), [(1.0, 4.0), (4.0, 4.0), (4.0, 16.0)])
def test_a_tensor_that_errs_more_is_told_unless_the_sensors_are_louder(louder: float, of_the_tensor: float) -> None:
    """The base station's noise of 0.3 nT makes |b| - F of the first survey, the sensors' own of 0.08 nT the tensor."""

    def block(total: float, tensor: float) -> dict[str, Any]:
        return {"total_field_rms_nT": {"all": total}, "tensor_rms_nT_per_m": {"all": tensor}}

    here, there = block(0.31, 0.23), block(0.08 * louder, 0.23 * of_the_tensor)
    outcome: dict[str, Any] = {
        "declared": ["linear"],
        "adopted": [],
        "noise_floor_nT": 0.08,
        "unexplained": {"present": False, "description": "nothing", "excess_rms_nT": 0.0, "looks_like": []},
        "error": {
            "fit": here,
            "held_out": {"before": here, "after": here},
            "verify": {"before": there, "after": there, "left_by_any_calibration_nT": 0.08 * louder},
        },
    }
    assert ("tensor errs by" in sentence(outcome)) is (of_the_tensor > louder)
