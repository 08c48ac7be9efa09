"""Which candidate a round keeps: another where the first does not earn its place, and what lasts before an event."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loop_cases import BASE, adopted_names, lasting_effects, linear_state, looked_at, scenario, synthetic, verdict_of

from magtensor.error_models.terms import Terms
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.separation import SECOND_ORDER
from magtensor.loop.searching import by_hand, choosing, outcome, rivals, rounds
from magtensor.loop.searching.course_of_time import BesideTime
from magtensor.loop.searching.gates import ALPHA, Candidate, explained_by
from magtensor.loop.searching.keeping import ONE_OF_A_KIND, Fitted
from magtensor.registry import Registry

EFFECTS = ({"type": "temperature_offset", "rms_nT": 1.0}, {"type": "nonlinearity_cubic", "rms_nT": 0.6})


@pytest.mark.long
def test_what_is_dropped_at_once_does_not_end_the_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first model is dropped at its first trial, as if it raised the error on held-out blocks."""
    first: list[str] = []

    def strict(record: Record, state: State, how: Fitting, fixed: int) -> tuple[State, tuple[str, ...]]:
        if first:
            return state, ()
        first.append(state.adopted[-1].name)
        return rounds.without_models(record, state, [len(state.adopted) - 1], how), (first[0],)

    monkeypatch.setattr(rounds, "eliminate", strict)
    monkeypatch.setattr(rounds.Rounds, "with_another", lambda *_: None)
    survey = scenario(33, *EFFECTS, motion=BASE["motion"] | {"duration_s": 600.0})
    told = verdict_of(tmp_path, survey, models=[str(e["type"]) for e in EFFECTS])

    assert "does not earn its place" in told["steps"][0]["refused"][first[0]]
    assert adopted_names(told) == {"temperature_offset", "nonlinearity_cubic"}  # the first one in the second round
    assert told["steps"][1]["adopted"] == first[0]


def candidate(name: str, gain: float, *, rank: int = 4, passes: bool = True) -> Any:
    component = Registry.load().find("error_model", name)
    assessment = SimpleNamespace(gain=SimpleNamespace(total=gain), estimate=SimpleNamespace(rank=rank))
    return SimpleNamespace(model=Adopted(component, {}), assessment=assessment, passes=passes)


@pytest.mark.parametrize(
    ("other", "instead"),
    [
        (candidate("sampling_lag", 42000.0), True),
        (candidate("sampling_lag", 27000.0), False),  # predicts less
        (candidate("sampling_lag", 42000.0, passes=False), False),
        (candidate("bandwidth", 43000.0, rank=12), False),  # has more coefficients
        (candidate("channel_response", 43000.0), False),  # names nothing
        (candidate("scale_step", 43000.0), False),  # happens once too
    ],
)
def test_a_slip_is_no_simpler_than_a_delay_that_predicts_more(other: Any, instead: bool) -> None:
    slip = candidate("lag_step", 27600.0)
    assert rivals.lasting_instead(slip, [slip, other]) is (other if instead else slip)


def test_what_lasts_stays() -> None:
    delay, drift = candidate("sampling_lag", 100.0), candidate("clock_drift", 200.0)
    assert rivals.lasting_instead(delay, [delay, drift]) is delay


def test_a_small_part_of_what_failed_is_no_candidate() -> None:
    """Every axis of one sensor follows a series of its own, and the output that is tested follows another one too: one
    axis alone is a small part of what all explain, all but one are most of it, and the other series is beside it."""
    rng = np.random.default_rng(4)
    course = np.cumsum(rng.standard_normal((1200, 4)), axis=0)
    course = (course - course.mean(axis=0)) / course.std(axis=0)
    added = np.zeros((1200, 4, 3))
    added[:, 0] = 3.0 * course[:, :3]
    added[:, 1, 0] = 3.0 * course[:, 3]
    state = linear_state(synthetic(8, added=added))
    order = np.arange(4)
    terms = Terms(("x",) * 4, ("S1",) * 3 + ("S2",), ("nT",) * 4, course, order, order, order).at(
        state.residual.samples
    )

    def of(*which: int) -> Any:
        assessment = SimpleNamespace(colours=state.colours, parts=None)
        return SimpleNamespace(terms=terms.only(which), assessment=assessment)

    failed = of(0, 1, 2)
    assert rivals.part_of(of(0), failed, state)
    assert not rivals.part_of(of(0, 1), failed, state)  # a rival that explains most of it
    assert not rivals.part_of(of(3), failed, state)  # something else
    assert not rivals.part_of(of(0, 3), failed, state)
    assert rivals.overlaps(of(0), failed, state) and rivals.overlaps(of(0, 1), failed, state)
    assert not rivals.overlaps(of(3), failed, state)


