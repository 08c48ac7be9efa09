"""From a simulated survey to what error models see, and how much of an effect their regressors explain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.error_models.excitation import Excitation
from magtensor.error_models.terms import Terms
from magtensor.simulate import simulate
from magtensor.simulate.run import Simulated

Array = NDArray[np.float64]

TUMBLING: dict[str, Any] = {
    "title": "test",
    "seed": 21,
    "rate_Hz": 10.0,
    "instrument": {
        "seed": 22,
        "array": {"shape": "cross", "baseline_m": 0.5},
        "errors": {"scale": 0.01, "misalignment_deg": 2.0, "bias_nT": 100.0, "soft_iron": 0.01},
    },
    "motion": {"type": "tumbling", "duration_s": 180.0, "rate_rms_deg_s": 25.0},
    "field": {
        "earth": {"total_field_nT": 50000.0, "inclination_deg": 60.0, "declination_deg": 5.0},
        "variation": {"pulsations": [{"rms_nT": 10.0, "period_s": 30.0}]},
    },
    "base_station": {"rate_Hz": 1.0, "noise_sd_nT": 0.0, "resolution_nT": 0.0},
    "channels": {
        "temperature": {
            "type": "temperature",
            "trend_degC_per_h": 60.0,
            "wander_rms_degC": 2.0,
            "wander_time_s": 20.0,
            "log_noise": 0.002,
        },
        "current_pump": {"type": "switched", "levels": [0.0, 2.0], "mean_hold_s": 5.0, "log_noise": 0.005},
        "supply_voltage": {
            "type": "supply",
            "resistance_ohm": 0.2,
            "loads": ["current_pump"],
            "wander_rms_V": 0.1,
            "log_noise": 0.001,
        },
        "encoder": {"type": "angle", "log_noise": 0.001},
        "pressure": {"type": "smooth", "mean": 5.0, "rms": 1.0, "time_s": 10.0, "units": "hPa", "log_noise": 0.002},
    },
    "logging": {"attitude": True, "acceleration": True},
    "truth": "effects",
}
LINES: dict[str, Any] = TUMBLING | {
    "motion": {"type": "survey_lines", "lines": 4, "length_m": 60.0, "spacing_m": 3.0, "speed_m_s": 1.0},
    "field": TUMBLING["field"]
    | {
        "dipoles": [
            {"position_m": [2.0, 20.0, -7.0], "moment_Am2": [300.0, -2000.0, 4000.0]},
            {"position_m": [6.0, 45.0, -8.0], "moment_Am2": [-2000.0, 800.0, 2500.0]},
        ]
    },
}
POSTURES: dict[str, Any] = TUMBLING | {
    "rate_Hz": 5.0,
    "motion": {"type": "postures", "random_count": 60, "rest_s": 3.0, "turn_s": 3.0},
}


def simulated(name: str, base: dict[str, Any] = TUMBLING, **settings: Any) -> Simulated:
    """The survey with one effect."""
    return simulate(base | {"effects": [{"type": name} | settings]})


def excitation(survey: Simulated) -> Excitation:
    """What error models see of a survey whose C, o and field are known, channels as logged."""
    truth = survey.truth
    output = np.einsum("sij,nsj->nsi", truth.matrix, truth.b) + truth.offset
    channels = {k: v for k, (v, _, _) in survey.channels.items() if k != "attitude"}
    segment = np.zeros(len(survey.time), dtype=int) if survey.segment is None else survey.segment
    total = None
    if survey.reference is not None:
        total = np.interp(survey.time, survey.reference.time, survey.reference.total_field)
    gap = np.diff(survey.time) > 1.5 / survey.scenario.rate_Hz
    return Excitation(
        time=survey.time,
        start=float(survey.time[0]),
        sensors=tuple(survey.sensors),
        output=output,
        field=truth.b,
        total_field=total,
        logged={k: v - v.mean(axis=0) for k, v in channels.items()},
        units={k: survey.channels[k][2] for k in channels},
        run=np.concatenate([[0], np.cumsum(gap | (np.diff(segment) != 0))]),
        segment=segment,
        position=survey.position,
        attitude=survey.channels["attitude"][0] if "attitude" in survey.channels else None,
    )


@dataclass(frozen=True)
class Explained:
    """A least-squares fit of terms to an effect, C and o of each sensor being free as well.

    Attributes:
        left: rms of what the terms leave, over that of the effect; both without what C and o explain.
        coefficients: by (name, sensor).
        rms: nT, of the effect without what C and o explain.
    """

    left: float
    coefficients: dict[tuple[str, str], float]
    rms: float


def explained(terms: Terms, x: Excitation, added: Array, *, after_s: float = 0.0) -> Explained:
    """Fit an effect (N, S, 3) nT on the raw outputs, from a time on."""
    rows = x.elapsed >= after_s
    n, outputs = int(rows.sum()), 3 * len(x.sensors)
    target = added[rows].reshape(n, outputs)
    series = replace(terms, series=terms.series[rows])
    dense = np.stack([series.contribution(unit, outputs) for unit in np.eye(terms.count)], axis=2)  # (N, 3 S, P)
    for s in range(len(x.sensors)):
        basis, _ = np.linalg.qr(np.column_stack([x.field[rows, s], np.ones(n)]))
        part = slice(3 * s, 3 * s + 3)
        target[:, part] -= basis @ (basis.T @ target[:, part])
        dense[:, part] -= np.tensordot(basis, np.tensordot(basis.T, dense[:, part], axes=1), axes=1)
    return _fit(terms, dense.reshape(n * outputs, -1), target.ravel())


def explained_on_reference(terms: Terms, added: Array) -> Explained:
    """Fit an effect (N,) nT on the total field, a constant being free: it is a scale."""
    columns = np.stack([terms.on_reference(unit) for unit in np.eye(terms.count)], axis=1)
    return _fit(terms, columns - columns.mean(axis=0), added - added.mean())


def _fit(terms: Terms, columns: Array, target: Array) -> Explained:
    scale = np.sqrt((columns**2).mean(axis=0))
    assert (scale > 0).all()
    found = np.linalg.lstsq(columns / scale, target, rcond=1e-9)[0]
    left = target - columns / scale @ found
    keys = zip(terms.names, terms.sensors, strict=True)
    rms = float(np.sqrt((target**2).mean()))
    return Explained(float(np.sqrt((left**2).mean()) / rms), dict(zip(keys, found / scale, strict=True)), rms)


def per_axis(fit: Explained, sensors: list[str], prefix: str = "") -> Array:
    """(S, 3) coefficients of a model with one each axis."""
    return np.array([[fit.coefficients[prefix + axis, s] for axis in "xyz"] for s in sensors])


def per_matrix(fit: Explained, sensors: list[str]) -> Array:
    """(S, 3, 3) coefficients of a model with nine a sensor."""
    return np.array([[[fit.coefficients[a + b, s] for b in "xyz"] for a in "xyz"] for s in sensors])
