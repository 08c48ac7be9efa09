"""Small surveys made up for checking error models: every channel that a model asks for, a gap, a gradient."""

from __future__ import annotations

from fnmatch import fnmatchcase

import numpy as np

from magtensor.attitude import into_platform
from magtensor.calibration.by_sensor import by_sensor
from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.error_models.excitation import VECTORS, Excitation
from magtensor.error_models.needs import FACTS
from magtensor.error_models.settings import AnyChannel

SAMPLES = 400
RATE_HZ = 5.0
GAP_S = 30.0
EARTH_NT = np.array([2000.0, 21000.0, -45000.0])
GRADIENT_NT_PER_M = np.array([[30.0, 12.0, -7.0], [12.0, -50.0, 4.0], [-7.0, 4.0, 20.0]])
LINES_HZ = (0.31, 0.87)
TYPICAL_UNITS = {"temperature*": "degC", "current_*": "A", "supply*": "V", "encoder*": "rad", "acceleration": "m s-2"}


def example_survey(
    component: Component, *, sensors: int = 4, postures: bool = False, uniform: bool = False
) -> Excitation:
    """A small survey in a field with a gradient, with a gap, an attitude and every channel the model asks for.

    Parameters
    ----------
    postures: attitudes that jump from sample to sample, each a run of its own.
    uniform: a field without gradient.
    """
    rng = np.random.default_rng(7)
    first = np.arange(SAMPLES) < SAMPLES // 3
    time = np.arange(SAMPLES) / RATE_HZ + np.where(first, 0.0, GAP_S)
    run = np.arange(SAMPLES) if postures else (~first).astype(int)
    position = rng.uniform(-0.3, 0.3, (sensors, 3))
    attitude = _jumping(rng) if postures else _tumbling(time)
    into = np.stack([into_platform(attitude, axis) for axis in np.eye(3)], axis=2)
    earth = EARTH_NT + 20.0 * _smooth(time, 3, 0.05)
    field = np.repeat(np.einsum("nij,nj->ni", into, earth)[:, None], sensors, axis=1)
    if not uniform:
        changing = GRADIENT_NT_PER_M * (1.0 + 0.5 * _smooth(time, 1, 0.02))[:, :, None]
        field = field + np.einsum("nij,njk,nlk,sl->nsi", into, changing, into, position)
    matrix = np.eye(3) + 0.02 * rng.standard_normal((sensors, 3, 3))
    output = by_sensor(matrix, field) + 100.0 * rng.standard_normal((sensors, 3))
    logged, units = _channels(component, time, sensors)
    return Excitation(
        time=time,
        start=float(time[0]),
        sensors=tuple(f"S{i + 1}" for i in range(sensors)),
        output=output,
        field=field,
        total_field=np.linalg.norm(earth, axis=1),
        logged=logged,
        units=units,
        run=run,
        segment=run.copy(),
        position=position,
        attitude=attitude,
        lines=LINES_HZ,
        waveform=_smooth(time, 1, 0.04)[:, 0] if sensors > 2 else None,
    )


def _channels(component: Component, time: Array, sensors: int) -> tuple[dict[str, Array], dict[str, str]]:
    """Channels for every need and every channel setting of the model: smooth, about zero."""
    patterns = {n: "" for need in component.declared({}).needs for n in need.split("|") if n not in FACTS}
    for parameter in component.parameters.values():
        for mark in getattr(parameter.annotation, "__metadata__", ()):
            if isinstance(mark, AnyChannel):
                patterns[mark.pattern] = mark.or_units
    logged: dict[str, Array] = {}
    units: dict[str, str] = {}
    for k, (pattern, given) in enumerate(sorted(patterns.items())):
        name = pattern.replace("*", "example" if pattern.endswith("_*") or pattern == "*" else "").replace("?", "1")
        known = next((u for p, u in TYPICAL_UNITS.items() if fnmatchcase(name, p)), "1")
        shape = 3 if name in VECTORS else 1
        values = _smooth(time, shape, 0.03 + 0.01 * k, first=5 * k + 3)
        logged[name] = (values if shape == 3 else values[:, 0]) * (9.8 if name == "acceleration" else 1.0)
        units[name] = given or known
    return logged, units


def _smooth(time: Array, columns: int, frequency_Hz: float, first: int = 0) -> Array:
    """(N, columns) of irregular smooth functions of about unit size, mean zero."""
    out = np.zeros((len(time), columns))
    for c in range(columns):
        for tone in range(4):
            turn = 2 * np.pi * frequency_Hz * (1 + 0.618 * tone + 0.29 * c)
            out[:, c] += 0.7 * np.cos(turn * time + 1.7 * (first + c) + 2.3 * tone)
    centred: Array = out - out.mean(axis=0)
    return centred


def _tumbling(time: Array) -> Array:
    """(N, 4) unit quaternions that turn smoothly in all directions."""
    tones = ((0.21, 0.0, 0.1), (0.13, 1.0, -0.2), (0.29, 2.0, 0.15), (0.17, 4.0, 0.3))
    q = np.stack([np.cos(rate * time + phase) + mean for rate, phase, mean in tones], axis=1)
    out: Array = q / np.linalg.norm(q, axis=1, keepdims=True)
    return out


def _jumping(rng: np.random.Generator) -> Array:
    q = rng.standard_normal((SAMPLES, 4))
    out: Array = q / np.linalg.norm(q, axis=1, keepdims=True)
    return out
