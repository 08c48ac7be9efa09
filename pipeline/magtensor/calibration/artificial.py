"""Array calibration to an artificial platform vector (Li 2018).

The mean of the sensors' raw outputs is taken for the output of one sensor at the array's centre. Its scalar
calibration gives a vector B in a frame of its own, and every sensor is fitted to that vector: twelve parameters
each, all sensors in one common frame. The frame is that of the mean sensor's triangular factor, degrees away from
the platform's where the sensors have large errors; no datum here shows that rotation.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from magtensor.errors import DataError

from .agreement import require_agreement
from .alignment import COMMON_ROTATION, handedness
from .axes import axis_faults
from .by_sensor import by_sensor
from .covariance import scalar_influence
from .rotation import nearest_orthogonal
from .scalar import checked_samples
from .types import PARAMETERS_PER_SENSOR, Array, ArrayCalibration, SensorCalibration
from .vector import LiFit, affine_to_correction, levenberg_marquardt

FRAME = "artificial platform"

_CHUNK = 4096


def calibrate_to_mean(
    raw: Array,
    total_field: Array,
    calibrate_sensor: Callable[[Array, Array], SensorCalibration],
) -> ArrayCalibration:
    """Fit every sensor to the calibrated mean of all (Li 2018 sections 3.2 and 3.3).

    Parameters
    ----------
    raw: (N, S, 3) nT, in a field uniform over the array; S at least 2.
    total_field: (N,) nT.
    calibrate_sensor: scalar calibration in the "cholesky" frame, applied to the mean and, to judge the attitudes,
        to each sensor.

    Raises
    ------
    NotEnoughData: the attitudes do not determine the parameters of the mean or of a sensor.
    DataError: inverted or swapped axes, named.
    """
    raw = np.asarray(raw, dtype=float)
    if raw.ndim != 3 or raw.shape[2] != 3:
        raise ValueError(f"raw {raw.shape} is not (N, S, 3)")
    if raw.shape[1] < 2:
        raise DataError(
            "there is only one sensor, and the mean of all sensors is itself",
            hint="calibrate_scalar calibrates a single sensor",
        )
    sensors = raw.shape[1]
    alone = []
    for s in range(sensors):
        try:
            alone.append(calibrate_sensor(*checked_samples(raw[:, s], total_field)))
        except DataError as error:
            where = f"sensor {s + 1}" + (f", {error.where}" if error.where else "")
            raise type(error)(error.what, where=where, hint=error.hint) from error
    _refuse_turned_axes(raw, total_field, alone)
    mean = raw.mean(axis=1)
    platform = calibrate_sensor(*checked_samples(mean, total_field))
    reference = platform.apply(mean)
    fits = [levenberg_marquardt(raw[:, s], reference) for s in range(sensors)]
    matrix, offset = np.array([f.matrix for f in fits]), np.array([f.offset for f in fits])
    b = by_sensor(matrix, raw - offset)
    contrast = reference[:, None] - b
    noise = _noise(contrast, platform, matrix)
    diagnostics: dict[str, float | str] = {
        "platform_residual_rms_nT": platform.residual_rms,
        "evaluations": float(sum(f.evaluations for f in fits)),
    }
    for s in range(sensors):
        diagnostics[f"noise_{s + 1}_nT"] = float(noise[s])
        diagnostics[f"residual_rms_{s + 1}_nT"] = float(
            np.sqrt(np.mean((np.linalg.norm(b[:, s], axis=1) - total_field) ** 2))
        )
        diagnostics[f"contrast_rms_{s + 1}_nT"] = float(np.sqrt(np.mean(contrast[:, s] ** 2)))
    return ArrayCalibration(
        matrix,
        offset,
        _covariance(raw, total_field, platform, fits, noise),
        FRAME,
        (COMMON_ROTATION,),
        diagnostics,
    )


def _refuse_turned_axes(raw: Array, total_field: Array, alone: list[SensorCalibration]) -> None:
    """The mean is a sensor only where all sensors have like axes."""
    b = [c.apply(raw[:, s]) for s, c in enumerate(alone)]
    maps = []
    for s in range(len(alone)):
        hand = handedness(b[0], b[s])
        maps.append(hand.mirror if hand.mirrored else nearest_orthogonal(b[0].T @ b[s], 1))
    require_agreement(np.stack([x @ m.T for x, m in zip(b, maps, strict=True)], axis=1), total_field)
    words = axis_faults(np.array(maps), 0, [f"sensor {s + 1}" for s in range(len(alone))])
    if words:
        raise DataError(
            f"{'; '.join(words)}, so the mean of the sensors is no sensor",
            hint="bring the axes of all sensors to one order and sign when loading the survey",
        )


def _noise(contrast: Array, platform: SensorCalibration, matrix: Array) -> Array:
    """Raw noise (S,) nT per axis of each sensor.

    What each fit leaves holds the noise of the reference, the mean's, and of the sensor itself; with the scalar
    residual of the mean these are S + 1 equations, linear in the S variances.
    """
    from scipy.optimize import nnls

    n, sensors = contrast.shape[:2]
    rows = np.zeros((sensors + 1, sensors))
    seen = np.zeros(sensors + 1)
    for s in range(sensors):
        for q in range(sensors):
            rows[s, q] = np.sum((platform.matrix / sensors - (q == s) * matrix[s]) ** 2)
        seen[s] = np.sum(contrast[:, s] ** 2) / max(n - 4, 1)
    size = float(np.sum(platform.matrix**2))
    rows[sensors] = size / sensors**2
    seen[sensors] = size * float(platform.diagnostics["noise_nT"]) ** 2
    out: Array = np.sqrt(nnls(rows, seen)[0])
    return out


def _covariance(raw: Array, total_field: Array, platform: SensorCalibration, fits: list[LiFit], noise: Array) -> Array:
    """Covariance (12 S, 12 S): every sensor's noise reaches every fit through the mean.

    The fit of sensor s is the regression of B on z = (m_s, 1), so the disturbance d_j of B_j - M (m_j - o) moves
    its rows by sum_j d_j h_j^T with h_j = (Z^T Z)^-1 z_j. d_j holds the noise of the mean in sample j, the error
    that all its noise causes in the mean's calibration, and the noise of the sensor.
    """
    sensors, p = raw.shape[1], PARAMETERS_PER_SENSOR
    mean = raw.mean(axis=1)
    scalar = scalar_influence(platform.matrix, platform.offset, mean, total_field, platform.frame)
    centred = mean - platform.offset
    # what an error of the mean's calibration does to each fit
    effects = np.zeros((sensors, 3, 4, p))
    for s, fit in enumerate(fits):
        first = _rows(raw[:, s]).T @ np.column_stack([centred, np.ones(len(raw))])
        spread = fit.inverse @ first  # (4, 4): sum_j h_j (m_j - o, 1)
        for a in range(3):
            effects[s, a, :, 3 * a : 3 * a + 3] = spread[:, :3]
            effects[s, a, :, 9:] = -spread[:, [3]] * platform.matrix[a]
    through = effects.reshape(sensors * p, p)
    total = np.zeros((sensors * p, sensors * p))
    blocks = [slice(p * s, p * s + p) for s in range(sensors)]
    for start in range(0, len(raw), _CHUNK):
        part = slice(start, start + _CHUNK)
        n = len(raw[part])
        h = [_rows(raw[part, s]) @ fit.inverse for s, fit in enumerate(fits)]
        common = np.concatenate(
            [np.einsum("ae,nk->nake", platform.matrix, h[s]).reshape(n, p, 3) for s in range(sensors)], axis=1
        )
        common += np.einsum("qp,pn,ne->nqe", through, scalar.gain[:, part], scalar.direction[part], optimize=True)
        for q in range(sensors):
            effect = common / sensors
            effect[:, blocks[q]] -= np.einsum("ae,nk->nake", fits[q].matrix, h[q]).reshape(n, p, 3)
            flat = effect.transpose(1, 0, 2).reshape(sensors * p, 3 * n)
            total += noise[q] ** 2 * flat @ flat.T
    to_correction = np.zeros_like(total)
    for s, fit in enumerate(fits):
        to_correction[blocks[s], blocks[s]] = affine_to_correction(fit.matrix, fit.offset)
    out: Array = to_correction @ total @ to_correction.T
    return out


def _rows(raw: Array) -> Array:
    return np.column_stack([raw, np.ones(len(raw))])
