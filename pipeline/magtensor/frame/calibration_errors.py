"""The errors of a calibration as independent unit variables, and the rotation that is common to all sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import PARAMETERS_PER_SENSOR, Array, ArrayCalibration

from .sources import TURNS

_NEGLIGIBLE = 1e-14  # of the largest eigenvalue of the correlation


@dataclass(frozen=True)
class CalibrationErrors:
    """A calibration's covariance C = root root', and what each of the R columns does to the calibrated field.

    Attributes:
        root: (12 S, R).
        field: (R, S, 3, 4); the field of sensor s is wrong by field[k, s] @ (b_s, 1) per unit of the k-th error.
        common: (3, R) rad; the rotation of all sensors together that is part of it.
    """

    root: Array
    field: Array
    common: Array

    @property
    def own(self) -> Array:
        """(R, S, 3, 4): `field` without the common rotation."""
        out = self.field.copy()
        out[..., :3] -= np.einsum("wr,wij->rij", self.common, TURNS)[:, None]
        return out

    @property
    def of_mean(self) -> Array:
        """(R, 3, 3 S + 1): what the errors add to the mean of the sensors' fields, on (b_1, ..., b_S, 1)."""
        each = self.field / self.field.shape[1]
        by_field = each[..., :3].transpose(0, 2, 1, 3).reshape(len(each), 3, -1)
        return np.concatenate([by_field, each[..., 3].sum(axis=1)[..., None]], axis=2)


def directions(b: Array) -> tuple[Array, Array]:
    """(N, 3) direction of the mean field, and (N, 3 S + 1) per field: what `CalibrationErrors.of_mean` acts on.

    Parameters
    ----------
    b: (N, S, 3) nT.
    """
    mean = b.mean(axis=1)
    size = np.linalg.norm(mean, axis=1)[:, None]
    return mean / size, np.column_stack([b.reshape(len(b), -1), np.ones(len(b))]) / size


def tilt(matrix: Array) -> Array:
    """(12 S, 3): how the parameters move when the calibrated fields of all sensors turn by a rotation vector."""
    out = np.zeros((len(matrix), PARAMETERS_PER_SENSOR, 3))
    out[:, :9] = np.einsum("wij,sjk->sikw", TURNS, matrix).reshape(len(matrix), 9, 3)
    return out.reshape(-1, 3)


def errors_of(calibration: ArrayCalibration) -> CalibrationErrors:
    """The errors of a calibration; none where its method gives no covariance."""
    matrix, sensors = calibration.matrix, len(calibration.matrix)
    root = _root(calibration.covariance)
    each = root.T.reshape(-1, sensors, PARAMETERS_PER_SENSOR)
    field = np.zeros((len(each), sensors, 3, 4))
    field[..., :3] = each[..., :9].reshape(-1, sensors, 3, 3) @ np.linalg.inv(matrix)
    field[..., 3] = -np.einsum("sij,rsj->rsi", matrix, each[..., 9:])
    common: Array = np.asarray(np.linalg.pinv(tilt(matrix)) @ root, dtype=np.float64)
    return CalibrationErrors(root, field, common)


def _root(covariance: Array) -> Array:
    if not np.isfinite(covariance).all():
        return np.zeros((len(covariance), 0))
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    kept = values > _NEGLIGIBLE * max(values[-1], 0.0)
    out: Array = vectors[:, kept] * np.sqrt(values[kept]) * scale[:, None]
    return out
