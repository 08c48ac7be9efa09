"""To what a calibration knows the total field, in the directions of its survey and in those that it never saw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .postures import sphere
from .types import PARAMETERS_PER_SENSOR, Array, ArrayCalibration

_LOOKED_AT = 2000  # samples


@dataclass(frozen=True)
class Known:
    """Standard deviations of |b| by the calibration's own errors, noise of the samples not counted.

    Attributes:
        seen: nT, rms over the directions of the survey and the sensors.
        worst: nT, of the sensor and the direction of the whole sphere where it is largest.
    """

    seen: float
    worst: float

    @property
    def words(self) -> str:
        """For the terminal and the report."""
        return f"|b| is known to {self.seen:.2g} nT in the directions seen, to {self.worst:.2g} nT in the worst one"

    def facts(self) -> dict[str, float]:
        """For `verdict.json`."""
        return {"flown": self.seen, "worst_direction": self.worst}


def facts_of(known: Known, noise: float) -> dict[str, Any]:
    """For `verdict.json`, of a calibration that its attitudes determine: in words where a direction that was not seen
    is known no better than one sample, with noise in nT, tells."""
    told = known.words if known.worst > noise else ""
    return {"determined": True, "description": told, "total_field_std_nT": known.facts()}


def known_to(calibration: ArrayCalibration, field: Array) -> Known:
    """What a calibration knows of |b|, from its covariance.

    Parameters
    ----------
    field: (N, 3) nT, the common field of the survey in the frame of the calibration.
    """
    some = field[:: max(1, len(field) // _LOOKED_AT)]
    length = float(np.mean(np.linalg.norm(some, axis=1)))
    worst = total_field_std(calibration, sphere() * length)
    return Known(float(np.sqrt(np.mean(total_field_std(calibration, some) ** 2))), float(np.max(worst)))


def total_field_std(calibration: ArrayCalibration, field: Array) -> Array:
    """(N, S) nT, the standard deviation of each sensor's |b| in fields b (N, 3) nT, to first order: b = M (m - o), so
    that |b| moves by u' dM M^-1 b - u' M do, u the direction of b."""
    unit = field / np.linalg.norm(field, axis=1, keepdims=True)
    out = np.empty((len(field), len(calibration.matrix)))
    size = PARAMETERS_PER_SENSOR
    for s, matrix in enumerate(calibration.matrix):
        raw = np.linalg.solve(matrix, field.T).T
        slopes = np.hstack([(unit[:, :, None] * raw[:, None, :]).reshape(len(field), 9), -unit @ matrix])
        own = calibration.covariance[size * s : size * (s + 1), size * s : size * (s + 1)]
        out[:, s] = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", slopes, own, slopes), 0.0))
    return out
