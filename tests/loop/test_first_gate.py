"""The first gate: by the scatter over blocks, or by the sensors' own spectra where the blocks bear it out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, flicker, linear_state, looked_at, synthetic
from scipy.special import chdtrc, chdtri

from magtensor.error_models.terms import Terms
from magtensor.loop.evidence.assessment import BORNE_OUT, assess, estimated_in, explained, slow_noise_of
from magtensor.loop.evidence.gains import Gain
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.separation import SECOND_ORDER
from magtensor.loop.searching.gates import ALPHA, Candidate, explained_before, seen_between
from magtensor.loop.searching.outcome import why
from magtensor.loop.searching.rounds import with_lines
from magtensor.loop.searching.screening import candidates_of
from magtensor.registry import Registry

MODELS = ("turn_step", "scale_drift", "nonlinearity_cubic", "eddy_current")


def candidates(seed: int, added: Array | None = None, names: Sequence[str] = MODELS) -> list[Candidate]:
    record = synthetic(seed, added=added, turning_s=4.0)
    registry = Registry.load()
    models = [registry.find("error_model", n) for n in names]
    return candidates_of(with_lines(linear_state(record), record), models, {}, ALPHA)


@pytest.fixture(scope="module")
def one() -> Candidate:
    """A candidate of no significance; noise of the residual's own colour is not what says so."""
    found = candidates(3, names=MODELS[1:])[0]
    assert not found.significant
    return replace(found, adjusted_null_p=0.0)


@pytest.mark.parametrize(
    ("p", "adjusted_p", "own_p", "tried", "significant"),
    [
        (1e-9, 0.9 * ALPHA, 1.0, 1.0, True),  # the blocks alone
        (0.9 * BORNE_OUT, 0.3, 0.9 * ALPHA, 1.0, True),
        (1.1 * BORNE_OUT, 0.3, 0.9 * ALPHA, 1.0, False),  # the blocks do not bear it out
        (0.9 * BORNE_OUT, 0.3, 1.1 * ALPHA, 1.0, False),  # not unlikely enough in that noise
        (0.9 * BORNE_OUT, 0.3, 0.9 * ALPHA, 2.0, False),  # the better of two settings may do as well
    ],
)
def test_two_ways_to_pass(
    one: Candidate, p: float, adjusted_p: float, own_p: float, tried: float, significant: bool
) -> None:
    changed = replace(
        one, tried=tried, adjusted_p=adjusted_p, adjusted_own_p=own_p, assessment=replace(one.assessment, p=p)
    )
    assert changed.significant is significant
    assert ("own spectrum" in why(changed, None)) is (significant and adjusted_p > ALPHA)


@pytest.mark.parametrize(("name", "significant"), [("eddy_current", True), ("periodic_interference", False)])
def test_a_tone_has_one_way_to_pass(one: Candidate, name: str, significant: bool) -> None:
    """Its frequency is the strongest line of a spectrum that knows nothing of having been searched."""
    model = Adopted(Registry.load().find("error_model", name), {})
    changed = replace(
        one, model=model, tried=1.0, adjusted_p=0.3, adjusted_own_p=1e-9, assessment=replace(one.assessment, p=1e-3)
    )
    assert changed.significant is significant


