"""What explained more while another effect had no name gives way to the simpler model that does as well beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import BASE, adopted_names, linear_state, looked_at, scenario, synthetic, verdict_of

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.trial import per_sample
from magtensor.loop.searching.exchange import exchange, exchanged
from magtensor.loop.searching.found import Step
from magtensor.registry import Registry

MODELS = ("site_gradient", "fixed_source", "nonlinearity_cubic")
LOGGED: dict[str, Any] = {"motion": BASE["motion"] | {"duration_s": 600.0}, "logging": {"attitude": True}}


@pytest.mark.long
def test_a_gradient_beside_a_nonlinearity_is_no_source_near_the_rig(tmp_path: Path) -> None:
    effects = ({"type": "site_gradient", "rms_nT": 0.5}, {"type": "nonlinearity_cubic", "rms_nT": 0.3})
    told = verdict_of(tmp_path, scenario(31, *effects, **LOGGED), models=MODELS)

    assert told["steps"][0]["adopted"] == "fixed_source"  # what this is about
    assert adopted_names(told) == {"site_gradient", "nonlinearity_cubic"}
    gradient = next(a for a in told["adopted"] if a["error_model"] == "site_gradient")
    assert gradient["indistinguishable_from"] == ["fixed_source"] and gradient["evidence"]["z"] > 5.0
    assert "fewer coefficients" in told["steps"][-2]["refused"]["fixed_source"]
    why = {r["error_model"]: r["why"] for r in told["rejected"]}["fixed_source"]
    assert "not significant" in why  # beside the gradient


@pytest.mark.long
def test_a_source_near_the_rig_beside_a_nonlinearity_stays(tmp_path: Path) -> None:
    effects = (
        {"type": "fixed_source", "rms_nT": 1.0, "position_m": [2.0, 0.5, 0.3]},
        {"type": "nonlinearity_cubic", "rms_nT": 0.3},
    )
    told = verdict_of(tmp_path, scenario(32, *effects, **LOGGED), models=MODELS)

    assert adopted_names(told) == {"fixed_source", "nonlinearity_cubic"}


@pytest.mark.parametrize(("lag_s", "takes_its_place"), [(60.0, True), (5000.0, False)])
def test_a_channel_through_a_lag_longer_than_the_survey_is_no_simpler_drift(
    lag_s: float, takes_its_place: bool
) -> None:
    """A drift of the second order, and a temperature that goes its way: through such a lag any does."""
    registry = Registry.load()
    time = np.arange(1200) / 1200.0
    course = time**2
    rng = np.random.default_rng(3)
    raw = synthetic(51, noise_nT=0.3, turning_s=4.0).raw
    drifting = raw * 2e-5 * course[:, None, None] * rng.standard_normal((4, 3))
    temperature = 20.0 + 10.0 * (course + lag_s * 2.0 * time / 1200.0)  # seen through the lag it is the course
    record = replace(
        synthetic(51, noise_nT=0.3, turning_s=4.0, added=drifting), logged={"temperature": temperature},
        origins={"temperature": np.zeros(())}, units={"temperature": "degC"},
    )  # fmt: skip
    state = linear_state(record)
    drift, other = (registry.find("error_model", name) for name in ("scale_drift", "temperature_scale"))
    settings = {"order": 1, "channel": "temperature", "lag_s": lag_s, "delayed": False, "at_start": 0.0}
    first, second = (
        looked_at(state, Adopted(drift, {"order": 2, "span_s": 1200.0})),
        looked_at(state, Adopted(other, settings)),
    )
    assert first.passes and second.passes
    adopted = [first.model, Adopted(registry.find("error_model", "cross_field"), {})]
    after = joint_state(record, adopted, Fitting())
    found = exchange(after, [Step(state, (first, second), first)], 0)
    assert (found is not None and found.other.model.name == "temperature_scale") is takes_its_place


@pytest.mark.parametrize("warms", [True, False])
def test_what_predicts_better_takes_the_place_of_what_was_adopted(warms: bool) -> None:
    """A temperature that rises and sways, and a line in time, of as many coefficients."""
    registry = Registry.load()
    time = np.arange(1200) / 1200.0
    sways = time + 0.3 * np.sin(2.0 * np.pi * 3.0 * time)
    plain = synthetic(51, noise_nT=0.3, turning_s=4.0)
    drawn = np.random.default_rng(3).standard_normal((4, 3))
    added = plain.raw * 2e-5 * (sways if warms else time)[:, None, None] * drawn
    record = replace(
        synthetic(51, noise_nT=0.3, turning_s=4.0, added=added), logged={"temperature": 20.0 + 10.0 * sways},
        origins={"temperature": np.zeros(())}, units={"temperature": "degC"},
    )  # fmt: skip
    state = linear_state(record)
    drift, other = (registry.find("error_model", name) for name in ("scale_drift", "temperature_scale"))
    settings = {"order": 1, "channel": "temperature", "lag_s": 0.0, "delayed": False, "at_start": 0.0}
    first, second = (
        looked_at(state, Adopted(drift, {"order": 1, "span_s": 1200.0})),
        looked_at(state, Adopted(other, settings)),
    )
    assert first.passes and second.passes and first.terms.count == second.terms.count
    adopted = [first.model, Adopted(registry.find("error_model", "cross_field"), {})]
    found = exchange(joint_state(record, adopted, Fitting()), [Step(state, (first, second), first)], 0)
    assert (found is not None) is warms
    if found is not None:
        assert found.better and found.other.model.name == "temperature_scale"
        assert "temperature_scale" in found.why and "better" in found.why


def test_what_has_fewer_coefficients_need_not_fit_all_samples_as_well() -> None:
    """A jump of one sensor's offset; a change of its whole calibration fits a little more noise, and predicts worse."""
    registry = Registry.load()
    added = np.zeros((1200, 4, 3))
    added[700:, 0] = [9.0, 6.0, -5.0]
    record = synthetic(53, noise_nT=0.5, turning_s=4.0, added=added)
    state = linear_state(record)
    whole, jump = (registry.find("error_model", name) for name in ("calibration_step", "offset_step"))
    first, second = (looked_at(state, Adopted(m, {"time_s": 700.0}, ("S1",))) for m in (whole, jump))
    assert first.passes and second.passes and first.terms.count > second.terms.count
    adopted = [first.model, Adopted(registry.find("error_model", "cross_field"), {})]
    both = joint_state(record, adopted, Fitting())
    found = exchange(both, [Step(state, (first, second), first)], 0)
    assert found is not None and found.better and found.fewer  # what this is about
    instead = exchanged(record, both, [Step(state, (first, second), first)], Fitting(), 0, 2)
    assert instead is not None
    after = instead[0].state
    assert per_sample(after) < per_sample(both)
    assert [a.name for a in after.adopted] == ["cross_field", "offset_step"] and after.adopted[1].sensors == ("S1",)


