"""The simulated surveys of the studies of the loop: an array, its field and channels, motions and effects."""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from magtensor.loop.fitting.model import Record
from magtensor.loop.fitting.record import record_of
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import plan
from magtensor.recipe.source import parse_yaml
from magtensor.runner import run
from magtensor.simulate import Simulated, write

BASE: dict[str, Any] = {
    "title": "study",
    "seed": 1,
    "start": "2026-03-21T09:00:00Z",
    "rate_Hz": 2.0,
    "instrument": {
        "seed": 41,
        "array": {"shape": "cross", "baseline_m": 0.5},
        "errors": {"scale": 0.01, "non_orthogonality_deg": 0.5, "misalignment_deg": 1.0, "bias_nT": 100.0},
        "noise": {"white_sd_nT": 0.15},
    },
    "field": {
        "earth": {"total_field_nT": 49500.0, "inclination_deg": 66.0, "declination_deg": 4.0},
        "variation": {"diurnal": {"amplitude_nT": [5.0, -20.0, 8.0]}, "irregular": {"rms_nT": 1.5, "time_s": 400.0}},
    },
    "base_station": {"rate_Hz": 0.5, "noise_sd_nT": 0.1, "resolution_nT": 0.01},
    "channels": {
        "temperature": {
            "type": "temperature", "ambient_degC": 18.0, "trend_degC_per_h": 5.0, "wander_rms_degC": 1.0,
            "wander_time_s": 400.0, "self_heating_degC": 4.0, "tau_s": 240.0, "log_noise": 0.02,
        },
        "current_heater": {"type": "switched", "levels": [0.0, 1.5], "mean_hold_s": 45.0, "log_noise": 0.005},
        "supply_voltage": {
            "type": "supply", "resistance_ohm": 0.2, "loads": ["current_heater"], "wander_rms_V": 0.1,
            "log_noise": 0.001,
        },
        "encoder": {"type": "angle", "log_noise": 0.001},
        "pressure": {"type": "smooth", "mean": 5.0, "rms": 1.0, "time_s": 100.0, "units": "hPa", "log_noise": 0.002},
    },
    "logging": {"attitude": True, "acceleration": True},
}  # fmt: skip
MOTIONS: dict[str, dict[str, Any]] = {
    "tumbling": {"type": "tumbling", "duration_s": 1800.0, "rate_rms_deg_s": 20.0, "rate_time_s": 4.0},
    "tilt 40": {"type": "limited_tilt", "duration_s": 1800.0, "tilt_deg": 40.0},
    "postures": {"type": "postures", "random_count": 136, "rest_s": 10.0, "turn_s": 3.0, "average": True},
}
EFFECTS: dict[str, dict[str, Any]] = {
    "temperature_offset": {"lag_s": 100.0},
    "temperature_scale": {},
    "temperature_rate": {},
    "offset_drift": {},
    "scale_drift": {},
    "warm_up": {"tau_s": 300.0},
    "current_field": {"channel": "current_heater"},
    "supply_scale": {},
    "supply_offset": {},
    "nonlinearity_quadratic": {},
    "nonlinearity_cubic": {},
    "cross_field": {},
    "hysteresis": {"half_width_nT": [4000.0]},
    "offset_step": {"time_s": [800.0]},
    "offset_while": {"time_s": [600.0, 1000.0]},
    "scale_step": {"time_s": [1000.0], "sensors": ["S2"]},
    "turn_step": {"time_s": 1000.0, "sensors": ["S2"]},
    "calibration_step": {"time_s": 1000.0, "sensors": ["S2"]},
    "temperature_alignment": {},
    "alignment_drift": {"tau_s": 600.0},
    "channel_alignment": {"channel": "pressure", "lag_s": 3.0},
    "sampling_lag": {"per_axis": True},
    "lag_step": {"time_s": 900.0},
    "averaging": {},
    "eddy_current": {},
    "bandwidth": {},
    "clock_drift": {},
    "viscous_magnetisation": {},
    "moving_part": {"position_m": [0.3, 0.2, -0.8]},
    "periodic_interference": {"frequency_Hz": 49.7123},
    "frame_flexure": {},
    "channel_response": {"channel": "pressure", "power": 2, "lag_s": 3.0},
    "channel_rate": {"channel": "pressure", "tau_s": 20.0},
    "latent_source": {"waveform_of": {"type": "switched", "mean_hold_s": 70.0}},
    "fixed_source": {"position_m": [4.0, 0.0, -1.0]},
    "site_gradient": {},
    "reference_scale": {},
    "reference_clock": {},
    "reference_drift": {"settles_s": 900.0},
    "reference_step": {"time_s": [700.0]},
    "reference_while": {"time_s": [600.0, 1000.0]},
    "passing_source": {"time_s": 900.0, "closest_m": [12.0, 0.0, 0.0], "velocity_m_s": [0.0, 0.5, 0.0]},
}
ALIKE = " alike"  # behind an effect's name: with the same coefficients in all sensors
OWN_TO_NO_SENSOR = {
    "offset_while",
    "averaging",
    "moving_part",
    "fixed_source",
    "site_gradient",
    "passing_source",
    "reference_scale",
    "reference_clock",
    "reference_drift",
    "reference_step",
    "reference_while",
}  # that have no coefficients of each sensor, or draw none
EVERY_EFFECT = [*EFFECTS, *(effect + ALIKE for effect in EFFECTS if effect not in OWN_TO_NO_SENSOR)]
FAMILIES = (
    (
        "temperature_offset",
        "temperature_rate",
        "offset_drift",
        "warm_up",
        "supply_offset",
        "offset_step",
        "offset_while",
    ),
    (
        "temperature_scale",
        "scale_drift",
        "supply_scale",
        "scale_step",
        "turn_step",
        "calibration_step",
        "temperature_alignment",
        "alignment_drift",
        "channel_alignment",
    ),
    ("nonlinearity_quadratic", "nonlinearity_cubic", "cross_field"),
    ("hysteresis", "sampling_lag", "lag_step", "eddy_current", "bandwidth", "clock_drift", "viscous_magnetisation"),
    (
        "current_field",
        "moving_part",
        "periodic_interference",
        "frame_flexure",
        "channel_response",
        "channel_rate",
        "latent_source",
    ),
    ("fixed_source", "site_gradient"),
    ("reference_clock", "reference_drift", "reference_step", "reference_while"),
)  # those of one family may imitate each other
STAGES = "title: study\nstages: [load, {detrend_diurnal: {uncovered: mask, despike: 8}}]\n"

