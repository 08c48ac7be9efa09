"""Every effect: it adds what it says, no more, and each follows its physics."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from simulate_cases import CHANNELS, NOISELESS, scenario

from magtensor.errors import UsageError
from magtensor.simulate import simulate
from magtensor.simulate.run import Simulated
from magtensor.simulate.scenario import Scenario
from magtensor.simulate.sources import dipole_field

DIPOLES = [{"position_m": [1.5, 1.0, -2.0], "moment_Am2": [3.0, -20.0, 40.0]}]
SPIN = {"type": "one_axis", "duration_s": 60.0, "axis": [0.0, 0.0, 1.0], "rate_deg_s": 60.0}
PERFECT = {"seed": 12, "array": {"shape": "cross", "baseline_m": 0.5}}

EVERY: dict[str, dict[str, Any]] = {
    "temperature_offset": {"lag_s": 10.0},
    "temperature_scale": {},
    "temperature_rate": {},
    "offset_drift": {"shape": "wander", "time_s": 20.0},
    "scale_drift": {"shape": "logarithmic", "time_s": 20.0},
    "warm_up": {"tau_s": 20.0},
    "current_field": {"channel": "current_pump"},
    "supply_scale": {},
    "supply_offset": {},
    "nonlinearity_quadratic": {},
    "nonlinearity_cubic": {},
    "cross_field": {},
    "hysteresis": {"half_width_nT": [2000.0, 8000.0]},
    "iron_hysteresis": {"half_width_nT": [2000.0, 8000.0]},
    "offset_step": {"time_s": [20.0, 45.0]},
    "scale_step": {"time_s": [20.0, 45.0]},
    "turn_step": {"time_s": 20.0},
    "calibration_step": {"time_s": 20.0},
    "temperature_alignment": {"lag_s": 5.0},
    "alignment_drift": {"tau_s": 20.0},
    "channel_alignment": {"channel": "pressure", "lag_s": 5.0},
    "sampling_lag": {"per_axis": True},
    "lag_step": {"time_s": 20.0},
    "averaging": {},
    "eddy_current": {},
    "bandwidth": {},
    "clock_drift": {},
    "crosstalk": {},
    "viscous_magnetisation": {},
    "moving_part": {"position_m": [0.3, 0.2, -0.8]},
    "periodic_interference": {"frequency_Hz": 49.7, "harmonics": [0.3]},
    "frame_flexure": {},
    "channel_response": {"channel": "pressure", "power": 2, "lag_s": 3.0, "times_field": True},
    "channel_rate": {"channel": "pressure", "tau_s": 3.0},
    "latent_source": {"waveform_of": {"type": "switched", "mean_hold_s": 7.0}},
    "jitter": {},
    "position_error": {},
    "baseline_expansion": {},
    "fixed_source": {"position_m": [2.0, 0.0, -1.0]},
    "site_gradient": {},
    "passing_source": {"time_s": 30.0, "closest_m": [8.0, 0.0, 0.0], "velocity_m_s": [0.0, 3.0, 0.0]},
    "reference_scale": {},
    "reference_clock": {},
    "reference_drift": {},
    "reference_step": {"time_s": [20.0]},
}


def surroundings() -> dict[str, Any]:
    field = NOISELESS["field"] | {
        "dipoles": DIPOLES,
        "variation": {"irregular": {"rms_nT": 10.0, "time_s": 10.0}},
    }
    station = {"rate_Hz": 1.0, "noise_sd_nT": 0.0, "resolution_nT": 0.0}
    return scenario(channels=CHANNELS, field=field, base_station=station)


def test_every_effect_of_the_model_is_tried_here() -> None:
    union = Scenario.model_json_schema()["properties"]["effects"]["items"]["discriminator"]["mapping"]
    assert set(union) == set(EVERY)


@pytest.fixture(scope="module")
def clean() -> Simulated:
    return simulate(surroundings())


@pytest.mark.parametrize("name", EVERY)
def test_an_effect_adds_its_rms_and_nothing_else(name: str, clean: Simulated) -> None:
    survey = simulate(surroundings() | {"effects": [{"type": name, "rms_nT": 2.5} | EVERY[name]]})
    (truth,) = survey.truth.effects
    assert truth.name == name
    assert truth.rms_nT == pytest.approx(2.5, rel=1e-4)
    assert clean.reference is not None and survey.reference is not None
    if truth.kind == "reference":
        np.testing.assert_array_equal(survey.b_raw, clean.b_raw)
        np.testing.assert_allclose(survey.reference.total_field - clean.reference.total_field, truth.added, atol=1e-9)
        during = (survey.reference.time >= 0) & (survey.reference.time <= 60.0)
        assert np.sqrt(np.mean(truth.added[during] ** 2)) == pytest.approx(2.5, rel=1e-4)
        return
    np.testing.assert_array_equal(survey.reference.total_field, clean.reference.total_field)
    np.testing.assert_allclose(survey.b_raw - clean.b_raw, truth.added, atol=1e-9)
    assert np.sqrt(np.mean(truth.added**2)) == pytest.approx(2.5, rel=1e-4)
    changed = survey.truth.b - clean.truth.b
    if truth.kind == "site":  # a real field: the truth has it
        sensed = np.einsum("sij,nsj->nsi", survey.truth.matrix, changed)
        np.testing.assert_allclose(sensed, truth.added, atol=1e-9)
    else:
        np.testing.assert_array_equal(changed, 0.0)


@pytest.mark.parametrize("name", ["sampling_lag", "hysteresis", "eddy_current", "temperature_offset", "bandwidth"])
def test_the_result_does_not_depend_on_the_chunk(name: str) -> None:
    case = surroundings() | {"effects": [{"type": name, "rms_nT": 2.5} | EVERY[name]]}
    np.testing.assert_array_equal(simulate(case, chunk=37).b_raw, simulate(case).b_raw)


def test_effects_add_up() -> None:
    both = [{"type": n, "rms_nT": 2.5} | EVERY[n] for n in ("temperature_offset", "current_field", "sampling_lag")]
    survey = simulate(surroundings() | {"effects": both})
    alone = simulate(surroundings()).b_raw
    np.testing.assert_allclose(survey.b_raw - alone, sum(e.added for e in survey.truth.effects), atol=1e-9)


def test_two_effects_of_a_type_differ() -> None:
    twice = [{"type": "temperature_offset", "rms_nT": 1.0}, {"type": "temperature_offset", "rms_nT": 1.0}]
    first, second = simulate(surroundings() | {"effects": twice}).truth.effects
    assert first.coefficients != second.coefficients


def test_only_the_sensors_named_are_affected() -> None:
    survey = simulate(surroundings() | {"effects": [{"type": "hysteresis", "rms_nT": 1.0, "sensors": ["S2", "S4"]}]})
    (truth,) = survey.truth.effects
    assert not truth.added[:, [0, 2]].any()
    assert np.sqrt(np.mean(truth.added[:, [1, 3]] ** 2)) == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize(
    "name", ["temperature_offset", "sampling_lag", "viscous_magnetisation", "periodic_interference"]
)
def test_all_sensors_alike(name: str) -> None:
    settings = EVERY[name] | {"rms_nT": 1.0}
    field = {k: v for k, v in surroundings()["field"].items() if k != "dipoles"}  # else no two sensors see the same
    bare = surroundings() | {"field": field, "instrument": PERFECT}

    def alone(alike: bool) -> Any:
        return simulate(bare | {"effects": [{"type": name, "alike": alike} | settings]}).truth.effects[0]

    together, apart = alone(True), alone(False)
    (same,) = together.coefficients.values()
    assert all(one == same[0] for one in same)
    np.testing.assert_allclose(together.added, together.added[:, :1].repeat(4, axis=1), atol=1e-9)
    assert np.abs(np.diff(apart.added, axis=1)).max() > 0.5
    assert together.rms_nT == pytest.approx(1.0, rel=1e-4)
    assert together.settings == apart.settings


@pytest.mark.parametrize(
    ("effect", "told"),
    [
        ({"type": "temperature_offset", "nT_per_degC": [1.0, 2.0, 3.0], "alike": True}, "alike is for coefficients"),
        ({"type": "crosstalk", "rms_nT": 1.0, "alike": True}, "crosstalk has no coefficients of each sensor"),
    ],
)
def test_alike_where_it_says_nothing_is_refused(effect: dict[str, Any], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        simulate(surroundings() | {"effects": [effect]})


def added(name: str, settings: dict[str, Any], **sections: Any) -> tuple[NDArray[np.float64], Simulated]:
    """What one effect adds, (N, S, 3), on perfect sensors unless said otherwise."""
    survey = simulate(scenario(**({"instrument": PERFECT} | sections), effects=[{"type": name} | settings]))
    return survey.truth.effects[0].added, survey


def spinning() -> tuple[NDArray[np.float64], complex, float]:
    """While spinning about z: the phase factor exp(-i w t), the horizontal field at t = 0, and w."""
    omega = np.deg2rad(60.0)
    b = simulate(scenario(instrument=PERFECT, motion=SPIN)).truth.b[:, 0]
    t = np.arange(600) / 10.0
    start = complex(b[0, 0], b[0, 1])
    np.testing.assert_allclose(b[:, 0] + 1j * b[:, 1], start * np.exp(-1j * omega * t), atol=1e-6)
    return t, start, omega


@pytest.mark.parametrize("tau", [1e-3, 0.05, 0.8])
def test_eddy_currents_in_a_steady_spin(tau: float) -> None:
    t, start, omega = spinning()
    waveform, _ = added("eddy_current", {"coupling": [np.eye(3).tolist()], "tau_s": tau}, motion=SPIN)
    lagged = 1 / (1 - 1j * omega * tau) - 1  # x - b for b ~ exp(-i w t)
    settled = t > 20 * tau
    expected = (start * lagged * np.exp(-1j * omega * t))[settled]
    np.testing.assert_allclose(waveform[settled, 2, 0] + 1j * waveform[settled, 2, 1], expected, atol=0.02)
    np.testing.assert_allclose(waveform[:, :, 2], 0.0, atol=1e-6)


def test_slow_eddy_currents_follow_the_rate_of_change() -> None:
    tau, h = 1e-3, 1e-3
    waveform, survey = added("eddy_current", {"coupling": [np.eye(3).tolist()], "tau_s": tau})
    b = survey.truth.b[:, 0]
    rate = (b[2:] - b[:-2]) / 0.2
    error = waveform[1:-1, 0] + tau * rate
    assert np.sqrt(np.mean(error**2)) < 0.02 * np.sqrt(np.mean((tau * rate) ** 2)) + h


def test_viscous_magnetisation_lags() -> None:
    t, start, omega = spinning()
    waveform, _ = added("viscous_magnetisation", {"coupling": [(0.01 * np.eye(3)).tolist()], "tau_s": 2.0}, motion=SPIN)
    settled = t > 40
    expected = (0.01 * start / (1 - 2j * omega) * np.exp(-1j * omega * t))[settled]
    np.testing.assert_allclose(waveform[settled, 1, 0] + 1j * waveform[settled, 1, 1], expected, atol=1e-3)


def test_bandwidth_is_a_first_order_filter() -> None:
    t, start, omega = spinning()
    waveform, _ = added("bandwidth", {"tau_s": [0.02, 0.0, 0.0]}, motion=SPIN)
    settled = t > 1
    expected = (start * (1 / (1 - 0.02j * omega) - 1) * np.exp(-1j * omega * t)).real[settled]
    np.testing.assert_allclose(waveform[settled, 0, 0], expected, atol=0.02)
    np.testing.assert_allclose(waveform[..., 1:], 0.0, atol=1e-9)


def test_a_late_sample_sees_the_earlier_field() -> None:
    t, start, omega = spinning()
    lags = [[0.01, 0.01, 0.01], [0.0, 0.0, 0.0], [-0.02, 0.03, 0.0], [0.5, 0.5, 0.5]]
    waveform, _ = added("sampling_lag", {"lag_s": lags}, motion=SPIN)
    for s, (x, y, _) in enumerate(lags):
        along_x = (start * np.exp(-1j * omega * (t - x))).real - (start * np.exp(-1j * omega * t)).real
        along_y = (start * np.exp(-1j * omega * (t - y))).imag - (start * np.exp(-1j * omega * t)).imag
        np.testing.assert_allclose(waveform[:, s, 0], along_x, atol=1e-6)
        np.testing.assert_allclose(waveform[:, s, 1], along_y, atol=1e-6)


def test_clock_drift_grows_from_nothing() -> None:
    t, start, omega = spinning()
    waveform, _ = added("clock_drift", {"ppm": [0.0, 100.0, 0.0, 0.0]}, motion=SPIN)
    expected = (start * np.exp(-1j * omega * t * (1 + 1e-4))).real - (start * np.exp(-1j * omega * t)).real
    np.testing.assert_allclose(waveform[:, 1, 0], expected, atol=1e-6)
    np.testing.assert_array_equal(waveform[:, [0, 2, 3]], 0.0)


def test_hysteresis_loop_width() -> None:
    """In a steady spin each axis sees a sinusoid; the loop is 2 w r wide at its middle."""
    _, start, _ = spinning()
    r, w = 3000.0, 1e-3
    waveform, survey = added(
        "hysteresis", {"weight": [w, w, w], "half_width_nT": [r]}, motion=SPIN | {"rate_deg_s": 6.0}
    )
    m = survey.b_raw[:, 0, 0] - waveform[:, 0, 0]
    late = np.arange(600) > 300
    rising = late & (np.gradient(m) > 0) & (np.abs(m) < 0.1 * np.abs(start))
    falling = late & (np.gradient(m) < 0) & (np.abs(m) < 0.1 * np.abs(start))
    assert waveform[falling, 0, 0].mean() - waveform[rising, 0, 0].mean() == pytest.approx(2 * w * r, rel=1e-9)
    assert np.abs(waveform).max() <= w * r * (1 + 1e-12)


def test_nonlinearity_at_full_scale() -> None:
    earth = {"earth": {"vector_nT": [30000.0, 0.0, -40000.0]}}
    still = {"type": "one_axis", "duration_s": 1.0, "rate_deg_s": 0.0}
    square, _ = added("nonlinearity_quadratic", {"nT_at_full_scale": [1.0, 2.0, 3.0]}, field=earth, motion=still)
    np.testing.assert_allclose(square[0, 0], [0.36, 0.0, 3 * 0.64], atol=1e-12)
    cube, _ = added("nonlinearity_cubic", {"nT_at_full_scale": [1.0, 2.0, 3.0]}, field=earth, motion=still)
    np.testing.assert_allclose(cube[0, 0], [0.216, 0.0, -3 * 0.512], atol=1e-12)
    settings = {"nT_at_full_scale": [1.0, 1.0, 1.0], "difference_ratio": 0.0}
    cross, _ = added("cross_field", settings, field=earth, motion=still)
    np.testing.assert_allclose(cross[0, 0], [0.0, -0.48, 0.0], atol=1e-12)
    both, _ = added("cross_field", settings | {"difference_ratio": 0.5}, field=earth, motion=still)
    np.testing.assert_allclose(both[0, 0], [-0.32, -0.48 + 0.14, 0.18], atol=1e-12)


def test_offsets_and_scales_follow_their_channels() -> None:
    ramp = {"type": "ramp", "start": 3.0, "per_h": 60.0, "units": "hPa"}
    response = {"channel": "pressure", "reference": 3.0, "nT_per_unit": [2.0, 0.0, -1.0], "power": 2}
    course = (np.arange(600) / 600.0) ** 2
    offset, survey = added("channel_response", response, channels={"pressure": ramp})
    np.testing.assert_allclose(offset[:, 3], course[:, None] * [2.0, 0.0, -1.0], atol=1e-12)
    scale, _ = added("channel_response", response | {"times_field": True}, channels={"pressure": ramp})
    np.testing.assert_allclose(scale[:, 3], 1e-6 * offset[:, 3] * survey.truth.b[:, 3], atol=1e-12)
    warming = {"temperature": {"type": "temperature", "ambient_degC": 20.0, "trend_degC_per_h": 60.0, "tau_s": 0.0}}
    settings = {"ppm_per_degC": [20.0, 20.0, 20.0], "reference_degC": 20.0}
    gain, survey = added("temperature_scale", settings, channels=warming)
    np.testing.assert_allclose(gain[-1, 2], 20e-6 * 599 / 600 * survey.truth.b[-1, 2], rtol=1e-6)
    battery = {"supply_voltage": {"type": "supply", "voltage_V": 12.0, "discharge_V_per_h": 60.0}}
    sag, _ = added("supply_offset", {"nT_per_V": [5.0, 0.0, 0.0], "reference_V": 12.0}, channels=battery)
    np.testing.assert_allclose(sag[:, 0, 0], -5.0 * np.arange(600) / 600)
    droop, _ = added("supply_scale", {"ppm_per_V": [1.0, 1.0, 1.0], "reference_V": 12.0}, channels=battery)
    np.testing.assert_allclose(droop[300, 1], -0.5e-6 * survey.truth.b[300, 1])


def test_a_latent_source_is_one_waveform_times_a_vector_at_each_sensor() -> None:
    settings = {"rms_nT": 1.0, "waveform_of": {"type": "smooth", "time_s": 3.0}}
    waveform, survey = added("latent_source", settings)
    _, size, _ = np.linalg.svd(waveform.reshape(600, 12), full_matrices=False)
    assert size[1] < 1e-12 * size[0]
    assert survey.channels == {}


def test_temperature_of_a_body_after_a_step() -> None:
    """The thermal mass against the analytic step response, and the sensor behind it with its own lag."""
    body = {
        "type": "temperature",
        "ambient_degC": 10.0,
        "tau_s": 8.0,
        "steps": [{"time_s": 10.0, "change_degC": 5.0}],
    }
    settings = {"nT_per_degC": [1.0, 0.0, 0.0], "lag_s": 4.0, "reference_degC": 10.0}
    waveform, survey = added("temperature_offset", settings, channels={"temperature": body})
    t = np.clip(survey.time - 10.0, 0, None)
    np.testing.assert_allclose(survey.channels["temperature"][0], 10 + 5 * -np.expm1(-t / 8.0), atol=0.02)
    second_order = 5 * (1 - (8 * np.exp(-t / 8) - 4 * np.exp(-t / 4)) / (8 - 4))
    np.testing.assert_allclose(waveform[:, 0, 0], second_order, atol=0.02)
    # a sudden change drives the difference between skin and core
    rate, _ = added("temperature_rate", {"nT_per_degC": [1.0, 1.0, 1.0], "tau_s": 4.0}, channels={"temperature": body})
    np.testing.assert_allclose(rate[:, 0, 0], 5 * -np.expm1(-t / 8.0) - second_order, atol=0.03)


def test_self_heating_and_spread_between_sensors() -> None:
    warm = {
        "type": "temperature",
        "ambient_degC": 20.0,
        "self_heating_degC": 6.0,
        "tau_s": 5.0,
        "per_sensor": True,
    }
    survey = simulate(scenario(channels={"temperature": warm | {"spread": 0.3}}))
    values, dims, units = survey.channels["temperature"]
    assert dims == ("time", "sensor") and units == "degC"
    np.testing.assert_allclose(values[0], 20.0)
    assert np.ptp(values[-1]) > 0.1
    assert np.all(np.abs(values[-1] - 26.0) <= 0.3 * 6.0 + 1e-3)
    even = simulate(scenario(channels={"temperature": warm | {"spread": 0.0, "start_heated": True}}))
    np.testing.assert_allclose(even.channels["temperature"][0], 26.0)


def test_supply_sags_under_its_load() -> None:
    survey = simulate(
        scenario(channels=CHANNELS | {"supply_voltage": CHANNELS["supply_voltage"] | {"wander_rms_V": 0.0}})
    )
    voltage, current = survey.channels["supply_voltage"][0], survey.channels["current_pump"][0]
    assert set(np.unique(current)) == {0.0, 2.0}
    np.testing.assert_allclose(voltage, 12.0 - 0.2 * current)


def test_current_loop_is_a_dipole() -> None:
    loop = {"position_m": [0.0, 0.0, -0.4], "area_m2": [0.0, 0.0, 0.01]}
    channels = {"current_heater": {"type": "ramp", "start": 1.0, "per_h": 0.0, "units": "A"}}
    waveform, survey = added("current_field", {"loop": loop, "channel": "current_heater"}, channels=channels)
    for s in range(4):
        field = dipole_field(np.array([0.0, 0.0, 0.01]), survey.position[s] + [0.0, 0.0, 0.4])
        np.testing.assert_allclose(waveform[:, s], np.broadcast_to(field, (600, 3)), atol=1e-12)


def test_moving_part_turns_its_dipole() -> None:
    channels = {"encoder": {"type": "angle", "rate_deg_s": 90.0, "swing_rms_deg": 0.0}}
    settings = {"moment_Am2": 0.1, "position_m": [0.0, 0.0, -1.0], "axis": [0.0, 0.0, 1.0]}
    centre = {"seed": 1, "array": {"positions_m": [[0.0, 0.0, 0.0]]}}
    waveform, survey = added("moving_part", settings, channels=channels, instrument=centre)
    np.testing.assert_allclose(np.linalg.norm(waveform[:, 0], axis=-1), 10.0)  # broadside: mu0 m / 4 pi r^3
    turned = np.unwrap(np.arctan2(waveform[:, 0, 1], waveform[:, 0, 0]))
    np.testing.assert_allclose(np.diff(turned), np.deg2rad(9.0), atol=1e-9)
    np.testing.assert_allclose(np.diff(survey.channels["encoder"][0]), np.deg2rad(9.0), atol=1e-9)


def test_interference_above_half_the_rate_aliases() -> None:
    waveform, _ = added("periodic_interference", {"amplitude_nT": [2.0, 2.0, 2.0], "frequency_Hz": 50.5})
    spectrum = np.abs(np.fft.rfft(waveform[:, 0, 0]))
    assert np.argmax(spectrum) / 60.0 == pytest.approx(0.5)
    assert waveform[:, 0, 0].std() == pytest.approx(np.sqrt(2), rel=0.01)


def test_crosstalk_of_two_sensors_on_a_line() -> None:
    pair = {"seed": 1, "array": {"positions_m": [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]]}}
    waveform, survey = added("crosstalk", {"coil_m3": 1e-6}, instrument=pair)
    b = survey.truth.b
    k = 1e-6 / 0.2**3
    np.testing.assert_allclose(waveform[:, 0], b[:, 1] * [2 * k, -k, -k], rtol=1e-9)


def test_flexure_turns_the_field_by_the_angle() -> None:
    """One arc minute across a field of 50 000 nT is 14.5 nT (METHODS A3, 26)."""
    still = {"type": "one_axis", "duration_s": 1.0, "rate_deg_s": 0.0}
    earth = {"earth": {"vector_nT": [0.0, 50000.0, 0.0]}}
    about_x = [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    waveform, _ = added("frame_flexure", {"arcmin_per_g": [about_x]}, motion=still, field=earth)
    np.testing.assert_allclose(np.linalg.norm(waveform[0, 0]), 14.544, atol=2e-3)
    np.testing.assert_allclose(waveform[0, 0, [0, 1]], [0.0, 0.0], atol=3e-3)


def test_position_error_sees_the_gradient() -> None:
    gradient = [{"type": "site_gradient", "tensor_nT_per_m": [100.0, 50.0, 0.0, -40.0, 20.0]}]
    error = {"type": "position_error", "offset_m": [[0.001, 0.0, 0.002], [0, 0, 0], [0, 0, 0], [0, 0, 0]]}
    survey = simulate(scenario(instrument=PERFECT, effects=[*gradient, error]))
    waveform = survey.truth.effects[1].added
    expected = np.einsum("nij,j->ni", survey.truth.tensor, [0.001, 0.0, 0.002])
    np.testing.assert_allclose(waveform[:, 0], expected, atol=1e-9)
    np.testing.assert_array_equal(waveform[:, 1:], 0.0)


def test_baseline_grows_with_temperature() -> None:
    gradient = [{"type": "site_gradient", "tensor_nT_per_m": [1000.0, 50.0, 0.0, -40.0, 20.0]}]
    growth = {"type": "baseline_expansion", "ppm_per_degC": 23.0, "reference_degC": 20.0}
    warm = {"temperature": {"type": "temperature", "ambient_degC": 30.0}}
    survey = simulate(scenario(instrument=PERFECT, channels=warm, effects=[*gradient, growth]))
    expected = np.einsum("nij,sj->nsi", survey.truth.tensor, survey.position) * 230e-6
    np.testing.assert_allclose(survey.truth.effects[1].added, expected, atol=1e-9)


def test_fixed_source_stands_still_in_the_world() -> None:
    settings = {"position_m": [0.0, 0.0, -3.0], "moment_Am2": [0.0, 0.0, 10.0]}
    centre = {"seed": 1, "array": {"positions_m": [[0.0, 0.0, 0.0]]}}
    waveform, survey = added("fixed_source", settings, instrument=centre)
    world = Rotation.from_quat(survey.truth.attitude).apply(waveform[:, 0])
    np.testing.assert_allclose(world, np.broadcast_to([0, 0, 2 * 100 * 10 / 27], world.shape), atol=1e-9)


def test_a_vehicle_is_strongest_when_it_is_closest() -> None:
    waveform, survey = added("passing_source", EVERY["passing_source"] | {"moment_Am2": [0.0, 0.0, 300.0]})
    size = np.linalg.norm(waveform[:, 0], axis=-1)
    assert survey.time[np.argmax(size)] == pytest.approx(30.0, abs=0.5)
    assert size.max() == pytest.approx(100 * 300 / 8**3, rel=0.15)
    assert size[0] < 0.01 * size.max()


def test_drift_warm_up_and_steps() -> None:
    hour = {"type": "one_axis", "duration_s": 3600.0, "rate_deg_s": 0.0}
    drift, _ = added("offset_drift", {"nT_per_h": [3.0, 0.0, -1.0]}, motion=hour, rate_Hz=0.1)
    np.testing.assert_allclose(drift[180, 1], [1.5, 0.0, -0.5])
    ageing, survey = added("scale_drift", {"ppm": [10.0, 10.0, 10.0]}, motion=hour, rate_Hz=0.1)
    np.testing.assert_allclose(ageing[180], 5e-6 * survey.truth.b[180])
    settling, _ = added("warm_up", {"nT": [8.0, 0.0, 0.0], "tau_s": 100.0}, motion=hour, rate_Hz=0.1)
    np.testing.assert_allclose(settling[[0, 10], 0, 0], [8.0, 8.0 / np.e])
    jump, _ = added("offset_step", {"nT": [2.0, 0.0, 0.0], "time_s": [100.0, 200.0]}, motion=hour, rate_Hz=0.1)
    np.testing.assert_array_equal(jump[[9, 10, 19, 20, -1], 0, 0], [0, 2, 2, 4, 4])
    gain, survey = added("scale_step", {"ppm": [50.0, 0.0, 0.0], "time_s": [100.0]}, motion=hour, rate_Hz=0.1)
    assert not gain[:10].any()
    np.testing.assert_allclose(gain[10:, :, 0], 5e-5 * survey.truth.b[10:, :, 0])
    knock, survey = added("turn_step", {"arcmin": [0.0, 0.0, 60.0], "time_s": 100.0}, motion=hour, rate_Hz=0.1)
    assert not knock[:10].any()
    # the sensor turns by a degree about z, so that to it the field turns back
    turned = survey.truth.b[10:] + knock[10:]
    angle = np.degrees(np.arctan2(turned[..., 1], turned[..., 0])) - np.degrees(
        np.arctan2(survey.truth.b[10:, :, 1], survey.truth.b[10:, :, 0])
    )
    np.testing.assert_allclose(angle, -1.0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=2), np.linalg.norm(survey.truth.b[10:], axis=2))


def test_unlogged_channels_act_but_are_not_written() -> None:
    channels = {"current_pump": CHANNELS["current_pump"] | {"logged": False}}
    waveform, survey = added("current_field", {"channel": "current_pump", "rms_nT": 1.0}, channels=channels)
    assert "current_pump" not in survey.channels
    assert waveform.any()


@pytest.mark.parametrize(
    ("effect", "sections", "message"),
    [
        ({"type": "temperature_offset", "rms_nT": 1.0}, {}, "no channel 'temperature'"),
        (
            {"type": "hysteresis", "rms_nT": 1.0, "sensors": ["S9"]},
            {},
            "no sensor 'S9'; the array has S1, S2, S3, S4",
        ),
        ({"type": "position_error", "rms_nT": 1.0}, {}, "adds nothing"),
        ({"type": "warm_up", "nT": [[1.0, 1.0, 1.0]] * 3}, {}, "3 vectors; the array has 4 sensors"),
        (
            {"type": "sampling_lag", "lag_s": [1e-3, 0.0, 0.0, 0.0]},
            {},
            r"effects\[0\].lag_s: needs three numbers \(x, y, z\)",
        ),
        ({"type": "sampling_lag", "lag_s": [[1e-3], [0.0], [0.0], [0.0]]}, {}, "one for each sensor"),
        ({"type": "sampling_lag", "lag_s": 1e-3}, {}, "written three times"),
        (
            {"type": "reference_clock", "offset_s": 1e6},
            {"base_station": {"rate_Hz": 1.0}},
            "a clock error of 1e",
        ),
        ({"type": "clock_drift", "ppm": [1e7, 0.0, 0.0, 0.0]}, {}, "time error of"),
        (
            {"type": "sampling_lag", "rms_nT": 1.0},
            {"motion": {"type": "random_attitudes", "count": 20}},
            "list of attitudes",
        ),
    ],
)
def test_what_cannot_be_simulated_is_refused(effect: dict[str, Any], sections: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        simulate(scenario(**sections, effects=[effect]))


def test_the_base_stations_clock() -> None:
    ramp = {"variation": {"irregular": {"rms_nT": 20.0, "time_s": 30.0}}}
    station = {"rate_Hz": 2.0, "noise_sd_nT": 0.0, "resolution_nT": 0.0}
    case = scenario(field=NOISELESS["field"] | ramp, base_station=station)
    right = simulate(case).reference
    late = simulate(case | {"effects": [{"type": "reference_clock", "offset_s": 1.5}]}).reference
    latent = simulate(case | {"base_station": station | {"latency_s": 1.5}}).reference
    assert right is not None and late is not None and latent is not None
    # what was measured at t carries the stamp t + 1.5 s: three readings later
    np.testing.assert_allclose(late.total_field[3:], right.total_field[:-3], atol=1e-9)
    np.testing.assert_allclose(latent.total_field, late.total_field, atol=1e-9)
    assert right.time[0] == -60.0 and right.time[-1] == 120.0


def test_the_base_stations_noise_step_and_gaps() -> None:
    station = {
        "rate_Hz": 10.0,
        "noise_sd_nT": 0.5,
        "resolution_nT": 0.1,
        "gaps": [{"begin_s": 10.0, "length_s": 5.0}],
    }
    reference = simulate(scenario(base_station=station | {"difference_nT": 7.0})).reference
    assert reference is not None
    assert not np.any((reference.time >= 10.0) & (reference.time < 15.0))
    assert np.diff(reference.time).max() == pytest.approx(5.1)
    np.testing.assert_allclose(reference.total_field * 10, np.rint(reference.total_field * 10), atol=1e-6)
    assert reference.total_field.mean() == pytest.approx(50007.0, abs=5 * 0.5 / np.sqrt(1750))
    assert reference.total_field.std() == pytest.approx(0.5, rel=0.1)


def test_the_reference_sees_the_sites_variation_and_not_its_sources() -> None:
    survey = simulate(surroundings() | {"effects": [{"type": "fixed_source", "rms_nT": 50.0} | EVERY["fixed_source"]]})
    uniform = simulate(surroundings() | {"field": surroundings()["field"] | {"dipoles": []}})
    assert survey.reference is not None
    at_samples = np.isin(survey.reference.time, np.arange(0.0, 60.0))
    np.testing.assert_allclose(survey.reference.total_field[at_samples], uniform.truth.total_field[::10], atol=1e-6)
