"""What could follow the attitude, whatever the law: monomials of the field's direction and of logged vectors."""

from __future__ import annotations

import numpy as np

from magtensor.attitude import into_platform
from magtensor.calibration.types import Array
from magtensor.error_models.excitation import VECTORS, Excitation


def direction_series(x: Excitation) -> Array:
    """(N, K): second and third degree of the field's direction, and its rate of change.

    The first degree is the fit's own: it belongs to C.
    """
    u = _unit(x.field[:, 0])
    rate = x.derivative(u)
    spread = rate.std()
    columns = [u[:, i] * u[:, j] for i in range(3) for j in range(i, 3) if (i, j) != (2, 2)]
    thirds = [(i, j, k) for i in range(3) for j in range(i, 3) for k in range(j, 3) if (i, j, k) != (2, 2, 2)]
    columns += [u[:, i] * u[:, j] * u[:, k] for i, j, k in thirds]
    if spread > 0:
        columns += [rate[:, i] / spread for i in range(3)]
    return np.column_stack(columns)


def attitude_series(x: Excitation) -> Array:
    """(N, K): `direction_series`, and every logged attitude, acceleration and rate, alone and times the direction."""
    u = _unit(x.field[:, 0])
    columns = [direction_series(x)]
    vectors = [x.logged[name] / max(x.logged[name].std(), 1e-300) for name in VECTORS if name in x.logged]
    if x.attitude is not None:
        vectors += [into_platform(x.attitude, axis) for axis in np.eye(3)[[0, 2]]]
    for v in vectors:
        columns += [v, np.einsum("ni,nj->nij", u, v).reshape(len(v), -1)]
    return np.column_stack(columns)


def turning_Hz(x: Excitation) -> float:
    """How often the platform turns in a second, rms; without attitude only the turning of the field tells."""
    axes = [_unit(x.field[:, 0])]
    if x.attitude is not None:
        axes = [into_platform(x.attitude, axis) for axis in np.eye(3)]
    squares = sum(np.mean(np.sum(x.derivative(axis) ** 2, axis=1)) for axis in axes)
    return float(np.sqrt(squares / (2.0 if len(axes) == 3 else 1.0)) / (2.0 * np.pi))  # three axes show a turn twice


def _unit(vectors: Array) -> Array:
    out: Array = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return out
