"""Attitude quaternions: scalar last, platform to world."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array


def into_platform(attitude: Array, world: Array) -> Array:
    """A world vector in the platform frame at every sample.

    Args:
        attitude: (N, 4), scalar last, platform to world; NaN where unknown.
        world: (3,) in the world frame.

    Returns:
        (N, 3); NaN where the attitude is.
    """
    q = np.asarray(attitude, dtype=float)
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    axis, scalar = -q[:, :3], q[:, 3:]  # the inverse rotation
    once = np.cross(axis, world)
    out: Array = world + 2.0 * (scalar * once + np.cross(axis, once))
    return out
