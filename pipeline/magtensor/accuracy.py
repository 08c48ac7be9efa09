"""The error figures of a calibrated survey: one block, made the same way for every survey and every report."""

from __future__ import annotations

from typing import Any

import numpy as np

from magtensor.calibration.types import Array

COMPONENTS = ("xx", "xy", "xz", "yy", "yz", "zz")
_INDEX = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_FREE = 3 + len(_INDEX)  # of what |b| tells of a sensor's calibration
_STEPS = 20
_SETTLED = 1e-3  # of the sum of squares
_SHOWN = 1e-4  # of the largest singular value: noise of an axis that is never used would be taken for a direction


def figure(value: float) -> str:
    """Three digits as a person writes them: 2090, not 2.09e+03."""
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


@np.errstate(over="ignore")  # of a fit that has run away an error is infinite, and that is what is asked
def error_block(
    b: Array, total_field: Array | None, tensor: Array | None, good: np.ndarray, sensors: list[str]
) -> dict[str, Any]:
    """Error figures over the samples in use, where the survey was taken in a uniform field.

    Args:
        b: (N, S, 3) nT calibrated.
        total_field: (N,) nT reference; None where there is none.
        tensor: (N, 3, 3) nT/m; None with fewer than three sensors.
        good: (N, S) samples in use.
        sensors: names.

    Returns:
        `total_field_rms_nT` per sensor and `all`, `tensor_rms_nT_per_m` per component and `all` (rms over the nine
        entries), `invariant_rms` of I1 and I2, `samples`. A figure that the survey cannot give is None.
    """
    use = good.all(axis=1)
    block: dict[str, Any] = {"total_field_rms_nT": None, "tensor_rms_nT_per_m": None, "invariant_rms": None}
    if total_field is not None:
        residual = np.linalg.norm(b, axis=2) - total_field[:, None]
        known = good & np.isfinite(residual)
        figures = {s: rms(residual[known[:, i], i]) for i, s in enumerate(sensors)}
        block["total_field_rms_nT"] = figures | {"all": rms(residual[known])}
        use = use & np.isfinite(total_field)
    if tensor is not None:
        g = tensor[use & np.isfinite(tensor).all(axis=(1, 2))]
        parts = {f"{n}": rms(g[:, i, j]) for n, (i, j) in zip(COMPONENTS, _INDEX, strict=True)}
        block["tensor_rms_nT_per_m"] = parts | {"all": rms(g)}
        block["invariant_rms"] = {
            "I1_nT2_per_m2": rms(-0.5 * np.einsum("nij,nij->n", g, g)),
            "I2_nT3_per_m3": rms(np.linalg.det(g)) if len(g) else None,
        }
    return block | {"samples": int(use.sum())}


def left_by_any_calibration(b: Array, total_field: Array, good: np.ndarray) -> float | None:
    """nT rms of |b| - F that no other offsets and matrices of the sensors take off; None of nothing.

    A survey that disagrees with a calibration for what this leaves has noise or a disturbance of its own.

    Args:
        b: (N, S, 3) nT calibrated, however badly; total_field: (N,) nT; good: (N, S) samples in use.
    """
    left = []
    for sensor in range(b.shape[1]):
        use = good[:, sensor] & np.isfinite(total_field) & np.isfinite(b[:, sensor]).all(axis=1)
        if np.count_nonzero(use) > _FREE:
            left.append(_left_of_one(b[use, sensor], total_field[use]))
    return rms(np.concatenate(left)) if left else None


def _left_of_one(own: Array, total_field: Array) -> Array:
    """(N,) nT, |b| - F of one sensor's vectors (N, 3) after the best linear correction, by Gauss-Newton steps."""
    left = np.linalg.norm(own, axis=1) - total_field
    size = float(np.mean(total_field))
    for _ in range(_STEPS):
        unit = own / np.linalg.norm(own, axis=1, keepdims=True)
        products = [own[:, i] * unit[:, j] / size for i, j in _INDEX]
        free = np.linalg.lstsq(np.column_stack([unit, *products]), left, rcond=_SHOWN)[0]
        matrix = np.zeros((3, 3))
        for value, (i, j) in zip(free[3:], _INDEX, strict=True):
            matrix[i, j] += value / (2.0 * size)
            matrix[j, i] += value / (2.0 * size)
        own = own - free[:3] - own @ matrix
        after = np.linalg.norm(own, axis=1) - total_field
        gained = float(np.sum(left**2) - np.sum(after**2))
        if not gained > 0:
            break
        left = after
        if gained < _SETTLED * np.sum(left**2):
            break
    return left


def rms(values: Array) -> float | None:
    """Root mean square; None of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else None
