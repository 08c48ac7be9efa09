"""Surveys to be damaged: one sound survey in memory, written with plain h5py or as text after each damage."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

EPOCH = "seconds since 2026-03-21T09:00:00Z"

SCENARIO: dict[str, Any] = {
    "title": "a survey to be damaged",
    "authors": ["magtensor"],
    "seed": 3,
    "start": "2026-03-21T09:00:00Z",
    "rate_Hz": 2.0,
    "instrument": {
        "seed": 41,
        "array": {"shape": "cross", "baseline_m": 0.5},
        "errors": {
            "scale": 0.01, "non_orthogonality_deg": 0.5, "misalignment_deg": 1.0, "soft_iron": 0.005,
            "hard_iron_nT": 60.0, "bias_nT": 100.0,
        },
        "noise": {"white_sd_nT": 0.5},
    },
    "motion": {"type": "tumbling", "duration_s": 250.0, "rate_rms_deg_s": 20.0, "rate_time_s": 4.0},
    "field": {
        "earth": {"total_field_nT": 49500.0, "inclination_deg": 66.0, "declination_deg": 4.0},
        "variation": {"diurnal": {"amplitude_nT": [5.0, -20.0, 8.0], "start_hour": 9.0}},
    },
    "base_station": {"rate_Hz": 0.5, "noise_sd_nT": 0.1, "resolution_nT": 0.01},
}  # fmt: skip


@dataclass
class Contents:
    """A survey file before it is written: datasets by path, with their attributes.

    Attributes:
        values: arrays by dataset path.
        attributes: of each dataset.
    """

    values: dict[str, Any]
    attributes: dict[str, dict[str, Any]] = field(default_factory=dict)

    def copy(self) -> Contents:
        return copy.deepcopy(self)

    @property
    def b(self) -> NDArray[np.float64]:
        """(N, S, 3) raw output, to be changed in place."""
        out: NDArray[np.float64] = self.values["b_raw"]
        return out

    @property
    def time(self) -> NDArray[np.float64]:
        """(N,) s, to be changed in place."""
        out: NDArray[np.float64] = self.values["time"]
        return out

    @property
    def reference(self) -> NDArray[np.float64]:
        """(M,) reference total field, to be changed in place."""
        out: NDArray[np.float64] = self.values["reference/total_field"]
        return out

    def rows(self, keep: Any) -> None:
        """Keep only these samples of the array."""
        for path in ("b_raw", "time"):
            self.values[path] = self.values[path][keep]

    def drop(self, *paths: str) -> None:
        for path in paths:
            del self.values[path]
            self.attributes.pop(path, None)

    def write(self, path: Path) -> Path:
        """Write with plain h5py, without dimension scales."""
        with h5py.File(path, "w") as file:
            for name, values in self.values.items():
                array = np.asarray(values)
                kind = h5py.string_dtype() if array.dtype.kind in "UO" else None
                file.create_dataset(name, data=array.astype(object) if kind else array, dtype=kind)
                file[name].attrs.update(self.attributes.get(name, {}))
        return path


def contents_of(path: Path) -> Contents:
    """Everything but the truth of a survey file."""
    found = Contents({})

    def take(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("truth"):
            values = item[()]
            found.values[name] = np.array([v.decode() for v in values]) if values.dtype.kind == "O" else values
            found.attributes[name] = {k: item.attrs[k] for k in ("units", "long_name") if k in item.attrs}

    with h5py.File(path) as file:
        file.visititems(take)
    return found


def true_field(path: Path) -> NDArray[np.float64]:
    """(N, S, 3) nT, the field that a simulated survey's sensors saw."""
    with h5py.File(path) as file:
        out: NDArray[np.float64] = file["truth/b_true"][()]
    return out


def calibration_error(b: NDArray[np.float64], truth: NDArray[np.float64]) -> tuple[float, float]:
    """How wrong a calibrated field is, nT rms per component: the mean field, and the differences from it.

    One rotation common to all sensors is free. Returned are the errors of the mean over the sensors and of the
    sensors' differences from that mean.

    Args:
        b: (N, S, 3) calibrated; truth: (N, S, 3).
    """
    mean, mean_true = b.mean(axis=1), truth.mean(axis=1)
    u, _, vt = np.linalg.svd(mean_true.T @ mean)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    turned = b @ rotation.T
    difference = (turned - turned.mean(axis=1, keepdims=True)) - (truth - mean_true[:, None])
    common = turned.mean(axis=1) - mean_true
    return float(np.sqrt(np.mean(common**2))), float(np.sqrt(np.mean(difference**2)))