@pytest.mark.parametrize(
    ("name", "own_p", "null_focused", "passes"),
    [
        ("warm_up", 0.9 * ALPHA, 1.0, True),
        ("warm_up", 1.1 * ALPHA, 1.0, False),  # slow noise explains it
        ("warm_up", 0.9 * ALPHA, -1.0, False),  # in noise as strong as the residual's one part does not predict another
        ("offset_step", 0.9 * ALPHA, 1.0, False),  # its time was sought in all the data
    ],
)
def test_a_drift_that_lies_in_a_few_folds_passes_by_the_spectra_of_the_sensors(
    one: Candidate, name: str, own_p: float, null_focused: float, passes: bool
) -> None:
    """Most of what is gained in one fold, lost in noise of the residual's colour, and short folds that agree."""
    each = np.ones(10)

    def gain(most: float, others: float) -> Gain:
        return Gain(1000.0 * each, 1000.0 * each - np.r_[most, others * each[1:]], each)

    assessed = replace(
        one.assessment, p=1e-4, own_p=own_p, gain=gain(80.0, -1.0), null_gain=gain(-80.0, 0.0),
        estimate=replace(one.assessment.estimate, theta=np.zeros_like(one.assessment.estimate.theta)),
        focused=gain(5.0, 6.0), null_focused=gain(null_focused, null_focused),
    )  # fmt: skip
    registry = Registry.load()
    drift = registry.find("error_model", "warm_up").function(linear_state(synthetic(3)).excitation, tau_s=300.0)
    changed = replace(
        one, model=Adopted(registry.find("error_model", name), {"tau_s": 300.0}), terms=drift, tried=1.0,
        adjusted_p=0.01, adjusted_own_p=own_p, adjusted_null_p=0.1, assessment=assessed,
    )  # fmt: skip
    assert not changed.assessment.gain.consistent and drift.adds_to_axes
    assert changed.passes is passes


@pytest.mark.parametrize(
    ("times", "name", "believed"),
    [(1.0, "scale_drift", True), (4.0, "scale_drift", True), (6.0, "scale_drift", False), (6.0, "eddy_current", True)],
)
def test_what_predicts_far_more_than_it_explains_is_not_believed(
    one: Candidate, times: float, name: str, believed: bool
) -> None:
    """What is adopted already errs by that much on blocks that it was not fitted to; as a delay may, which takes up in
    each fold what shortens the field."""
    one = replace(one, model=Adopted(Registry.load().find("error_model", name), {}))
    each = np.ones(10)
    estimate = one.assessment.estimate
    explained = estimate.explained_beside(len(estimate.theta) - one.terms.count)
    gain = Gain(10.0 * times * explained * each, 9.9 * times * explained * each, each)
    changed = replace(one, adjusted_p=0.0, assessment=replace(one.assessment, gain=gain))
    assert gain.total == pytest.approx(times * explained) and gain.consistent
    assert bool(changed.predicts) is believed
    assert ("far more than it explains" in why(changed, None)) is not believed


def test_a_weak_turn_that_twelve_blocks_cannot_prove_among_the_whole_catalogue() -> None:
    """0.3 nT rms in noise of 1 nT: chi-square of some 180 for three coefficients."""
    turned = np.zeros((1200, 4, 3))
    field = synthetic(8, turning_s=4.0).raw[:, 1]
    turned[700:, 1] = 2e-5 * np.cross([0.4, -0.8, 0.6], field[700:] - field.mean(0))
    found = {c.model.name: c for c in candidates(8, turned)}["turn_step"]
    assert found.among(len(Registry.load().names("error_model"))).passes
    assert found.model.settings["time_s"] == pytest.approx(700.0, abs=60.0)


def test_what_happens_once_has_one_way_to_pass() -> None:
    """Noise of one colour for all sensors bears nothing out of it, however unlikely it is in that."""
    turned = np.zeros((1200, 4, 3))
    field = synthetic(8, turning_s=4.0).raw[:, 1]
    turned[700:, 1] = 2e-5 * np.cross([0.4, -0.8, 0.6], field[700:] - field.mean(0))
    found = {c.model.name: c for c in candidates(8, turned)}["turn_step"]
    weak = replace(found, tried=1.0, adjusted_p=0.3, assessment=replace(found.assessment, p=1e-5))
    assert weak.adjusted_null_p < 0.02 * ALPHA and not weak.significant