@pytest.mark.long
def test_of_every_model_it_is_told_why_it_was_not_adopted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first candidate is refused and all others are said to be parts of it, so that nothing is adopted; most
    explain too little to be looked at closely."""
    monkeypatch.setattr(rounds, "fitted", lambda *_: Fitted(None, "refused"))
    monkeypatch.setattr(choosing, "part_of", lambda *_: True)
    survey = scenario(33, *EFFECTS, motion=BASE["motion"] | {"duration_s": 600.0})
    told = verdict_of(tmp_path, survey, models=lasting_effects())

    assert not adopted_names(told)
    refused = told["steps"][0]["refused"]
    first = next(name for name, why in refused.items() if why == "refused")
    parts = {why for name, why in refused.items() if name != first}
    assert parts == {f"a small part of what {first} explains, which failed"}
    why = {r["error_model"]: r["why"] for r in told["rejected"]}
    named = [*why, *(n["error_model"] for n in told["not_tested"])]
    assert set(named) | {"latent_source"} == set(lasting_effects())  # that one is asked for in a way of its own
    assert len(named) == len(set(named))
    screened = {name for name, told in why.items() if told.startswith("screened")}
    assert screened and not screened & {c["error_model"] for step in told["steps"] for c in step["looked_at"]}


def nothing_said(monkeypatch: pytest.MonkeyPatch, **does: Any) -> None:
    """Nothing is said against a candidate before it is fitted, or what is given by name."""
    silent: dict[str, Any] = {
        **dict.fromkeys(("containing", "by_its_name"), lambda best, *_: best),
        **dict.fromkeys(("simplest", "nearest"), lambda chosen, *_: (chosen, ())),
        **dict.fromkeys(("part_of_a_drift", "hindered_by_another"), lambda *_: None),
        **dict.fromkeys(("rate_instead", "part_of_a_larger_law", "part_of_a_gradient"), lambda *_: ""),
        **dict.fromkeys(("outdone_by", "part_of_a_waveform"), lambda *_: ""),
        **dict.fromkeys(("as_predictive", "by_a_worse_log"), lambda *_: set()),
        **dict.fromkeys(("switched_with", "channels_in_time"), lambda *_: ()),
        "beside_time": lambda *_: BesideTime(True),
        "is_a_course": lambda *_: False,
    }
    for name, what in (silent | does).items():
        modules = [m for m in (choosing, rounds) if hasattr(m, name)]
        assert modules, name
        for module in modules:
            monkeypatch.setattr(module, name, what)


@pytest.mark.parametrize("why", [ONE_OF_A_KIND, "fitted, it raises the held-out error of S1"])
def test_what_another_width_of_an_adopted_law_explains_is_no_other_effect(
    why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two widths that a joint fit moves together are one law, which leaves something; what fails otherwise does not
    stand for anything."""
    width, creep, other = (candidate(n, g) for n, g in (("hysteresis", 9.0), ("bandwidth", 6.0), ("eddy_current", 5.0)))
    tried: list[str] = []

    def fitted(record: Any, before: Any, chosen: Any, how: Any) -> Fitted:
        tried.append(chosen.model.name)
        return Fitted(None, why if chosen is width else "it leaves more than it takes away")

    overlap = {"part_of": lambda *_: False, "overlaps": lambda c, failed, _: failed is width and c is creep}
    nothing_said(monkeypatch, fitted=fitted, **overlap)
    for each in (width, creep, other):
        each.predicts = True
    given: Any = SimpleNamespace(state=SimpleNamespace(excitation=None))
    search = rounds.Rounds([], 0, 8, 0.005, None, None)
    found = search.first_kept(given, given, [width, creep, other], given, 30)
    assert found.standing is None and found.refused["hysteresis"] == why
    one = why == ONE_OF_A_KIND
    assert tried == ["hysteresis", *([] if one else ["bandwidth"]), "eddy_current"]
    assert ("the law of hysteresis leaves" in found.refused["bandwidth"]) == one
    del tried[:]
    few = search.first_kept(given, given, [width, creep, other], given, 30, most_fits=1)
    assert few.standing is None and tried == ["hysteresis"]


