"""What is small beside something larger that nobody named, and follows the attitude as that does, is not adopted."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import BASE, adopted_names, loaded, scenario, synthetic, verdict_of
from scipy.signal import lfilter

from magtensor.errors import DataError
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching import latent, overshadowed, rounds, search
from magtensor.loop.searching.contribution import borne_out, possible_without, without_models
from magtensor.loop.searching.found import Search
from magtensor.loop.searching.overshadowed import attitude_share, of_a_restless_station, of_nothing, of_what_is_left_out
from magtensor.registry import Registry

MODELS = ("nonlinearity_quadratic", "nonlinearity_cubic", "current_field", "site_gradient")


SHORT = BASE["motion"] | {"duration_s": 700.0}


def gradient(rms_nT: float) -> dict[str, Any]:
    """Of the site, whose attitude nobody logs here."""
    return {"type": "site_gradient", "rms_nT": rms_nT}


@pytest.mark.long
@pytest.mark.parametrize("seen_at_once", [True, False])
def test_a_gradient_without_attitude_is_no_nonlinearity(
    seen_at_once: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the shape of what it explains; and without that rule by what it leaves, once nothing else is adopted."""
    if not seen_at_once:
        monkeypatch.setattr(rounds, "part_of_a_gradient", lambda *_: "")
    told = verdict_of(tmp_path, scenario(21, gradient(0.6), motion=SHORT), models=MODELS)
    assert adopted_names(told) == set()
    assert {n["error_model"]: n["missing"] for n in told["not_tested"]} == {"site_gradient": ["attitude"]}
    assert told["unexplained"]["present"] and told["unexplained"]["excess_rms_nT"] > 0.4
    assert told["unexplained"]["looks_like"][0] == "site_gradient"
    assert "cannot be tested without attitude" in told["unexplained"]["description"]
    why = {r["error_model"]: r["why"] for r in told["rejected"]}["nonlinearity_quadratic"]
    if seen_at_once:
        assert "has the shape of a uniform gradient" in why
    else:
        assert "follows the attitude" in why and "nT that stay" in why
        assert told["steps"][0]["adopted"] == "nonlinearity_quadratic" and told["steps"][-1]["refused"]


@pytest.mark.long
def test_larger_effects_and_those_that_do_not_follow_the_attitude_are_kept_beside_it(tmp_path: Path) -> None:
    effects = (
        {"type": "nonlinearity_cubic", "rms_nT": 4.0},
        {"type": "current_field", "channel": "current_heater", "rms_nT": 0.3},
        gradient(0.8),
    )
    told = verdict_of(tmp_path, scenario(23, *effects, motion=SHORT), models=MODELS)
    assert adopted_names(told) == {"nonlinearity_cubic", "current_field"}
    assert told["unexplained"]["present"] and told["unexplained"]["excess_rms_nT"] > 0.5


@pytest.mark.long
def test_what_happens_once_overshadows_nothing(tmp_path: Path) -> None:
    passing = {
        "type": "passing_source",
        "time_s": 350.0,
        "closest_m": [12.0, 0.0, 0.0],
        "velocity_m_s": [0.0, 0.5, 0.0],
    }
    effects = ({"type": "nonlinearity_quadratic", "rms_nT": 0.15}, passing | {"rms_nT": 0.6})
    told = verdict_of(tmp_path, scenario(25, *effects, motion=SHORT), models=(*MODELS, "passing_source"))
    assert "nonlinearity_quadratic" in adopted_names(told)
    assert adopted_names(told) <= {"nonlinearity_quadratic", "passing_source"}


