"""A small array survey that tests damage."""

from __future__ import annotations

from typing import Any

import numpy as np

START = "seconds since 2022-08-10T00:00:00Z"


def array_variables(samples: int = 400, sensors: int = 4, seed: int = 1) -> dict[str, Any]:
    """A tumbling array in 48 000 nT with 1 nT noise, sensor errors, a reference, two channels."""
    rng = np.random.default_rng(seed)
    directions = np.cumsum(rng.normal(size=(samples, 3)), axis=0) * 0.2 + rng.normal(size=3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    field = 48_000.0 * directions[:, None, :] * (1 + 0.01 * rng.normal(size=(1, sensors, 3)))
    field = field + 50 * rng.normal(size=(1, sensors, 3)) + rng.normal(size=(samples, sensors, 3))
    reference = np.arange(-1.0, samples * 0.1 + 2.0)
    return {
        "time": (("time",), np.arange(samples) * 0.1, {"units": START}),
        "sensor": (("sensor",), np.array([f"S{i + 1}" for i in range(sensors)]), {}),
        "axis": (("axis",), np.array(["x", "y", "z"]), {}),
        "b_raw": (("time", "sensor", "axis"), field, {"units": "nT"}),
        "position": (("sensor", "axis"), rng.normal(size=(sensors, 3)), {"units": "m"}),
        "temperature": (("time",), 20 + rng.normal(size=samples), {"units": "degC"}),
        "current_motor": (("time",), rng.normal(size=samples) ** 2, {"units": "A"}),
        "reference/time": (("time",), reference, {"units": START}),
        "reference/total_field": (("time",), 48_000 + 5 * np.sin(reference / 9), {"units": "nT"}),
    }