def test_of_one_name_the_curve_of_another_channel_is_still_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    """A response to one channel is refused, for any curve of another one explains more; that curve has its turn, once,
    though it has the same name."""
    line, curve = candidate("channel_response", 9.0), candidate("channel_response", 5.0)
    for each in (line, curve):
        each.predicts = True
    asked: list[str] = []

    def curves(channel: str, *_: Any) -> list[Any]:
        asked.append(channel)
        return [curve]

    nothing_said(
        monkeypatch,
        fitted=lambda *_: Fitted(None, "refused"),
        outdone_by=lambda chosen, _: "wind" if chosen is line else "",
        by_any_law_of=curves,
    )
    given: Any = SimpleNamespace(state=SimpleNamespace(excitation=None, adopted=()))
    monkeypatch.setattr(rounds.Rounds, "open_models", lambda *_: [])
    search = rounds.Rounds([], 0, 8, 0.005, None, None)
    told: list[str] = []
    search.say = told.append
    found = search.first_kept(given, given, [line], given, 30)
    assert found.standing is None and asked == ["wind"] and told == ["adopting channel_response"]
    assert found.refused == {"channel_response": "refused"}


@pytest.mark.parametrize(("rises", "part"), [(lambda t: t, "offset_drift"), (lambda t: np.sign(t - 0.1), "")])
def test_a_step_is_no_part_of_a_drift_unless_it_is(rises: Any, part: str) -> None:
    """An offset that rises all the time has a place where it seems to step, and one that steps is no drift."""
    added = np.zeros((1200, 4, 3))
    added[:, 0] = 1.5 * rises(np.linspace(-1.0, 1.0, 1200))[:, None] * np.array([1.0, -0.5, 0.7])
    state = linear_state(synthetic(9, added=added))
    found = [
        by_hand.candidate(Registry.load().find("error_model", name), {}, state, 30, ALPHA)
        for name in ("offset_step", "offset_drift", "scale_drift")
    ]
    step, drift, _ = found
    assert max(step.assessment.gain.total, drift.assessment.gain.total) > 100.0

    def whole_of(*candidates: Candidate) -> str:
        lasting = rivals.part_of_a_drift(step, candidates, state)
        assert lasting is None or not lasting.of_an_event  # it follows no channel
        return lasting.model.name if lasting else ""

    assert whole_of(*found) == part
    assert not rivals.part_of_a_drift(drift, found, state)  # it lasts
    for null_p in (0.9 * ALPHA, 1.1 * ALPHA):
        doubtful = replace(unevenly(drift), adjusted_null_p=null_p)
        assert whole_of(step, doubtful) == (part if null_p < ALPHA else "")


def test_what_an_event_is_a_part_of_is_judged_where_that_was() -> None:
    """A heater that ran twice, briefly: blocks hardly tell it from chance, but what happened once at one of the times
    does, and the heater predicts that and the other."""
    current = np.zeros(1200)
    current[[*range(505, 535), *range(905, 925)]] = 1.0
    added = 1.2 * current[:, None, None] * np.random.default_rng(2).standard_normal((4, 3))
    record = replace(synthetic(9, added=added), logged={"current_heater": current - current.mean()})
    record = replace(record, units={"current_heater": "A"}, origins={"current_heater": current.mean()})
    state = linear_state(record)
    event, heater = (
        by_hand.candidate(Registry.load().find("error_model", name), {}, state, 30, ALPHA)
        for name in ("offset_while", "current_field")
    )
    doubtful = replace(heater, adjusted_p=0.5, adjusted_own_p=0.5)
    assert event.passes and not doubtful.passes
    lasting = rivals.part_of_a_drift(event, [event, doubtful], state)
    assert lasting is not None and lasting.model.name == "current_field"
    assert lasting.of_an_event and lasting.passes and lasting.assessment.parts is event.assessment.parts
    assert lasting.assessment.gain.total > event.assessment.gain.total