@pytest.mark.parametrize(("after", "taken"), [(0.126, True), (0.1182, False), (0.08, False)])
def test_what_held_out_blocks_are_predicted_worse_with_is_taken_out(
    after: float, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = synthetic(5, 400)
    step = Adopted(Registry.load().find("error_model", "offset_step"), {"time_s": 200.0})
    state = joint_state(record, [step], Fitting())
    found: Any = SimpleNamespace(told=state, last=state, steps=(), record=record, shared=None)
    monkeypatch.setattr(overshadowed, "staying", lambda _: 0.0)
    monkeypatch.setattr(overshadowed, "without_and_with", lambda *_: (0.118, after))
    monkeypatch.setattr(overshadowed, "_part_of_a_source", lambda *_: None)
    why = overshadowed.overshadowed(found, 0)
    assert (
        why is not None and why[0] == [0] and "better without it (0.118 nT rms) than with (0.126)" in why[1]
    ) is taken


def test_how_much_of_an_effect_follows_the_attitude(tmp_path: Path) -> None:
    effects = [
        {"type": "eddy_current", "rms_nT": 1.0},
        {"type": "current_field", "channel": "current_heater", "rms_nT": 1.0},
    ]
    record = loaded(tmp_path, scenario(24, *effects, motion=SHORT))
    registry = Registry.load()
    settings = {"eddy_current": {}, "current_field": {"channel": "current_heater"}}
    adopted = [Adopted(registry.find("error_model", n), s) for n, s in settings.items()]
    state = joint_state(record, adopted, Fitting())
    assert attitude_share(state, [0]) > 0.95
    assert attitude_share(state, [1]) < 0.1


@pytest.mark.long
@pytest.mark.parametrize("seed", [60, 68], ids=["a step of it", "like the temperature by chance"])
def test_what_switches_a_few_times_is_no_step_and_nothing_that_passed(seed: int, tmp_path: Path) -> None:
    source = {"type": "latent_source", "waveform_of": {"type": "switched", "mean_hold_s": 200.0}, "rms_nT": 2.0}
    told = verdict_of(tmp_path, scenario(seed, source), models=["offset_step", "passing_source", "latent_source"])
    assert adopted_names(told) == {"latent_source"}
    assert not told["unexplained"]["present"]
    assert told["steps"][0]["adopted"] in ("offset_step", "passing_source")  # what it is about


@pytest.mark.long
def test_a_source_that_is_taken_out_again_does_not_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is taken out, a source is looked for once more; the search would not end if that found it again."""

    def doubted(found: Search, fixed: int) -> tuple[list[int], str] | None:
        return ([0], "it is doubted here") if found.last.adopted else None

    monkeypatch.setattr(search, "overshadowed", doubted)
    source = {"type": "latent_source", "waveform_of": {"type": "smooth", "rms": 2.0, "time_s": 60.0}, "rms_nT": 2.0}
    told = verdict_of(tmp_path, scenario(69, source), models=["latent_source", "offset_drift"])
    assert told["adopted"] == []
    assert [s["adopted"] for s in told["steps"]] == ["latent_source", None, None]
    assert told["steps"][-1]["refused"] == {"latent_source": "it is doubted here"}


def test_a_noisy_base_station_overshadows_nothing_that_the_sensors_show(tmp_path: Path) -> None:
    """What stays is in |b| - F alone and does not follow the attitude: no law of the attitude, of which a
    nonlinearity may be a part."""

    def wandering(path: Path) -> None:
        with h5py.File(path, "a") as file:
            field = file["reference/total_field"]
            steps = np.random.default_rng(4).standard_normal(len(field))
            field[:] = field[:] + 2.0 * lfilter([1.0], [1.0, -0.9], steps) * np.sqrt(1.0 - 0.81)

    effect = {"type": "nonlinearity_quadratic", "rms_nT": 0.25}
    told = verdict_of(tmp_path, scenario(26, effect, motion=SHORT), wandering, MODELS)
    assert told["unexplained"]["excess_rms_nT"] > 0.25  # more than the effect
    assert adopted_names(told) == {"nonlinearity_quadratic"}
    assert told["unexplained"]["present"] and "an error of the base station" in told["unexplained"]["description"]


def test_a_base_station_whose_noise_is_all_that_is_left_is_named(tmp_path: Path) -> None:
    """Between readings of white noise its field is no white noise, and of all sensors alike."""
    noisy = BASE["base_station"] | {"noise_sd_nT": 1.2}
    told = verdict_of(tmp_path, scenario(27, motion=SHORT, base_station=noisy), models=MODELS)
    assert adopted_names(told) == set()
    assert not told["unexplained"]["present"], told["unexplained"]["description"]
    said = re.search(
        r"the base station's own noise (makes ([\d.]+) nT|may make all) of it", told["unexplained"]["description"]
    )
    assert said and (said[2] is None or float(said[2]) < told["unexplained"]["excess_rms_nT"])


@pytest.mark.parametrize(("lost", "better", "kept"), [(1, 0.5, True), (1, -0.1, False), (100, 0.5, False)])
def test_a_source_in_the_place_of_a_step_may_cost_samples_that_do_not_make_it_better(
    lost: int, better: float, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hundred samples in a thousand that are left out may by themselves make what stays the likelier."""

    def state(believed: int) -> Any:
        return SimpleNamespace(
            adopted=[SimpleNamespace(name="offset_while")],
            fit=SimpleNamespace(keep=np.arange(1000) < believed),
            residual=SimpleNamespace(affine=np.ones((believed, 4))),
        )

    before, source = state(1000), SimpleNamespace(after=state(1000 - lost))
    monkeypatch.setattr(latent, "possible_without", lambda *_: state(1000))
    monkeypatch.setattr(latent, "sought", lambda *_, **__: object())
    monkeypatch.setattr(latent, "tried_source", lambda *_: (None, source))
    monkeypatch.setattr(latent, "per_sample", lambda s: better if s is source.after else 0.0)
    left: Any = SimpleNamespace(left_by="offset_while", significant=False)
    given: Any = None
    found = latent.source_instead(given, given, before, left, given, 0, 0.005)
    assert (found is not None) == kept


def test_of_two_of_a_kind_one_may_have_taken_the_source_and_the_other_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """A temperature through a lag that bends along the source's waveform, and the one that the sensors feel."""

    def state(*lags: float) -> Any:
        return SimpleNamespace(
            adopted=[SimpleNamespace(name="temperature_offset", lag=lag) for lag in lags],
            fit=SimpleNamespace(keep=np.ones(1000, dtype=bool)),
            residual=SimpleNamespace(affine=np.ones((1000, 4))),
        )

    def without(_: Any, of: Any, places: list[int], how: Any) -> Any:
        return state(*(a.lag for i, a in enumerate(of.adopted) if i not in places))

    def tried(_: Any, record: Any, of: Any, *__: Any) -> tuple[None, Any]:
        return None, SimpleNamespace(after=of) if [a.lag for a in of.adopted] != [] else None

    monkeypatch.setattr(latent, "possible_without", without)
    monkeypatch.setattr(latent, "sought", lambda *_, **__: object())
    monkeypatch.setattr(latent, "tried_source", tried)
    monkeypatch.setattr(latent, "per_sample", lambda s: {(40.0,): 3.0, (-180.0,): 1.0}.get(_lags(s), 2.0))
    left: Any = SimpleNamespace(left_by="temperature_offset", significant=False)
    given: Any = None
    found = latent.source_instead(given, given, state(-180.0, 40.0), left, given, 0, 0.005)
    assert found is not None and _lags(found.after) == (40.0,)


def _lags(state: Any) -> tuple[float, ...]:
    return tuple(a.lag for a in state.adopted)


def test_a_response_to_the_acceleration_follows_the_attitude_through_any_lag(tmp_path: Path) -> None:
    logging = {"attitude": True, "acceleration": True}
    record = loaded(tmp_path, scenario(86, {"type": "offset_drift", "rms_nT": 1.0}, logging=logging))
    model = Registry.load().find("error_model", "channel_response")
    for channel, follows in (("acceleration", True), ("temperature", False)):
        state = joint_state(record, [Adopted(model, {"channel": channel, "power": 2, "lag_s": 400.0})], Fitting())
        assert overshadowed._follows_a_vector(state, [0]) is follows
        assert overshadowed._of_the_attitude(state, [0]) or not follows


@pytest.mark.parametrize(("effects", "kept"), [([], False), ([{"type": "temperature_offset", "rms_nT": 1.0}], True)])
def test_what_is_left_after_others_are_taken_out_has_to_serve(
    effects: list[dict[str, Any]], kept: bool, tmp_path: Path
) -> None:
    record = loaded(tmp_path, scenario(87, *effects))
    model = Adopted(Registry.load().find("error_model", "temperature_offset"), {"order": 1, "channel": "temperature"})
    state, dropped = borne_out(record, joint_state(record, [model], Fitting()), Fitting(), 0)
    assert [a.name for a in state.adopted] == ["temperature_offset"] * kept
    assert dropped == ("temperature_offset",) * (not kept)


@pytest.mark.parametrize("along", [True, False])
def test_a_step_along_whose_vector_more_is_left_out_is_a_part_of_that(along: bool) -> None:
    """A source that acts by a law of its own, most of it left out: its last switch seems to be a step."""
    vectors = np.random.default_rng(4).standard_normal((2, 4, 3))
    after = np.arange(1200) > 1000
    record = synthetic(14, added=4.0 * after[:, None, None] * vectors[0])
    found = search.search(record, [Registry.load().find("error_model", "offset_step")], Fitting())
    assert [a.name for a in found.last.adopted] == ["offset_step"]
    assert of_what_is_left_out(found, 0) is None
    out = (np.arange(1200) > 300) & (np.arange(1200) < 600)
    raw = record.raw + 8.0 * out[:, None, None] * vectors[0 if along else 1]
    keep = found.last.fit.keep & ~out
    last = replace(found.last, fit=replace(found.last.fit, keep=keep))
    left_out = replace(found, record=replace(record, raw=raw), last=last, evenly=None)
    doubted = of_what_is_left_out(left_out, 0)
    assert (doubted is not None) is along
    if doubted is not None:
        assert doubted[0] == [0] and "299 samples" in doubted[1]


@pytest.mark.parametrize(
    ("name", "passes", "p"),
    [
        ("offset_while", False, 0.0),
        ("offset_while", True, 0.0),
        ("offset_while", False, 0.1),
        ("scale_drift", False, 0.0),
    ],
)
def test_more_of_the_kind_that_predicts_nothing_makes_an_event_no_lone_one(name: str, passes: bool, p: float) -> None:
    registry = Registry.load()
    adopted = Adopted(registry.find("error_model", name), {"time_s": 100.0, "until_s": 200.0})
    step = Adopted(registry.find("error_model", "offset_step"), {"time_s": 700.0})
    beside: Any = SimpleNamespace(
        model=step, passes=passes, adjusted_p=p, adjusted_own_p=p, adjusted_null_p=p, alpha=0.005
    )
    found: Any = SimpleNamespace(steps=(SimpleNamespace(candidates=(beside,)),))
    state: Any = SimpleNamespace(adopted=(adopted,))
    told = overshadowed._of_what_wanders(found, state, [0])
    others = "not the only such event (offset_step beside it"
    assert (others in told) is (name == "offset_while" and not passes and p == 0.0)


@pytest.mark.parametrize("name", ["offset_step", "turn_step"])
def test_a_step_before_which_nothing_is_in_use_tells_nothing(name: str) -> None:
    record = synthetic(14)
    model = Adopted(Registry.load().find("error_model", name), {"time_s": 300.5})
    state = joint_state(record, [model], Fitting())
    assert of_nothing(state, 0) is None
    part = state.residual
    late = replace(state, residual=replace(part, samples=part.samples[310:], affine=part.affine[310:]))
    found = of_nothing(late, 0)
    assert found is not None and found[0] == [0] and of_nothing(late, 1) is None


@pytest.mark.parametrize("sensor", [1, 2])
def test_an_event_of_a_sensor_that_does_other_things_too_is_no_lone_one(sensor: int) -> None:
    """Its axes are magnetised one way and the other, each by itself; one that stayed so for long seems to be an event.
    Beside the same of another sensor it may be one."""
    record = synthetic(16)
    raw, share = record.raw.copy(), np.zeros((1200, 3))
    raw[300:800, 1, 2] += 6.0
    share[50:170, 0], share[850:1100, 1] = 6.0, -6.0
    found = search.search(replace(record, raw=raw), [Registry.load().find("error_model", "offset_while")], Fitting())
    assert [(a.name, a.sensors) for a in found.last.adopted] == [("offset_while", ("S2",))]
    raw[:, sensor] += share
    last = replace(found.last, fit=replace(found.last.fit, keep=found.last.fit.keep & ~share.any(axis=1)))
    doubted = of_what_is_left_out(replace(found, record=replace(record, raw=raw), last=last, evenly=None), 0)
    assert (doubted is not None) is (sensor == 1)
    if doubted is not None:
        assert doubted[0] == [0] and "it does more than such events tell" in doubted[1]


def test_a_step_that_is_undone_at_other_times_is_a_part_of_what_switches() -> None:
    """On for a while before the step, off for a while after it, all of that left out: as large either way round."""
    vector = np.random.default_rng(4).standard_normal((4, 3))
    record = synthetic(14, added=4.0 * (np.arange(1200) > 700)[:, None, None] * vector)
    found = search.search(record, [Registry.load().find("error_model", "offset_step")], Fitting())
    share = np.zeros(1200)
    share[300:340], share[900:940] = 1.0, -1.0
    raw = record.raw + 4.0 * share[:, None, None] * vector
    last = replace(found.last, fit=replace(found.last.fit, keep=found.last.fit.keep & (share == 0.0)))
    doubted = of_what_is_left_out(replace(found, record=replace(record, raw=raw), last=last, evenly=None), 0)
    assert doubted is not None and doubted[0] == [0] and "and is as large" in doubted[1]


@pytest.mark.parametrize(("phases", "told"), [(1, False), pytest.param(3, True, marks=pytest.mark.long)])
def test_what_comes_and_goes_along_one_vector_is_one_source(phases: int, told: bool) -> None:
    """Though offsets for a while explain all of it: one of them may be a tool that lay there, three are a source."""
    vectors = np.random.default_rng(6).standard_normal((4, 3))
    edges = np.array([150, 330, 480, 620, 800, 1010])[: 2 * phases]
    on = np.searchsorted(edges, np.arange(1200), side="right") % 2
    record = synthetic(15, added=4.0 * on[:, None, None] * vectors)
    found = search.search(record, [Registry.load().find("error_model", "offset_while")], Fitting())
    assert [a.name for a in found.last.adopted] == ([] if told else ["offset_while"])
    whys = [why for step in found.steps for why in step.refused.values()]
    assert any("switches along one vector" in why for why in whys) is told


def test_what_the_others_need_to_be_calibrated_stays() -> None:
    """A current that makes as much of one sensor as the field does: without it that sensor sees another field."""
    rng = np.random.default_rng(11)
    current = rng.standard_normal(1200)
    made = np.zeros(12)
    made[3:6] = 20_000.0, -10_000.0, 14_000.0
    added = current[:, None, None] * made.reshape(4, 3)
    record = synthetic(12, added=added)
    record = replace(record, logged={"pump": current}, units={"pump": "A"}, origins={"pump": 0.0})
    model = Adopted(Registry.load().find("error_model", "channel_response"), {"channel": "pump", "power": 1})
    state = joint_state(record, [model], Fitting(), [made])
    with pytest.raises(DataError, match="does not see the field that the others see"):
        without_models(record, state, [0], Fitting())
    assert possible_without(record, state, [0], Fitting()) is None
    kept, dropped = borne_out(record, state, Fitting(), 0)
    assert kept is state and dropped == ()


@pytest.mark.parametrize("wanders_nT", [0.0, 3.0])
def test_a_small_error_of_a_base_station_that_wanders_is_a_part_of_that(wanders_nT: float) -> None:
    """A clock that is five seconds late, and one that seems so beside a wander of minutes."""
    record = synthetic(15, 1200, noise_nT=0.2)
    assert record.total_field is not None
    late = 50_000.0 + 10.0 * np.sin((np.arange(1200) - 5.0) / 90.0)
    own = lfilter([1.0], [1.0, -0.99], np.random.default_rng(3).standard_normal(1200))
    recorded = (late if wanders_nT == 0.0 else record.total_field) + wanders_nT * own / own.std()
    record = replace(record, total_field=recorded, quiet_field=recorded)
    clock = Adopted(Registry.load().find("error_model", "reference_clock"), {"lag_s": 0.0})
    found = search.search(record, [], Fitting())
    doubted = of_a_restless_station(replace(found, last=joint_state(record, [clock], Fitting())), 0)
    assert (doubted is not None) is (wanders_nT > 0.0)
    if doubted is not None:
        assert doubted[0] == [0] and "nT that stay of it" in doubted[1]