@pytest.mark.long
def test_a_temperature_refused_for_a_drift_beside_a_flexure_is_asked_again(tmp_path: Path) -> None:
    """While the flexure has no name, smooth courses of time follow a part of it, and seem to know more than the
    temperature."""
    effects = ({"type": "frame_flexure", "rms_nT": 1.0}, {"type": "temperature_alignment", "rms_nT": 1.0})
    motion = {"type": "limited_tilt", "duration_s": 1200.0, "tilt_deg": 40.0}
    logging = {"attitude": True, "acceleration": True}
    models = ("frame_flexure", "temperature_alignment", "alignment_drift", "turn_step")
    for seed in (33, 34):
        told = verdict_of(tmp_path, scenario(seed, *effects, motion=motion, logging=logging), models=models)
        assert adopted_names(told) == {"frame_flexure", "temperature_alignment"}
        assert not told["unexplained"]["present"], told["unexplained"]["description"]


@pytest.mark.parametrize("warms", [False, True])
def test_what_a_lag_that_is_not_known_yet_left_is_no_warming_up(warms: bool) -> None:
    """A channel through a lag of a tenth of the survey, which began far from its equilibrium, fitted by three quarters
    of that lag: the rest of what dies away needs another name as long as it is so."""
    samples, tau = 1500, 150.0
    rng = np.random.default_rng(17)
    bell = np.exp(-0.5 * (np.arange(-80, 81) / 20.0) ** 2)
    channel = np.convolve(rng.standard_normal(samples + 160), bell / np.sqrt(np.sum(bell**2)), mode="valid")
    seen, now = np.empty(samples), channel[0] - 3.0
    for i in range(samples):
        seen[i] = now
        after = channel[min(i + 1, samples - 1)]
        for k in range(20):
            now += (channel[i] + (after - channel[i]) * (k + 0.5) / 20.0 - now) / tau / 20.0
    vectors = rng.uniform(-1.0, 1.0, (4, 3))
    added = 2.0 * seen[:, None, None] * vectors
    if warms:
        added = added + np.exp(-np.arange(samples) / 400.0)[:, None, None] * 3.0 * rng.uniform(-1.0, 1.0, (4, 3))
    record = replace(
        synthetic(61, samples, noise_nT=0.15, turning_s=4.0, added=added),
        logged={"heat": channel}, units={"heat": "1"}, origins={"heat": np.zeros(1)},
    )  # fmt: skip
    registry = Registry.load()
    follows = {"channel": "heat", "power": 1, "lag_s": 0.75 * tau, "at_start": -2.5}
    models = [
        Adopted(registry.find("error_model", "channel_response"), follows),
        Adopted(registry.find("error_model", "warm_up"), {"tau_s": 400.0}),
    ]
    how = replace(Fitting(), searching=True)
    state = joint_state(record, models, how)
    found = exchanged(record, state, [Step(state, (), None)], how, 0, 40)
    assert (found is None) is warms
    if found is not None:
        after, step = found
        assert step.dropped == ("warm_up",)
        (model,) = after.state.adopted
        assert model.settings["lag_s"] == pytest.approx(tau, rel=0.03)