@pytest.mark.parametrize(("walking", "low", "high"), [((0,), 2.5, 3.2), ((0, 1, 2, 3), 0.5, 1.6), ((), 0.7, 1.4)])
def test_one_sensor_with_more_slow_noise_than_the_others(walking: Sequence[int], low: float, high: float) -> None:
    """Of noise in one of four sensors the contrasts hold 9/16 there and 1/16 in each other one: 3 times the average."""
    rng = np.random.default_rng(11)
    added = np.zeros((1200, 4, 3))
    for number in walking:
        walk = np.cumsum(rng.standard_normal((1200, 3)), axis=0)
        added[:, number] = 2.0 * walk / walk.std(axis=0)

    state = linear_state(synthetic(12, noise_nT=0.3, added=added))

    assert low < slow_noise_of(0, state.residual, state.colours.across) < high
    assert slow_noise_of(None, state.residual, state.colours.across) == 1.0


def test_what_is_all_in_a_noisy_sensor_is_judged_in_its_own_noise() -> None:
    """The chi-square of a step in the sensor that walks is divided by the three above; in a quiet one by about one."""
    walk = np.cumsum(np.random.default_rng(13).standard_normal((1200, 3)), axis=0)
    offset_step = Registry.load().find("error_model", "offset_step")
    in_average_noise, in_own_noise = [], []
    for sensor in (0, 2):
        added = np.zeros((1200, 4, 3))
        added[:, 0] = walk / walk.std(axis=0)
        added[700:, sensor] += [3.0, -2.0, 4.0]
        state = linear_state(synthetic(14, noise_nT=0.3, added=added))
        terms = offset_step.function(state.excitation, time_s=699.5).at(state.residual.samples)
        terms = terms.only(range(3 * sensor, 3 * sensor + 3))
        white = Whitened.of(state.residual, state.colours.across, state.colours.along)
        in_average_noise.append(float(chdtri(3, estimate_p(white, terms))))
        in_own_noise.append(float(chdtri(3, assess(white, terms).null_p)))
    assert 2.0 < in_average_noise[0] / in_own_noise[0] < 3.5
    assert in_average_noise[1] / in_own_noise[1] < 1.5


def estimate_p(white: Whitened, terms: Terms) -> float:
    """P value of the terms in noise of the average colour."""
    estimate = estimated_in(white, terms)
    return float(chdtrc(estimate.rank, explained(estimate)))


def test_an_error_of_the_reference_leaves_nothing_between_the_sensors() -> None:
    """A base station that was moved by 300 nT: what drifts on one sensor is no next order of that, and a step of all
    scale factors may be."""
    registry = Registry.load()
    drift = np.zeros((1200, 4, 3))
    drift[:, 2] = np.linspace(-0.3, 0.3, 1200)[:, None] * np.array([1.0, -1.0, 1.0])
    record = synthetic(21, noise_nT=0.15, turning_s=4.0, added=drift)
    assert record.total_field is not None
    moved = record.total_field + 300.0 * (record.time > 600.0)
    record = replace(record, total_field=moved, quiet_field=moved)
    step = Adopted(registry.find("error_model", "reference_step"), {"time_s": 600.5})
    state = with_lines(joint_state(record, [step], Fitting()), record)
    (found,) = candidates_of(state, [registry.find("error_model", "offset_drift")], {}, ALPHA)
    assert found.passes and found.beside == 0.0
    assert found.assessment.gain.total < SECOND_ORDER * explained_before(state)
    again = step.terms(state.excitation).at(state.residual.samples)
    assert not seen_between(state.residual, again, np.ones(1))


@pytest.mark.parametrize(("of_sensor", "may"), [(2, False), (0, True)])
def test_an_effect_of_one_sensor_leaves_nothing_in_the_others(of_sensor: int, may: bool) -> None:
    """S1 jumps by 300 nT: what drifts on another sensor is no next order of that, what drifts on S1 may be."""
    registry = Registry.load()
    added = np.zeros((1200, 4, 3))
    added[601:, 0] += 300.0
    added[:, of_sensor] += np.linspace(-0.3, 0.3, 1200)[:, None] * np.array([1.0, -1.0, 1.0])
    record = synthetic(22, noise_nT=0.15, turning_s=4.0, added=added)
    step = Adopted(registry.find("error_model", "offset_step"), {"time_s": 600.5}, ("S1",))
    state = with_lines(joint_state(record, [step], Fitting()), record)
    (found,) = candidates_of(state, [registry.find("error_model", "offset_drift")], {}, ALPHA)
    assert (found.beside > 0.0) is may and found.passes is not may
    assert found.assessment.gain.total < SECOND_ORDER * explained_before(state)


