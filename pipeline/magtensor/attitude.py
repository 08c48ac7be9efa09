"""Attitude quaternions (scalar last, platform to world), and the rotation from another frame into the platform's.

Seen from the world a uniform field keeps its direction, and the mean direction is longest for the right rotation.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from magtensor.calibration.rotation import from_vector, to_vector
from magtensor.calibration.types import Array

FAR_BETTER = 3.0  # times: what leaves so much less is believed before the nearest rotation, or the given reading
MOUNTED = float(np.radians(2.0))  # rad, standard deviation: how well axes are parallel to the platform's
FITS = float(np.radians(3.0))  # rad rms, left by a rotation that no other one needs to be tried for
_STEPS = 100
_LENGTHENED = 1e-12


def into_platform(attitude: Array, world: Array) -> Array:
    """A world vector in the platform frame at every sample.

    Args:
        attitude: (N, 4), scalar last, platform to world; NaN, or all zero, where unknown.
        world: (3,) in the world frame.

    Returns:
        (N, 3); NaN where the attitude is.
    """
    q = np.asarray(attitude, dtype=float)
    length = np.linalg.norm(q, axis=1, keepdims=True)
    q = q / np.where(length > 0.0, length, np.nan)
    axis, scalar = -q[:, :3], q[:, 3:]  # the inverse rotation
    once = np.cross(axis, world)
    out: Array = world + 2.0 * (scalar * once + np.cross(axis, once))
    return out


def continuous(quaternions: Array) -> Array:
    """The same rotations with signs that do not jump, so that they can be interpolated."""
    dots = np.einsum("ij,ij->i", quaternions[1:], quaternions[:-1])
    flips = np.where(np.nan_to_num(dots, nan=1.0) < 0, -1.0, 1.0)
    out: Array = quaternions * np.concatenate(([1.0], np.cumprod(flips)))[:, None]
    return out


def to_world(attitude: Array) -> Array:
    """(N, 3, 3): the rotation from the platform into the world; row k is the world's axis k in the platform frame."""
    return np.stack([into_platform(attitude, axis) for axis in np.eye(3)], axis=1)


def seen_from_world(turns: Array, direction: Array) -> Array:
    """(3, 3, 3): with a rotation Q (j, a) of directions (N, 3) into the platform frame, einsum("ija,ja->i") of it is
    the mean direction in the world. `turns` (N, 3, 3) as of `to_world`."""
    out: Array = np.einsum("nij,na->ija", turns, direction) / len(direction)
    return out


def longest(mean: Array, rotation: Array, *, mirrored: bool = True) -> tuple[float, Array]:
    """The length of the mean direction in the world, made longest by turns from a start, and the rotation there.

    Turns that change nothing (about the vertical, of a rig that stays level) are not made.

    Parameters
    ----------
    mean: (3, 3, 3) as in `seen_from_world`.
    rotation: (3, 3) to start with.
    mirrored: whether a mirror counts as a rotation.
    """
    length = 0.0
    for _ in range(_STEPS):
        h = np.einsum("ija,ja->i", mean, rotation)
        before, length = length, float(np.linalg.norm(h))
        if length <= before + _LENGTHENED:
            break
        u, _, vt = np.linalg.svd(np.einsum("i,ija->ja", h, mean))
        if not mirrored and np.linalg.det(u @ vt) < 0:
            u[:, -1] *= -1.0
        rotation = np.asarray(u @ vt)
    return length, rotation


def right_angled() -> list[Array]:
    """The 24 proper rotations that take axes to axes, the one that turns nothing first."""
    found = [np.eye(3)[list(order)] * signs for order in permutations(range(3)) for signs in product((1, -1), repeat=3)]
    return sorted((p for p in found if np.linalg.det(p) > 0), key=lambda p: -float(np.trace(p)))


def into_platform_frame(quaternions: Array, field: Array) -> Array:
    """(3, 3): the rotation that takes a field's frame into the platform's, as an attitude has it.

    The nearest one, unless another leaves far less: of sensors that are mounted another way round. About axes that the
    motion shows less of than the attitude's errors, all of them taken for lasting ones, the sensors' axes are parallel
    to the platform's.

    Parameters
    ----------
    quaternions: (N, 4), NaN where unknown; field: (N, 3), in any unit.
    """
    use = np.isfinite(quaternions).all(axis=1) & np.isfinite(field).all(axis=1)
    if not use.any():
        return np.eye(3)
    turns, direction = to_world(quaternions[use]), field[use] / np.linalg.norm(field[use], axis=1, keepdims=True)
    mean = seen_from_world(turns, direction)
    parallel, *others = right_angled()
    length, found = longest(mean, parallel, mirrored=False)
    left = max(1.0 - length**2, 0.0)
    if left > FITS**2:
        length, best = max((longest(mean, start, mirrored=False) for start in others), key=lambda each: each[0])
        if FAR_BETTER**2 * max(1.0 - length**2, 0.0) < left:
            left, found = max(1.0 - length**2, 0.0), best
    mounted = max(right_angled(), key=lambda axes: float(np.sum(axes * found)))
    shown = _shown(turns, direction @ found.T)
    believed = np.linalg.solve(shown + left / MOUNTED**2 * np.eye(3), shown @ to_vector(found @ mounted.T))
    return from_vector(np.asarray(believed, dtype=np.float64)) @ mounted


def _shown(turns: Array, direction: Array) -> Array:
    """(3, 3): mean square by which directions in the world move for a turn of directions (N, 3) by one radian."""
    moved = np.cross(turns, direction[:, None])
    moved -= moved.mean(axis=0)
    out: Array = np.einsum("nij,nik->jk", moved, moved) / len(moved)
    return out
