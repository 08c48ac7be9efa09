"""Level flights drawn here, without the simulator and without the code of the regressors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
TOTAL = 49_500.0
DIP = np.radians(66.0)


@dataclass(frozen=True)
class Flight:
    """total (N,), raw (N, S, 3), field (N, 3) of the platform, offset (S, 3), nT; forward (S, 3, 3); current (N,) A."""

    total: Array
    raw: Array
    field: Array
    forward: Array
    offset: Array
    current: Array


def smooth(rng: np.random.Generator, count: int, samples: float) -> Array:
    """(N,) of unit variance, correlated over so many samples."""
    from scipy.ndimage import gaussian_filter1d

    series = gaussian_filter1d(rng.standard_normal(count + int(8 * samples)), samples)[int(4 * samples) :][:count]
    out: Array = (series - series.mean()) / series.std()
    return out


def flight(
    seed: int,
    sensors: int = 2,
    *,
    noise: float = 5.0,
    tilt_deg: float = 1.5,
    count: int = 1500,
    scale: float = 0.05,
    offset: float = 1500.0,
    effect: Array | None = None,
    swing: float = 0.0,
) -> Flight:
    """Ten samples a second: the heading wanders round, roll and pitch by `tilt_deg` rms.

    `effect` (3,) nT/A is what the current adds to the last sensor; it draws more when the platform leans. The total
    field swings by `swing` nT.
    """
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(smooth(rng, count, 40.0)) * 0.03
    roll, pitch = (np.radians(tilt_deg) * smooth(rng, count, 12.0) for _ in range(2))
    world = TOTAL * np.array([np.cos(DIP), 0.0, np.sin(DIP)])  # north, east, down
    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    level = np.stack([cy * world[0], -sy * world[0], np.full(count, world[2])], axis=1)
    x, z = cp * level[:, 0] - sp * level[:, 2], sp * level[:, 0] + cp * level[:, 2]
    field = np.stack([x, cr * level[:, 1] + sr * z, -sr * level[:, 1] + cr * z], axis=1)
    total = TOTAL + swing * np.sin(np.arange(count) / 150.0)
    field *= (total / TOTAL)[:, None]
    forward = np.eye(3) + scale * rng.standard_normal((sensors, 3, 3))
    at = offset * rng.standard_normal((sensors, 3))
    raw = np.einsum("sij,nj->nsi", forward, field) + at + noise * rng.standard_normal((count, sensors, 3))
    lean = smooth(rng, count, 30.0) + 20.0 * (roll**2 + pitch**2) / np.radians(tilt_deg) ** 2 / 20.0
    current = 15.0 + 2.0 * lean + 0.1 * rng.standard_normal(count)
    if effect is not None:
        raw[:, -1] += (current - 15.0)[:, None] * effect
    return Flight(total, raw, field, forward, at, current)


def written(path: Path, flown: Flight) -> Path:
    """The flight in the canonical layout."""
    count, sensors, _ = flown.raw.shape
    since = "seconds since 2026-03-21T09:00:00Z"
    variables: dict[str, tuple[Any, str]] = {
        "time": (np.arange(count) / 10.0, since),
        "b_raw": (flown.raw, "nT"),
        "current_battery": (flown.current, "A"),
        "reference/time": (np.arange(count) / 10.0, since),
        "reference/total_field": (flown.total, "nT"),
    }
    with h5py.File(path, "w") as file:
        for name, (values, units) in variables.items():
            file.create_dataset(name, data=values).attrs["units"] = units
        file.create_dataset("sensor", data=[f"M{s + 1}" for s in range(sensors)], dtype=h5py.string_dtype())
        file.create_dataset("axis", data=list("xyz"), dtype=h5py.string_dtype())
    return path