@pytest.mark.parametrize(("course", "may"), [("drift", False), ("fifth order", True)])
def test_what_follows_the_field_leaves_nothing_that_goes_with_time(course: str, may: bool) -> None:
    """S1 has a strong third order: what drifts is no next order of that, and a fifth order may be."""
    registry = Registry.load()
    raw = synthetic(23, noise_nT=0.15, turning_s=4.0).raw[:, 0] / 5e4
    added = np.zeros((1200, 4, 3))
    added[:, 0] = 600.0 * raw**3
    if course == "drift":
        added[:, 0] += np.linspace(-0.3, 0.3, 1200)[:, None] * np.array([1.0, -1.0, 1.0])
        name = "offset_drift"
    else:
        added[:, 0] += 3.0 * (raw**5 - raw**3)
        name = "hysteresis"
    record = synthetic(23, noise_nT=0.15, turning_s=4.0, added=added)
    third = Adopted(registry.find("error_model", "nonlinearity_cubic"), {}, ("S1",))
    state = with_lines(joint_state(record, [third], Fitting()), record)
    (found,) = candidates_of(state, [registry.find("error_model", name)], {}, ALPHA)
    assert (found.beside > 0.0) is may
    if not may:
        assert found.passes and found.assessment.gain.total < SECOND_ORDER * explained_before(state)


@pytest.mark.parametrize(("null_p", "own_p"), [(0.9, 1.0), (0.9, 1.1), (1.1, 0.9), (1.1, 1.1)])
def test_what_short_blocks_alone_say_of_many_coefficients(null_p: float, own_p: float) -> None:
    """Nine of each sensor, which turn with the field; in units of what is asked. Of three, long blocks say as much."""
    for name, believed in (("eddy_current", min(null_p, own_p) < 1.0), ("scale_drift", True)):
        (found,) = candidates(3, names=[name])
        found = replace(found, adjusted_p=0.9 * ALPHA, adjusted_null_p=null_p * ALPHA, adjusted_own_p=own_p * ALPHA)
        assert found.significant is believed
        assert ("by short blocks alone" in why(found, None)) is not believed


@pytest.mark.parametrize("sensors", [2, 4])
def test_slow_noise_passes_for_nothing_that_has_many_coefficients(sensors: int) -> None:
    """In short blocks noise that is slower than these bears out nine coefficients a sensor far too often."""
    model = Adopted(Registry.load().find("error_model", "viscous_magnetisation"), {"tau_s": 200.0})
    by_blocks, passed = 0, 0
    for seed in range(60):
        noise = flicker(np.random.default_rng(500 + seed), (300, sensors, 3), crossing=0.03)
        found = looked_at(linear_state(synthetic(seed, 300, sensors, 1e-4, noise, turning_s=10.0)), model)
        by_blocks += found.assessment.p < 1e-3
        passed += replace(found, alpha=1e-3).significant
    assert by_blocks > 5  # of 60, where it should be in none
    assert passed <= 2


def test_an_effect_with_many_coefficients_is_significant_still() -> None:
    """A tenth of the noise of a sample at the end of 1200, in slow noise."""
    model = Adopted(Registry.load().find("error_model", "nonlinearity_cubic"), {})
    noise = flicker(np.random.default_rng(5), (1200, 4, 3), crossing=0.03)
    record = synthetic(1, 1200, 4, 1e-4, noise, turning_s=10.0)
    state = linear_state(record)
    assert not looked_at(state, model).significant
    cubic = (state.excitation.output / 50_000.0) ** 3
    bent = replace(record, raw=record.raw + 1.5 * cubic)
    assert looked_at(linear_state(bent), model).significant
