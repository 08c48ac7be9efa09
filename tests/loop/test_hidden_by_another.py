"""Effects that hide each other: each alone predicts some blocks far better than others, or some sensors not at all."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loop_cases import BASE, adopted_names, loaded, scenario, verdict_of

from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.trial import trial
from magtensor.loop.searching import rivals
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.keeping import missed_on, why_not
from magtensor.loop.searching.likeness import event_along
from magtensor.loop.searching.on_more_sensors import in_the_place_of_others, on_more_sensors
from magtensor.loop.searching.screening import candidates_of
from magtensor.registry import Registry

TILTED = {"type": "limited_tilt", "duration_s": 1500.0, "tilt_deg": 40.0}
FOLLOWING = {"channel": "temperature", "order": 1, "lag_s": 0.0, "delayed": False, "at_start": 0.0, "bends": ()}


def getting_warmer(seed: int, *effects: dict[str, Any], wander_degC: float = 1.0, **changes: Any) -> dict[str, Any]:
    """A survey of 25 minutes in which the temperature rises by 6 degrees."""
    temperature = BASE["channels"]["temperature"] | {
        "trend_degC_per_h": 15.0,
        "self_heating_degC": 0.0,
        "wander_rms_degC": wander_degC,
    }
    return scenario(seed, *effects, motion=TILTED, channels={"temperature": temperature}, **changes)


def model(name: str, settings: dict[str, Any], *sensors: str) -> Adopted:
    return Adopted(Registry.load().find("error_model", name), settings, sensors)


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "rate_Hz", "times"),
    [
        (5, 1.0, 2.0),
        (3, 2.0, 1.0),
        (6, 2.0, 2.0),
    ],
)
def test_a_step_and_a_temperature_are_found(seed: int, rate_Hz: float, times: float, tmp_path: Path) -> None:
    """Alone the step is far beyond chance and predicts on balance, but the blocks that the temperature moves worse."""
    survey = getting_warmer(
        seed,
        {"type": "temperature_offset", "rms_nT": 0.15 * times, "lag_s": 40.0},
        {"type": "offset_step", "rms_nT": 0.3 * times, "time_s": [600.0]},
        rate_Hz=rate_Hz,
    )
    found = verdict_of(tmp_path, survey, None, ["temperature_offset", "offset_step", "offset_drift"])
    assert adopted_names(found) == {"temperature_offset", "offset_step"} and len(found["adopted"]) == 2
    step = next(a for a in found["adopted"] if a["error_model"] == "offset_step")
    assert step["settings"]["time_s"] == pytest.approx(600.0, abs=2.0)
    assert all(len(a["sensors"]) == 4 for a in found["adopted"])
    assert not adopted_names(found) & {r for a in found["adopted"] for r in a["indistinguishable_from"]}


def test_vectors_that_an_effect_had_of_an_event_are_no_objection(tmp_path: Path) -> None:
    """Fitted without the step, the temperature has the most of it, and its vectors."""
    effects = (
        {"type": "temperature_offset", "rms_nT": 0.15},
        {"type": "offset_step", "rms_nT": 0.6, "time_s": [750.0]},
    )
    record = loaded(tmp_path, getting_warmer(6, *effects, wander_degC=0.2, rate_Hz=1.0))
    following, step = model("temperature_offset", FOLLOWING), model("offset_step", {"time_s": 750.0})
    before = trial(record, joint_state(record, [following], Fitting()), Fitting())
    (chosen,) = candidates_of(before.state, [step.component], {}, 0.005)
    assert event_along(before.state, chosen.terms, chosen.assessment.theta[-chosen.terms.count :])
    after = trial(record, joint_state(record, [following, step], Fitting()), Fitting())
    assert why_not(record, before, after, chosen, Fitting()) == ""


@pytest.mark.parametrize(
    ("significant", "predicts", "gained", "t", "may"),
    [
        (True, False, 30.0, 1.5, True),
        (True, True, 30.0, 2.5, False),  # nothing hinders it
        (True, False, 30.0, 0.5, False),  # it predicts nothing
        (False, False, 30.0, 2.5, False),  # what noise does
        (False, False, 150.0, 2.5, True),  # what no noise does
        (False, False, 150.0, 1.5, False),
    ],
)
def test_what_another_effect_may_keep_from_passing(
    significant: bool, predicts: bool, gained: float, t: float, may: bool
) -> None:
    gain = SimpleNamespace(total=gained, t=t, consistent=t > 2.0, before=np.full(10, 100.0))
    candidate: Any = SimpleNamespace(
        significant=significant,
        predicts=predicts,
        beyond_slow_noise=True,
        assessment=SimpleNamespace(gain=gain),
        _more_than_known=True,
    )
    assert Candidate.may_be_hindered.fget(candidate) is may  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("passing", "part", "first"), [(None, True, True), (20.0, True, True), (20.0, False, False), (60.0, True, False)]
)
def test_it_has_its_turn_before_a_part_of_it(
    passing: float | None, part: bool, first: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def candidate(gained: float, hindered: bool) -> Any:
        return SimpleNamespace(may_be_hindered=hindered, assessment=SimpleNamespace(gain=SimpleNamespace(total=gained)))

    monkeypatch.setattr(rivals, "overlaps", lambda *_: part)
    best, hindered = None if passing is None else candidate(passing, False), candidate(50.0, True)
    found = rivals.hindered_by_another(best, [c for c in (best, hindered) if c], SimpleNamespace())  # type: ignore[arg-type]
    assert (found is hindered) is first and (first or found is None)


@pytest.fixture(scope="module")
def warmed(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """Three of four sensors follow the temperature."""
    effect = {"type": "temperature_offset", "rms_nT": 0.3, "sensors": ["S1", "S2", "S3"]}
    return loaded(tmp_path_factory.mktemp("warmed"), getting_warmer(4, effect, rate_Hz=1.0))


@pytest.mark.parametrize("begun", [("S1",), ("S1", "S2"), ("S1", "S2", "S3")])
def test_an_effect_goes_to_the_sensors_that_show_it_and_to_no_other(warmed: Record, begun: tuple[str, ...]) -> None:
    state = joint_state(warmed, [model("temperature_offset", FOLLOWING, *begun)], Fitting())
    standing = trial(warmed, state, Fitting())
    found = on_more_sensors(warmed, standing, Fitting(), [0])
    assert found.state.adopted[0].sensors == ("S1", "S2", "S3")
    assert (found is standing) is (len(begun) == 3)
    assert len(found.state.theta[0]) == 9 and found.state.residual.square() < 1.3


@pytest.mark.parametrize(("begun", "missed"), [(("S1", "S2"), True), (("S1", "S2", "S3"), False)])
def test_a_sensor_that_shows_an_effect_is_not_spared_it(warmed: Record, begun: tuple[str, ...], missed: bool) -> None:
    state = joint_state(warmed, [model("temperature_offset", FOLLOWING, *begun)], Fitting())
    assert missed_on(state, 0, ["S3" if missed else "S4"]) == missed


@pytest.mark.parametrize("another", [False, True])
def test_what_has_more_coefficients_elsewhere_may_be_the_same_effect(tmp_path: Path, another: bool) -> None:
    """All sensors warm up, and one of them is said to drift; or that one drifts, and steadily."""
    everywhere = [[1.5, -0.3, 0.6], [0.9, -1.2, -0.7], [-2.2, 1.4, -2.1], [-2.0, 2.0, -1.8]]
    warming = [vector if not (another and i == 1) else [0.0] * 3 for i, vector in enumerate(everywhere)]
    effects = [{"type": "warm_up", "tau_s": 300.0, "nT": warming}]
    if another:
        effects.append({"type": "offset_drift", "nT_per_h": [4.0, -3.0, 5.0], "sensors": ["S2"]})
    record = loaded(tmp_path, scenario(4, *effects, motion=TILTED, rate_Hz=1.0))
    adopted = [
        model("warm_up", {"tau_s": 300.0}, "S1", "S3", "S4"),
        model("offset_drift", {"order": 3, "span_s": float(np.ptp(record.time)), "law": "time"}, "S2"),
    ]
    standing = trial(record, joint_state(record, adopted, Fitting()), Fitting())
    found, gone = in_the_place_of_others(record, standing, Fitting(), [0, 1])
    if another:
        assert found is standing and not gone
        return
    assert gone == ("offset_drift",)
    (kept,) = found.state.adopted
    assert kept.name == "warm_up" and not kept.sensors
    np.testing.assert_allclose(found.state.theta[0], np.ravel(everywhere), atol=0.15)


@pytest.mark.parametrize("true", [False, True])
def test_an_event_on_another_sensor_may_be_the_same_law(tmp_path: Path, true: bool) -> None:
    """Three sensors follow the temperature, and on one of them something is said to have jumped; or that one jumps."""
    effects = [{"type": "temperature_offset", "rms_nT": 0.3, "sensors": ["S1", "S3"] if true else ["S1", "S2", "S3"]}]
    if true:
        effects.append({"type": "offset_step", "time_s": [400.0], "nT": [[0.5, -0.4, 0.3]], "sensors": ["S2"]})
    record = loaded(tmp_path, getting_warmer(4, *effects, rate_Hz=1.0))
    adopted = [model("offset_step", {"time_s": 400.0}, "S2"), model("temperature_offset", FOLLOWING, "S1", "S3")]
    standing = trial(record, joint_state(record, adopted, Fitting()), Fitting())
    found, gone = in_the_place_of_others(record, standing, Fitting(), [0, 1])
    assert gone == (() if true else ("offset_step",))
    assert found.state.adopted[-1].sensors == (("S1", "S3") if true else ("S1", "S2", "S3"))


@pytest.mark.parametrize(
    ("total", "significant", "beside", "named"),
    [
        (95.0, False, 1.0, {"other"}),
        (69.0, False, 1.0, {"other"}),  # held-out blocks do not tell them apart
        (60.0, False, 1.0, set()),  # it predicts less
        (95.0, True, 1.0, set()),  # it was compared with the chosen one as it is
        (95.0, False, 70.0, set()),  # it is about something else
    ],
)
def test_what_predicts_as_well_is_named_though_it_needed_more_tests(
    total: float, significant: bool, beside: float, named: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def candidate(name: str, gained: float, proven: bool) -> Any:
        gain = SimpleNamespace(total=gained, consistent=True)
        return SimpleNamespace(
            model=SimpleNamespace(name=name), significant=proven, assessment=SimpleNamespace(gain=gain)
        )

    chosen, other = candidate("chosen", 77.0, True), candidate("other", total, significant)
    monkeypatch.setattr(rivals, "_beside", lambda *_: (total, 77.0, total + beside))
    assert rivals.as_predictive(chosen, [chosen, other], SimpleNamespace()) == named  # type: ignore[arg-type]