def unevenly(drift: Candidate) -> Candidate:
    """The same gain, nearly all of it in two folds."""
    gain = drift.assessment.gain
    each = np.full(len(gain.values), -0.01 * gain.total)
    each[:2] += (gain.total - each.sum()) * np.array([0.8, 0.2])
    found = replace(gain, after=gain.before - each)
    assert not found.consistent and found.total == pytest.approx(gain.total)
    return replace(drift, assessment=replace(drift.assessment, gain=found))


@pytest.mark.parametrize(("gain", "words"), [(90.0, "drift explained more"), (110.0, "drift is simpler")])
def test_what_gives_way_is_told_whether_it_explained_less(
    gain: float, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def candidate(name: str, gain: float) -> Any:
        figures = SimpleNamespace(gain=SimpleNamespace(total=gain, t=5.0))
        passing = {"significant": True, "beyond_slow_noise": True, "passes": True, "alpha": 0.005}
        refused = dict.fromkeys(
            ("of_the_log", "of_second_order", "of_the_law", "of_no_shape", "of_no_blocks", "log_noise"), False
        )
        p = {"adjusted_p": 1e-9, "adjusted_own_p": 1e-9}
        return SimpleNamespace(model=SimpleNamespace(name=name), assessment=figures, **passing, **refused, **p)

    monkeypatch.setattr(outcome, "happens_once", lambda _: False)
    assert outcome.why(candidate("tone", gain), candidate("drift", 100.0)).startswith(words)


@pytest.mark.parametrize("seed", [1, 8])
def test_a_mount_that_slipped_is_no_part_of_what_a_current_bends(seed: int) -> None:
    """Of a current seen through a lag longer than the survey, whose log's noise might explain what it is behind by if
    that were not seen in what it leaves, which is far louder."""
    plain, rng = synthetic(seed, 2400, noise_nT=0.2, turning_s=6.0), np.random.default_rng(seed)
    amperes = np.array([2.5, 4.0, 1.0, 2.5, 4.0, 0.0, 4.0, 0.0, 4.0, 2.5, 0.0, 1.0])
    on = amperes[np.searchsorted(np.sort(rng.uniform(0.0, 2400.0, 11)), plain.time)]
    raw = plain.raw.copy()
    raw[1320:, 1] += 7e-4 * np.cross(plain.raw[1320:, 1], [0.3, -0.8, 0.5])
    logged = {"current_motor": on - on.mean() + 0.03 * rng.standard_normal(2400)}
    record = replace(
        plain, raw=raw, logged=logged, origins={"current_motor": np.zeros(())}, units={"current_motor": "A"}
    )
    state, registry = linear_state(record), Registry.load()
    bends = {"channel": "current_motor", "lag_s": 1800.0, "smooth": False, "angles": 3}
    slipped = looked_at(state, Adopted(registry.find("error_model", "turn_step"), {"time_s": 1319.5, "angles": 3}))
    bent = looked_at(state, Adopted(registry.find("error_model", "channel_alignment"), bends))
    assert slipped.assessment.gain.total > 100.0 * bent.assessment.gain.total
    assert rivals.part_of_a_drift(slipped, [slipped, bent], state) is None


def test_what_was_dropped_for_its_next_order_is_a_rival() -> None:
    """A jump in the place of one with fewer coefficients: the law of a large one may miss as much as it adds."""
    added = np.zeros((1200, 4, 3))
    added[700:, 1] = [300.0, -200.0, 100.0]
    model = Adopted(Registry.load().find("error_model", "offset_step"), {"time_s": 699.5})
    state = joint_state(synthetic(9, added=added), [model], Fitting())
    whole = explained_by(state, [0])
    assert whole > 1e6
    for share, alike in ((0.9, {"offset_step"}), (1.1, set())):
        gain = SimpleNamespace(total=share * SECOND_ORDER * whole)
        chosen: Any = SimpleNamespace(assessment=SimpleNamespace(gain=gain), before=None)
        assert rivals.hardly_less(chosen, ("offset_step", "scale_step"), state) == alike
