"""Small scenarios that the simulator's tests vary."""

from __future__ import annotations

import copy
from typing import Any

NOISELESS: dict[str, Any] = {
    "title": "test",
    "seed": 11,
    "rate_Hz": 10.0,
    "instrument": {
        "seed": 12,
        "array": {"shape": "cross", "baseline_m": 0.5},
        "errors": {"scale": 0.01, "misalignment_deg": 2.0, "bias_nT": 100.0, "soft_iron": 0.01},
    },
    "motion": {"type": "tumbling", "duration_s": 60.0, "rate_rms_deg_s": 25.0},
    "field": {"earth": {"total_field_nT": 50000.0, "inclination_deg": 60.0, "declination_deg": 5.0}},
    "truth": "effects",
}


def scenario(**changes: Any) -> dict[str, Any]:
    """The noiseless test survey with some sections replaced."""
    return copy.deepcopy(NOISELESS) | changes


CHANNELS: dict[str, Any] = {
    "temperature": {
        "type": "temperature",
        "trend_degC_per_h": 60.0,
        "wander_rms_degC": 2.0,
        "wander_time_s": 20.0,
    },
    "current_pump": {"type": "switched", "levels": [0.0, 2.0], "mean_hold_s": 5.0},
    "supply_voltage": {
        "type": "supply",
        "resistance_ohm": 0.2,
        "loads": ["current_pump"],
        "wander_rms_V": 0.1,
    },
    "encoder": {"type": "angle"},
    "pressure": {"type": "smooth", "mean": 5.0, "rms": 1.0, "time_s": 10.0, "units": "hPa"},
}