WHITE_NT: float = BASE["instrument"]["noise"]["white_sd_nT"]
SENSORS = 4  # of the cross


def scenario(motion: str, flicker: float, seed: int, effect: str = "", amplitude: float = 0.0) -> dict[str, Any]:
    """A survey with 1/f noise (nT/rtHz at 1 Hz) and an effect of so many times the white noise: one of `EVERY_EFFECT`,
    several joined by "+", none for ""."""
    made = copy.deepcopy(BASE) | {"motion": MOTIONS[motion], "seed": seed, "truth": False}
    made["instrument"]["seed"] = 40 + seed
    made["instrument"]["noise"]["flicker_nT_per_rtHz"] = flicker
    made["effects"] = [one for e in effect.split("+") if e for one in _described(e, amplitude * WHITE_NT, seed)]
    return made


def model_of(effect: str) -> str:
    """The error model's name of an effect, in its sensors alike or not."""
    return effect.removesuffix(ALIKE)


def _described(effect: str, rms: float, seed: int) -> list[dict[str, Any]]:
    """An effect of some rms (nT) for the simulator; what is for a while is two jumps of opposite sign."""
    if effect.endswith(ALIKE):
        name = model_of(effect)
        settings = {key: value for key, value in EFFECTS[name].items() if key != "sensors"}
        return [{"type": name, "rms_nT": rms, "alike": True} | settings]
    if effect == "reference_while":
        return [{"type": "reference_step", "steps_nT": [1.0, -1.0], "rms_nT": rms} | EFFECTS[effect]]
    if effect != "offset_while":
        return [{"type": effect, "rms_nT": rms} | EFFECTS[effect]]
    first, last = EFFECTS[effect]["time_s"]
    duration = MOTIONS["tumbling"]["duration_s"]
    jumps = np.random.default_rng(seed).standard_normal((SENSORS, 3))
    jumps *= rms / np.sqrt(np.mean(jumps**2) * (last - first) / duration)
    both = ((first, jumps), (last, -jumps))
    return [{"type": "offset_step", "nT": nT.tolist(), "time_s": [at]} for at, nT in both]


def recorded(simulation: Simulated, change: Callable[[Path], None] | None = None) -> Record:
    """Its samples as the loop sees them: written to a file, which `change` may alter, read and prepared by the recipe's
    stages."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "survey.h5"
        write(simulation, path)
        if change is not None:
            change(path)
        planned = plan(parse_yaml(STAGES, "study"), survey=path)
        return record_of(run(planned, empty_survey(planned)).survey)
