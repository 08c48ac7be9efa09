"""Every error model against the effect of its name as the simulator produces it in the time domain.

The share that is left is of the effect's rms once C and o of each sensor have explained what they can. Where no other
reason is given, what is left comes from the logger's noise in the channels and from offsets that the simulator's
scale effects do not multiply (100 nT in 50 000).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from effect_cases import (
    LINES,
    POSTURES,
    TUMBLING,
    Array,
    Explained,
    excitation,
    explained,
    explained_on_reference,
    per_axis,
    per_matrix,
    simulated,
)

import magtensor_effects
from magtensor.components import Component, component_of
from magtensor.error_models.excitation import Excitation
from magtensor.simulate.run import Simulated
from magtensor_effects.channels import OTHER

SPAN_S = 179.9  # of the tumbling survey
START_S = 1.0  # the simulator begins at rest: rates are not the steady motion's before


def drawn(scale: float, seed: int = 5) -> list[list[float]]:
    """Coefficients for four sensors."""
    return (scale * np.random.default_rng(seed).standard_normal((4, 3))).tolist()


def model(name: str) -> Component:
    found = component_of(getattr(magtensor_effects, name))
    assert found is not None
    return found


def fitted(
    name: str,
    settings: dict[str, Any],
    effect: dict[str, Any],
    base: dict[str, Any] = TUMBLING,
    simulated_as: str = "",
    after_s: float = 0.0,
) -> tuple[Explained, Simulated, Excitation]:
    survey = simulated(simulated_as or name, base, **effect)
    x = excitation(survey)
    terms = model(name).function(x, **settings)
    return explained(terms, x, survey.truth.effects[0].added, after_s=after_s), survey, x


def truth_of(survey: Simulated) -> Array:
    (values,) = survey.truth.effects[0].coefficients.values()
    return np.asarray(values)


# name, settings, effect, share left, coefficient per unit of the simulator's
PER_AXIS: list[tuple[str, dict[str, Any], dict[str, Any], float, float]] = [
    ("temperature_offset", {"lag_s": 40.0}, {"nT_per_degC": drawn(1), "lag_s": 40.0}, 0.01, 1.0),
    ("temperature_offset", {}, {"nT_per_degC": drawn(1)}, 0.01, 1.0),
    ("temperature_scale", {"lag_s": 10.0}, {"ppm_per_degC": drawn(20), "lag_s": 10.0}, 0.01, 1.0),
    # the regressor is the difference of 0.09 degC rms between skin and core: logger's noise of 0.002 counts
    ("temperature_rate", {"tau_s": 20.0}, {"nT_per_degC": drawn(1), "tau_s": 20.0}, 0.03, 1.0),
    ("warm_up", {"tau_s": 50.0}, {"nT": drawn(10), "tau_s": 50.0}, 1e-6, 1.0),
    ("offset_step", {"time_s": 77.0}, {"nT": drawn(5), "time_s": [77.0]}, 1e-6, 1.0),
    ("scale_step", {"time_s": 77.0}, {"ppm": drawn(100), "time_s": [77.0]}, 0.005, 1.0),
    ("supply_scale", {}, {"ppm_per_V": drawn(30)}, 0.01, 1.0),
    ("supply_offset", {}, {"nT_per_V": drawn(30)}, 0.01, 1.0),
    ("nonlinearity_quadratic", {}, {"nT_at_full_scale": drawn(3)}, 1e-6, 1.0),
    ("nonlinearity_cubic", {}, {"nT_at_full_scale": drawn(3)}, 1e-6, 1.0),
    # the simulator follows the loop in quarters of a sample interval; the coefficient is weight times half width
    ("hysteresis", {"half_width_nT": 5000.0}, {"weight": drawn(1e-3), "half_width_nT": [5000.0]}, 0.005, 5000.0),
    # delays of some ms: what is left is the second order, lag times rate of turn, about 1e-3
    ("sampling_lag", {"per_axis": True}, {"lag_s": drawn(2e-3)}, 0.005, 1.0),
    (
        "bandwidth",
        {"tau_s": 1e-3},
        {"tau_s": np.abs(drawn(2e-3)).tolist()},
        0.005,
        1.0,
    ),
]


@pytest.mark.parametrize(("name", "settings", "effect", "bound", "per_unit"), PER_AXIS)
def test_one_coefficient_an_axis(
    name: str, settings: dict[str, Any], effect: dict[str, Any], bound: float, per_unit: float
) -> None:
    fit, survey, _ = fitted(name, settings, effect, after_s=START_S)
    assert fit.left < bound
    true = per_unit * truth_of(survey)
    found = per_axis(fit, survey.sensors, "lag " if name == "sampling_lag" else "")
    np.testing.assert_allclose(found, true, atol=0.01 * np.abs(true).max())


def test_drifts_have_the_changes_that_were_put_in() -> None:
    fit, survey, _ = fitted("offset_drift", {"order": 1, "span_s": SPAN_S}, {"nT_per_h": drawn(100)})
    assert fit.left < 1e-6
    change = 2.0 * per_axis(fit, survey.sensors, "P1 ")
    np.testing.assert_allclose(change, truth_of(survey) * SPAN_S / 3600, rtol=1e-6)
    fit, survey, _ = fitted("scale_drift", {"order": 1, "span_s": SPAN_S}, {"ppm": drawn(1000)})
    assert fit.left < 0.005
    change = 2.0 * per_axis(fit, survey.sensors, "P1 ")
    np.testing.assert_allclose(change, truth_of(survey) * SPAN_S / 3600, atol=0.01 * np.abs(change).max())


def test_drifts_of_other_shapes_are_followed_by_their_polynomials() -> None:
    # a quadratic is one; a logarithm over 180 s with a time constant of 100 s leaves its fourth order; a wander with
    # knots every 100 s has nearly the four coefficients of a cubic
    quadratic = {"nT_per_h": drawn(100), "shape": "quadratic"}
    assert fitted("offset_drift", {"order": 2, "span_s": SPAN_S}, quadratic)[0].left < 1e-6
    logarithm = {"ppm": drawn(100), "shape": "logarithmic", "time_s": 100.0}
    assert fitted("scale_drift", {"order": 3, "span_s": SPAN_S}, logarithm)[0].left < 0.01
    wander = {"nT_per_h": drawn(100), "shape": "wander", "time_s": 100.0}
    assert fitted("offset_drift", {"order": 3, "span_s": SPAN_S}, wander)[0].left < 0.1


def test_a_drift_stays_where_the_survey_left_it() -> None:
    x = excitation(simulated("warm_up", nT=[1.0, 1.0, 1.0]))
    series = magtensor_effects.offset_drift(x, order=3, span_s=90.0).series
    np.testing.assert_array_equal(series[x.elapsed >= 90.0], 1.0)


def test_current_field_is_the_field_as_each_axis_senses_it() -> None:
    effect = {"nT_per_A": drawn(3), "channel": "current_pump", "lag_s": 1.0}
    fit, survey, _ = fitted("current_field", {"lag_s": 1.0}, effect)
    assert fit.left < 0.01
    sensed = np.einsum("sij,sj->si", survey.truth.matrix, truth_of(survey))
    np.testing.assert_allclose(per_axis(fit, survey.sensors), sensed, atol=0.01 * np.abs(sensed).max())


def test_cross_field_finds_product_and_difference() -> None:
    effect = {"nT_at_full_scale": drawn(3), "difference_ratio": 0.5}
    fit, survey, _ = fitted("cross_field", {}, effect)
    assert fit.left < 1e-6
    np.testing.assert_allclose(per_axis(fit, survey.sensors, "product "), truth_of(survey), rtol=1e-6)
    np.testing.assert_allclose(per_axis(fit, survey.sensors, "difference "), 0.5 * truth_of(survey), rtol=1e-6)


@pytest.mark.parametrize(("rate_Hz", "bound"), [(10.0, 3e-4), (4.0, 2e-3), (2.0, 5e-3)])
def test_play_knows_where_the_field_turned_back_between_samples(rate_Hz: float, bound: float) -> None:
    # the play of the samples alone leaves 0.0017, 0.010 and 0.030
    effect = {"weight": drawn(1e-3), "half_width_nT": [5000.0]}
    settings, base = {"half_width_nT": 5000.0}, TUMBLING | {"rate_Hz": rate_Hz}
    assert fitted("hysteresis", settings, effect, base, after_s=START_S)[0].left < bound


def test_one_play_operator_takes_most_of_two() -> None:
    # loops of 2000 and 8000 nT: one of the larger width misses the early part of each reversal
    effect = {"weight": drawn(1e-3), "half_width_nT": [2000.0, 8000.0]}
    assert fitted("hysteresis", {"half_width_nT": 7000.0}, effect)[0].left < 0.2


def test_play_of_iron_reaches_all_axes() -> None:
    # the iron's axes are the platform's, those of the play the sensor's own: up to a degree apart
    coupling = (1e-3 * np.random.default_rng(6).standard_normal((4, 3, 3))).tolist()
    effect, settings = {"coupling": coupling, "half_width_nT": [5000.0]}, {"half_width_nT": 5000.0}
    iron = {"simulated_as": "iron_hysteresis", "after_s": START_S}
    fit, survey, _ = fitted("hysteresis", settings | {"of_iron": True}, effect, **iron)
    assert fit.left < 0.05
    np.testing.assert_allclose(per_matrix(fit, survey.sensors) / 5000.0, coupling, atol=2e-4)
    assert fitted("hysteresis", settings, effect, **iron)[0].left > 0.5


def test_sampling_lag_of_whole_sensors_needs_one_coefficient_each() -> None:
    lag = [[a, a, a] for a in (1e-3, -2e-3, 0.5e-3, 3e-3)]
    fit, survey, _ = fitted("sampling_lag", {}, {"lag_s": lag})
    assert fit.left < 0.005
    found = [fit.coefficients["lag", s] for s in survey.sensors]
    np.testing.assert_allclose(found, [row[0] for row in lag], atol=1e-5)


def test_eddy_current_is_the_coupling_times_the_time_constant() -> None:
    coupling = np.random.default_rng(3).standard_normal((4, 3, 3))
    effect = {"coupling": coupling.tolist(), "tau_s": 1e-3}
    fit, survey, _ = fitted("eddy_current", {}, effect, after_s=START_S)
    assert fit.left < 0.005
    expected = 1e-3 * survey.truth.matrix @ coupling
    np.testing.assert_allclose(per_matrix(fit, survey.sensors), expected, atol=1e-5)


def test_eddy_currents_of_a_thick_plate() -> None:
    # 0.1 s at rates of 0.44 rad/s: without the lag a twentieth is left
    effect = {"coupling": np.random.default_rng(3).standard_normal((4, 3, 3)).tolist(), "tau_s": 0.1}
    with_lag, survey, _ = fitted("eddy_current", {"tau_s": 0.1}, effect, after_s=START_S)
    assert with_lag.left < 0.005 < 0.03 < fitted("eddy_current", {}, effect, after_s=START_S)[0].left
    expected = 0.1 * survey.truth.matrix @ np.array(effect["coupling"])
    np.testing.assert_allclose(per_matrix(with_lag, survey.sensors), expected, atol=1e-3)


def test_eddy_currents_contain_delays_and_filters() -> None:
    assert fitted("eddy_current", {}, {"rms_nT": 3.0}, simulated_as="sampling_lag", after_s=START_S)[0].left < 0.005
    assert fitted("eddy_current", {}, {"rms_nT": 3.0}, simulated_as="bandwidth", after_s=START_S)[0].left < 0.005


def test_a_slow_filter_is_told_from_a_delay() -> None:
    # 0.4 s at rates of 0.44 rad/s in each component: the second order is a fifth of the first
    slow = {"tau_s": [0.4, 0.4, 0.4]}
    right = fitted("bandwidth", {"tau_s": 0.4}, slow, after_s=5.0)[0]
    assert right.left < 0.01
    assert all(value == pytest.approx(0.4, rel=0.01) for value in right.coefficients.values())
    assert fitted("bandwidth", {"tau_s": 1e-3}, slow, after_s=5.0)[0].left > 0.15


def test_a_slip_by_a_sample_from_a_time_on() -> None:
    lag = [[a, a, a] for a in (0.1, 0.0, 0.0, -0.04)]
    fit, survey, _ = fitted("lag_step", {"time_s": 70.0}, {"lag_s": lag, "time_s": 70.0})
    found = [fit.coefficients["lag", s] for s in survey.sensors]
    np.testing.assert_allclose(found, [row[0] for row in lag], atol=2e-3)  # to first order


def test_rows_that_are_means() -> None:
    # over 0.5 s and, in one sensor, 0.35 s, at rates of 0.44 rad/s: the fourth order is T^2 w^2 / 80
    spread = [0.25 / 24.0, 0.25 / 24.0, 0.125 / 24.0, 0.25 / 24.0]
    fit, survey, _ = fitted("averaging", {"per_sensor": True}, {"spread_s2": spread})
    assert fit.left < 0.02
    np.testing.assert_allclose([fit.coefficients["spread", s] for s in survey.sensors], spread, rtol=0.01)


def test_clock_drift_in_ppm() -> None:
    fit, survey, _ = fitted("clock_drift", {}, {"ppm": [20.0, -5.0, 3.0, -9.0]})
    assert fit.left < 0.005  # second order: a delay of up to 4 ms
    found = [fit.coefficients["drift", s] for s in survey.sensors]
    np.testing.assert_allclose(found, [20.0, -5.0, 3.0, -9.0], atol=0.05)


@pytest.mark.parametrize("tau_s", [3.0, 20.0])
def test_viscous_magnetisation_as_a_fraction_of_the_field(tau_s: float) -> None:
    coupling = 1e-4 * np.random.default_rng(3).standard_normal((4, 3, 3))
    effect = {"coupling": coupling.tolist(), "tau_s": tau_s}
    fit, survey, _ = fitted("viscous_magnetisation", {"tau_s": tau_s}, effect)
    assert fit.left < 0.005
    expected = 1e6 * survey.truth.matrix @ coupling
    np.testing.assert_allclose(per_matrix(fit, survey.sensors), expected, atol=0.5)


def test_moving_part_turns_a_vector_at_each_sensor() -> None:
    fit, _, _ = fitted("moving_part", {}, {"moment_Am2": 0.1, "position_m": [0.3, 0.2, -0.8]})
    assert fit.left < 0.005


def test_periodic_interference_has_the_amplitude_of_the_tone() -> None:
    # perfect sensors, so that the tone of each axis is its own; 49.7 Hz appears as 0.3 Hz at 10 samples a second
    base = TUMBLING | {"instrument": {"seed": 1, "array": TUMBLING["instrument"]["array"]}}
    effect = {"amplitude_nT": drawn(3), "frequency_Hz": 49.7}
    fit, survey, _ = fitted("periodic_interference", {"frequency_Hz": 0.3}, effect, base)
    assert fit.left < 1e-6
    amplitude = np.hypot(per_axis(fit, survey.sensors, "cos "), per_axis(fit, survey.sensors, "sin "))
    np.testing.assert_allclose(amplitude, np.abs(truth_of(survey)), rtol=1e-6)


@pytest.mark.parametrize("known_by", ["acceleration", "attitude"])
def test_frame_flexure_in_arcmin_per_g(known_by: str) -> None:
    bends = np.random.default_rng(4).standard_normal((4, 3, 3))
    base = TUMBLING | {"logging": {known_by: True}}
    fit, survey, _ = fitted("frame_flexure", {}, {"arcmin_per_g": bends.tolist()}, base)
    assert fit.left < 0.005
    # the simulator's g is 9.81; second order is one arcmin, 3e-4
    np.testing.assert_allclose(per_matrix(fit, survey.sensors), bends, atol=0.01)


def test_a_damped_frame_gives_way_late() -> None:
    bends = np.random.default_rng(4).standard_normal((4, 3, 3))
    effect = {"arcmin_per_g": bends.tolist(), "lag_s": 0.3}
    base = TUMBLING | {"logging": {"acceleration": True}}
    fit, survey, _ = fitted("frame_flexure", {"lag_s": 0.3}, effect, base, after_s=START_S)
    assert fit.left < 0.005 < 0.05 < fitted("frame_flexure", {}, effect, base, after_s=START_S)[0].left
    np.testing.assert_allclose(per_matrix(fit, survey.sensors), bends, atol=0.01)


def test_turn_step_in_arcmin() -> None:
    # second order of 3 arcmin: 1e-3
    fit, survey, _ = fitted("turn_step", {"time_s": 77.0}, {"arcmin": drawn(3), "time_s": 77.0})
    assert fit.left < 0.005
    np.testing.assert_allclose(per_axis(fit, survey.sensors), truth_of(survey), atol=0.01)


def test_calibration_step_as_a_change_of_the_output() -> None:
    """A sensor that takes the place of another: C changes by whole parts, and the offset with it."""
    change = 0.3 * np.random.default_rng(6).standard_normal((4, 3, 3))
    fit, survey, _ = fitted("calibration_step", {"time_s": 77.0}, {"change": change.tolist(), "time_s": 77.0})
    assert fit.left < 1e-6
    np.testing.assert_allclose(per_matrix(fit, survey.sensors), 1e6 * change, rtol=1e-6, atol=1e-3)


def test_a_mount_that_turns_as_it_warms_in_arcmin_per_degree() -> None:
    effect = {"arcmin_per_degC": drawn(1), "lag_s": 40.0}
    fit, survey, _ = fitted("temperature_alignment", {"lag_s": 40.0}, effect)
    assert fit.left < 0.01
    np.testing.assert_allclose(per_axis(fit, survey.sensors), truth_of(survey), atol=0.03)


def test_a_boom_that_bends_under_load_in_arcmin_per_unit() -> None:
    effect = {"arcmin_per_unit": drawn(2), "channel": "pressure", "lag_s": 3.0}
    fit, survey, x = fitted("channel_alignment", {"channel": "pressure", "lag_s": 3.0}, effect)
    assert fit.left < 0.01
    np.testing.assert_allclose(per_axis(fit, survey.sensors), truth_of(survey), atol=0.03)
    assert set(magtensor_effects.channel_alignment(x, channel="pressure").units) == {"arcmin/hPa"}


def test_a_load_is_any_channel_but_temperatures_and_angles() -> None:
    x = excitation(simulated("temperature_offset", nT_per_degC=[0.0, 0.0, 0.0]))
    course = np.linspace(0.0, 1.0, len(x.time))
    named = {"winch_load": "kN", "heading": "deg", "temperature_1": "degC", "board": "K", "strain": "", "force": "N"}
    logged = {name: np.repeat(course[:, None], 3, axis=1) if name == "force" else course for name in named}
    assert OTHER.values(replace(x, logged=logged, units=named)) == ["strain", "winch_load"]


def test_a_mount_that_creeps_in_arcmin() -> None:
    # second order of 3 arcmin: 1e-3
    settings = {"tau_s": 100.0, "span_s": SPAN_S}
    fit, survey, _ = fitted("alignment_drift", settings, {"arcmin": drawn(3), "tau_s": 100.0})
    assert fit.left < 0.005
    whole = (1.0 - np.exp(-SPAN_S / 100.0)) * truth_of(survey)
    np.testing.assert_allclose(per_axis(fit, survey.sensors), whole, atol=0.01)


def test_a_mount_stays_where_the_survey_left_it() -> None:
    x = excitation(simulated("alignment_drift", arcmin=[1.0, 1.0, 1.0]))
    moved = magtensor_effects.alignment_drift(x, tau_s=40.0, span_s=90.0).series
    settled = magtensor_effects.alignment_drift(x, tau_s=1e-3, span_s=1.0).series
    after = x.elapsed >= 90.0
    np.testing.assert_allclose(moved[after], settled[after])


@pytest.mark.parametrize(("i", "j"), [(0, 1), (0, 2), (1, 2)])
def test_axes_that_lean_towards_each_other_as_they_warm(i: int, j: int) -> None:
    """Two unit vectors that lean by an arcmin each: by hand, from the field in each sensor's own axes."""
    survey = simulated("temperature_offset", nT_per_degC=[0.0, 0.0, 0.0])
    x = excitation(survey)
    warmer = x.thermometer("temperature", 0.0, False, 0.0).reshape(len(x.time), -1)[:, :1]
    read = np.einsum(
        "sij,nsj->nsi", x.matrix, np.broadcast_to(x.field_or_fields.reshape(len(x.time), -1, 3), x.output.shape)
    )
    lean = np.arctan(np.tan(np.pi / 10800.0))
    expected = np.zeros_like(read)
    expected[..., i] = warmer * (np.sin(lean) * read[..., j] + (np.cos(lean) - 1.0) * read[..., i])
    expected[..., j] = warmer * (np.sin(lean) * read[..., i] + (np.cos(lean) - 1.0) * read[..., j])
    terms = magtensor_effects.temperature_alignment(x, angles=6)
    chosen = terms.only(k for k, name in enumerate(terms.names) if name == "xyz"[i] + "xyz"[j])
    made = chosen.contribution(np.ones(chosen.count), x.output.shape[1] * 3).reshape(expected.shape)
    np.testing.assert_allclose(made, expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize(("name", "units"), [("temperature_offset", "nT"), ("temperature_scale", "ppm")])
def test_the_second_order_of_temperature_holds_the_first(name: str, units: str) -> None:
    # b (T - 20 degC)^2, lagged: about the mean of the survey it has a linear part of 2 b (mean - 20)
    true = drawn(0.1 if units == "nT" else 5.0)
    effect = {"nT_per_unit": true, "channel": "temperature", "power": 2, "lag_s": 10.0, "reference": 20.0}
    effect |= {"times_field": units == "ppm"}
    settings = {"order": 2, "lag_s": 10.0}
    fit, survey, x = fitted(name, settings, effect, simulated_as="channel_response")
    assert fit.left < 0.01
    mean = float(survey.channels["temperature"][0].mean())
    np.testing.assert_allclose(per_axis(fit, survey.sensors, "power 2 "), true, atol=0.02 * np.abs(true).max())
    linear = 2.0 * (mean - 20.0) * np.array(true)
    np.testing.assert_allclose(per_axis(fit, survey.sensors), linear, atol=0.02 * np.abs(linear).max())
    assert set(model(name).function(x, **settings).units) == {f"{units}/degC", f"{units}/(degC)^2"}


@pytest.mark.parametrize(
    ("settings", "units"),
    [
        ({"power": 1, "lag_s": 3.0}, "nT/hPa"),
        ({"power": 2, "lag_s": 3.0}, "nT/(hPa)^2"),
        ({"power": 3, "times_field": True}, "ppm/(hPa)^3"),
    ],
)
def test_channel_response(settings: dict[str, Any], units: str) -> None:
    effect = {"nT_per_unit": drawn(20 if "times_field" in settings else 2), "channel": "pressure"} | settings
    fit, survey, x = fitted("channel_response", {"channel": "pressure"} | settings, effect)
    assert fit.left < 0.01
    true = truth_of(survey)
    np.testing.assert_allclose(per_axis(fit, survey.sensors), true, atol=0.02 * np.abs(true).max())
    assert set(magtensor_effects.channel_response(x, channel="pressure", **settings).units) == {units}


@pytest.mark.parametrize(
    ("channel", "units", "tau_s"), [("pressure", "nT s/hPa", 3.0), ("current_pump", "nT s/A", 2.0)]
)
def test_channel_rate(channel: str, units: str, tau_s: float) -> None:
    """Of what goes smoothly, and of what is switched."""
    effect = {"nT_per_unit": drawn(2), "channel": channel, "tau_s": tau_s}
    fit, survey, x = fitted("channel_rate", {"channel": channel, "lag_s": tau_s}, effect)
    assert fit.left < 0.01
    true = tau_s * truth_of(survey)
    np.testing.assert_allclose(per_axis(fit, survey.sensors), true, atol=0.02 * np.abs(true).max())
    assert set(magtensor_effects.channel_rate(x, channel=channel).units) == {units}


def test_the_rate_of_a_slow_channel() -> None:
    """The derivative, through lags shorter than the time between samples too, and across a gap."""
    x = excitation(simulated("warm_up", nT=[1.0, 1.0, 1.0]))
    part = x.at(np.flatnonzero((x.elapsed < 60.0) | (x.elapsed > 75.0)))
    slow = 3.0 * np.sin(2.0 * np.pi * part.elapsed / 8.0)
    slowly = replace(part, part_of=None, logged={"flow": slow}, units={"flow": "l/s"})
    w = 2.0 * np.pi / 8.0
    settled = ((slowly.elapsed > 5.0) & (slowly.elapsed < 59.5)) | (slowly.elapsed > 80.0)
    settled[-1] = False  # known from one side
    for lag in (0.0, 0.01, 0.05, 0.2, 0.7):
        found = magtensor_effects.channel_rate(slowly, channel="flow", lag_s=lag).series[:, 0]
        lagged = 3.0 * w * np.real(np.exp(1j * w * slowly.elapsed) / (1.0 + 1j * w * lag))
        np.testing.assert_allclose(found[settled], lagged[settled], atol=2e-3 * 3.0 * w)


def test_latent_source() -> None:
    effect = {"nT_per_unit": drawn(2), "waveform_of": {"type": "switched", "mean_hold_s": 7.0}}
    survey = simulated("latent_source", **effect)
    added = survey.truth.effects[0].added
    u, s, vt = np.linalg.svd(added.reshape(len(added), -1), full_matrices=False)
    assert s[1] < 1e-9 * s[0]
    x = replace(excitation(survey), waveform=np.sqrt(len(u)) * u[:, 0])
    fit = explained(magtensor_effects.latent_source(x), x, added)
    assert fit.left < 1e-6
    true = (s[0] / np.sqrt(len(u)) * vt[0]).reshape(-1, 3)
    np.testing.assert_allclose(per_axis(fit, survey.sensors), true, atol=1e-6 * np.abs(true).max())


def test_a_channel_with_three_components_reaches_every_axis() -> None:
    survey = simulated("warm_up", nT=[1.0, 1.0, 1.0])
    x = excitation(survey)
    coupling = np.random.default_rng(1).standard_normal((4, 3, 3))
    added = np.einsum("sij,nj->nsi", coupling, x.channel("acceleration"))
    fit = explained(magtensor_effects.channel_response(x, channel="acceleration"), x, added)
    np.testing.assert_allclose(per_matrix(fit, survey.sensors), coupling, rtol=1e-6)


def without_common_vector(survey: Simulated, x: Excitation, added: Array) -> Array:
    """A site effect without the constant vector in the world that belongs to the field of the site."""
    from scipy.spatial.transform import Rotation

    to_world = Rotation.from_quat(x.attitude).as_matrix()
    world = np.einsum("nij,sjk,nsk->nsi", to_world, np.linalg.inv(survey.truth.matrix), added)
    common = np.broadcast_to(world.mean(axis=(0, 1)), added.shape)
    return added - np.einsum("sij,nkj,nsk->nsi", survey.truth.matrix, to_world, common)


@pytest.mark.parametrize(("degree", "bound"), [(2, 0.3), (3, 0.06), (4, 0.01)])
def test_fixed_source_converges_with_the_degree(degree: int, bound: float) -> None:
    # a dipole at 2.2 m and sensors 0.25 m from the centre: each degree leaves about a tenth (0.25 / 2.2) times 1.5
    survey = simulated("fixed_source", position_m=[2.0, 0.0, -1.0], moment_Am2=[3.0, -2.0, 4.0])
    x = excitation(survey)
    effect = without_common_vector(survey, x, survey.truth.effects[0].added)
    assert explained(magtensor_effects.fixed_source(x, degree=degree), x, effect).left < bound


def test_site_gradient_is_the_tensor_in_the_world() -> None:
    # the rotation from the platform is found in a field whose direction varies by 20 nT in 50 000, and by the gradient
    tensor = [12.0, -5.0, 3.0, -20.0, 7.0]
    fit, _, _ = fitted("site_gradient", {}, {"tensor_nT_per_m": tensor})
    assert fit.left < 4e-4
    found = [fit.coefficients[name, ""] for name in ("xx", "xy", "xz", "yy", "yz")]
    np.testing.assert_allclose(found, tensor, rtol=4e-4)


@pytest.mark.parametrize("turn_deg", [[0.5, -0.8, 0.3], [90.0, 1.0, -1.0], [0.0, 0.0, -130.0]])
@pytest.mark.parametrize("name", ["site_gradient", "fixed_source"])
def test_site_effects_do_not_depend_on_the_frame_of_the_calibration(name: str, turn_deg: list[float]) -> None:
    from scipy.spatial.transform import Rotation

    x = excitation(simulated("site_gradient", tensor_nT_per_m=[12.0, -5.0, 3.0, -20.0, 7.0]))
    model = getattr(magtensor_effects, name)
    expected = model(x)
    turn = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()

    turned = model(replace(x, field=x.field @ turn.T))

    coefficients = np.random.default_rng(1).standard_normal(expected.count)
    outputs = [terms.contribution(coefficients, 12) for terms in (expected, turned)]
    # the field's direction varies by 4e-4: of a turn of 40 deg beyond a right angle 1e-4 is not believed
    assert np.abs(outputs[1] - outputs[0]).max() < 1e-4 * np.abs(outputs[0]).max()


PASSING = {"rms_nT": 3.0, "time_s": 80.0, "closest_m": [8.0, 0.0, 1.0], "velocity_m_s": [0.0, 3.0, 0.0]}
PASSAGE_S = np.sqrt(65.0) / 3.0


def test_passing_source_whole() -> None:
    # closest distance 8.06 m at 3 m/s; what is left is the curvature over the array, (0.25 / 8)^2 times a few
    settings = {"time_s": 80.0, "passage_s": PASSAGE_S, "whole": True}
    assert fitted("passing_source", settings, PASSING)[0].left < 0.01


def test_passing_source_as_the_total_field_sees_it() -> None:
    survey = simulated("passing_source", **PASSING)
    x = excitation(survey)
    seen = np.einsum("sij,nsj->nsi", np.linalg.inv(survey.truth.matrix), survey.truth.effects[0].added)
    unit = x.field / np.linalg.norm(x.field, axis=2, keepdims=True)
    along = np.einsum("nsk,nsk->n", seen, unit) / 4
    terms = magtensor_effects.passing_source(x, time_s=80.0, passage_s=PASSAGE_S)
    columns = np.stack([terms.contribution(u, 12)[:, 0] / x.sensed(unit)[:, 0, 0] for u in np.eye(3)], axis=1)
    left = along - columns @ np.linalg.lstsq(columns, along, rcond=None)[0]
    assert np.sqrt(np.mean(left**2)) < 0.01 * np.sqrt(np.mean(along**2))


def test_crosstalk_shows_in_a_gradient_only_and_gives_the_coil() -> None:
    fit, survey, x = fitted("crosstalk", {}, {"coil_m3": 1e-6}, LINES)
    assert fit.rms < 0.01 * survey.truth.effects[0].rms_nT  # the rest is inside C
    assert fit.left < 0.001
    assert all(value == pytest.approx(1.0, rel=1e-3) for value in fit.coefficients.values())
    uniform = magtensor_effects.crosstalk(excitation(simulated("crosstalk", coil_m3=1e-6)))
    assert np.abs(uniform.series).max() < 1e-12 * np.abs(x.field).max()


def test_position_error_in_mm() -> None:
    # sources 8 m below and sensors 0.25 m from the centre: the gradient at a sensor differs from the array's by
    # 4 * 0.25 / 8, an eighth
    fit, survey, _ = fitted("position_error", {}, {"offset_m": drawn(1e-3)}, LINES)
    assert fit.left < 0.125
    true = 1e3 * truth_of(survey)
    np.testing.assert_allclose(per_axis(fit, survey.sensors), true, atol=0.125 * np.abs(true).max())


def test_baseline_expansion_in_ppm_per_degC() -> None:
    fit, _, _ = fitted("baseline_expansion", {}, {"ppm_per_degC": 500.0}, LINES)
    assert fit.left < 0.125
    assert fit.coefficients["expansion", ""] == pytest.approx(500.0, rel=0.05)


def test_finite_baseline_follows_the_bend_along_the_line() -> None:
    # a fifth sensor in the middle tells the true field there; level flight at 1 m/s, so the slowness is 1 s/m
    places = [[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [-0.5, 0.0, 0.0], [0.0, -0.5, 0.0], [0.0, 0.0, 0.0]]
    base = LINES | {
        "instrument": TUMBLING["instrument"] | {"array": {"positions_m": places}},
        "motion": LINES["motion"] | {"wobble_deg": 0.0},
    }
    survey = simulated("warm_up", base, nT=[1.0, 1.0, 1.0])
    x, truth = excitation(survey), survey.truth
    linear = truth.b[:, 4:] + np.einsum("nij,sj->nsi", truth.tensor, survey.position)
    bend = np.einsum("sij,nsj->nsi", truth.matrix, truth.b - linear)
    found = magtensor_effects.finite_baseline(x).contribution(np.ones(1), 15).reshape(bend.shape)
    # left is the next order, distance over range: 0.5 / 8 times 2
    for sensor in (0, 2):
        assert np.linalg.norm(found[:, sensor] - bend[:, sensor]) < 0.125 * np.linalg.norm(bend[:, sensor])
    for sensor in (1, 3):
        assert np.linalg.norm((found - bend)[:, sensor, 0]) < 0.125 * np.linalg.norm(bend[:, sensor, 0])


AWHILE = {"time_s": 110.0, "until_s": 60.0}


@pytest.mark.parametrize(
    ("name", "settings", "effect", "bound", "coefficient"),
    [
        # of what was recorded, 1.05 times the site's, 5 / 105 is too much
        ("reference_scale", {}, {"excess": 0.05}, 0.005, 500 / 105),
        # of waves of some 25 s: second order in the delay 2.5 %, the slope taken over 2 s another 1 %, and readings
        # once a second joined by straight lines
        ("reference_clock", {}, {"offset_s": 0.2}, 0.06, 0.2),
        ("reference_clock", {"lag_s": 8.0}, {"offset_s": 8.0}, 0.03, 8.0),
        # P1 over three minutes: half of the change
        ("reference_drift", {"order": 1, "span_s": 180.0}, {"rate_nT_h": 60.0}, 0.01, 1.5),
        # a step between two readings a second apart: ten samples of 1800 are interpolated
        ("reference_step", {"time_s": 60.0}, {"steps_nT": [3.0], "time_s": [60.0]}, 0.1, 3.0),
        # two of them: of 500 samples that are off by 3 nT, twenty are off by 1.7 nT rms in between, by 11 % in all
        ("reference_while", AWHILE, {"steps_nT": [3.0, -3.0], "time_s": [60.0, 110.0]}, 0.14, 3.0),
    ],
)
def test_reference(
    name: str, settings: dict[str, Any], effect: dict[str, Any], bound: float, coefficient: float
) -> None:
    survey = simulated("reference_step" if name == "reference_while" else name, **effect)
    x = excitation(survey)
    assert survey.reference is not None
    added = np.interp(survey.time, survey.reference.time, survey.truth.effects[0].added)
    terms = model(name).function(x, **settings)
    known = x.elapsed < x.duration - 10.0  # beyond its end the record cannot tell what a late clock should have said
    fit = explained_on_reference(terms.at(np.flatnonzero(known)), added[known])
    assert fit.left < bound
    (found,) = fit.coefficients.values()
    assert found == pytest.approx(coefficient, rel=0.02)


def test_lags_run_on_through_gaps() -> None:
    # 3 s at rest, 3 s of turning that is not recorded: a thermal lag of 40 s does not begin anew at each posture
    fit, survey, _ = fitted("temperature_offset", {"lag_s": 40.0}, {"nT_per_degC": drawn(1), "lag_s": 40.0}, POSTURES)
    assert fit.left < 0.01
    np.testing.assert_allclose(per_axis(fit, survey.sensors), truth_of(survey), atol=0.02)
    # of the field's way between two postures only the ends are known: a tenth of what iron remembers is missed
    viscous = {"rms_nT": 3.0, "tau_s": 20.0}
    assert fitted("viscous_magnetisation", {"tau_s": 20.0}, viscous, POSTURES)[0].left < 0.1


def test_an_offset_for_a_while_is_two_jumps() -> None:
    begin, end = (simulated("offset_step", TUMBLING, nT=drawn(5), time_s=[at]) for at in (60.0, 110.0))
    x = excitation(begin)
    terms = model("offset_while").function(x, time_s=110.0, until_s=60.0)
    added = begin.truth.effects[0].added - end.truth.effects[0].added
    fit = explained(terms, x, added)
    assert fit.left < 1e-6
    np.testing.assert_allclose(per_axis(fit, begin.sensors), truth_of(begin), atol=0.05)


def test_every_model_is_held_to_the_simulator_here() -> None:
    import inspect
    import sys

    source = inspect.getsource(sys.modules[__name__])
    tried = [n for n in magtensor_effects.__all__ if f'"{n}"' in source or f"magtensor_effects.{n}(" in source]
    assert tried == magtensor_effects.__all__


def test_who_is_in_whose_place() -> None:
    """S1, S2 and S3 in a circle, S4 replaced by a sensor that had no place before."""
    x = excitation(simulated("offset_step", nT=[0.0, 0.0, 0.0], time_s=[50.0]))
    offset = x.output[0] - np.einsum("sij,sj->si", x.matrix, np.broadcast_to(x.field[0], x.output[0].shape))
    found = {}
    for own, other in ((0, 1), (1, 2), (2, 0), (3, 3)):
        change = x.matrix[other] @ np.linalg.inv(x.matrix[own]) + 0.004 * (own == 3)
        jump = offset[other] - change @ offset[own]
        for i, a in enumerate("xyz"):
            found |= {(x.sensors[own], a + b): 1e6 * (change - np.eye(3))[i, j] for j, b in enumerate("xyz")}
            found[x.sensors[own], a] = jump[i]
    means = model("calibration_step").means
    assert means is not None
    assert means(x, {"time_s": 50.0}, found) == "from 50 s on S1 is what S2 was, S2 is what S3 was, S3 is what S1 was"
    two = {key: value for key, value in found.items() if key[0] == "S4"}
    assert means(x, {"time_s": 50.0}, two) == ""


def test_shifts_that_are_a_turn_of_the_array() -> None:
    """By a degree about a slanted axis, to a tenth of what it makes; and shifts that no turn makes."""
    x = excitation(simulated("offset_step", nT=[0.0, 0.0, 0.0], time_s=[50.0]))
    assert x.position is not None
    slanted = np.deg2rad(1.0) * np.array([0.6, 0.0, 0.8])
    turned = 1e3 * np.cross(slanted, x.position)
    rest = 0.1 * turned.std() * np.random.default_rng(1).standard_normal(turned.shape)
    means = model("position_error").means
    assert means is not None

    def of(shift: np.ndarray) -> str:
        named = {(s, axis): shift[i, k] for i, s in enumerate(x.sensors) for k, axis in enumerate("xyz")}
        return means(x, {}, named)

    assert "is one turn of all places by 1 deg" in of(turned + rest)
    assert of(turned + np.array([1.0, -2.0, 3.0])).startswith("100%")  # a shift of all does not show
    assert of(1e3 * 0.01 * x.position) == ""
    assert means(x, {}, {("S1", a): 1.0 for a in "xyz"} | {("S2", a): 2.0 for a in "xyz"}) == ""


def test_a_passage_that_no_gradient_tells_may_have_been_at_the_base_station() -> None:
    x = excitation(simulated("offset_step", nT=[0.0, 0.0, 0.0], time_s=[50.0]))
    means = model("passing_source").means
    assert means is not None
    assert "the base station instead" in means(x, {"time_s": 50.0, "passage_s": 5.0, "whole": False}, {})
    assert means(x, {"time_s": 50.0, "passage_s": 5.0, "whole": True}, {}) == ""
    noise = np.random.default_rng(3).chisquare(9, len(x.time)) / 9.0  # of four sensors, mean squares of nine contrasts
    near = noise + 4.0 * (np.abs(x.elapsed - 50.0) < 6.0)
    settings = {"time_s": 50.0, "passage_s": 5.0, "whole": False}
    assert "the base station instead" in means(replace(x, apart=noise), settings, {})
    assert means(replace(x, apart=near), settings, {}) == "the sensors differ meanwhile: it passed these"
