"""Rotations in the conventions of the papers: passive elementary matrices and their products.

Everything here is passive: ``b_new = R @ b_old`` gives the components of one vector in a turned frame, as in
Chi 2017 eq. 4 and Li 2018 eqs. 5-6. Angles are in rad.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .types import Array

CHI_SEQUENCE = "yxz"  # R1(gamma) R2(beta) R3(alpha), Chi 2017 eq. 4
LI_SEQUENCE = "xyz"  # A_alpha A_beta A_gamma, from the platform to the sensor, as Li's simulation applies them


def elementary(axis: str, angle: float) -> Array:
    """Passive rotation (3, 3) about one axis (Chi 2017 eq. 4; Li 2018 eq. 5).

    Parameters
    ----------
    axis: "x", "y" or "z".
    angle: rad.
    """
    c, s = np.cos(angle), np.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    r = np.eye(3)
    r[i, i] = r[j, j] = c
    r[i, j], r[j, i] = s, -s
    return r


def elementary_derivative(axis: str, angle: float) -> Array:
    """Derivative (3, 3) of `elementary` with respect to its angle, 1/rad."""
    derivative = elementary(axis, angle + np.pi / 2)
    k = "xyz".index(axis)
    derivative[k, k] = 0.0
    return derivative


def sequence(axes: str, angles: Sequence[float] | Array) -> Array:
    """Product (3, 3) of three elementary rotations in reading order: the last one acts first.

    Parameters
    ----------
    axes: three letters such as "yxz".
    angles: (3,) rad, one for each letter.
    """
    first, second, third = (elementary(a, float(v)) for a, v in zip(axes, angles, strict=True))
    out: Array = first @ second @ third
    return out


def sequence_derivatives(axes: str, angles: Sequence[float] | Array) -> Array:
    """Derivatives (3, 3, 3) of `sequence`; the first index is the angle, 1/rad."""
    factors = [elementary(a, float(v)) for a, v in zip(axes, angles, strict=True)]
    out = []
    for k, (axis, angle) in enumerate(zip(axes, angles, strict=True)):
        turned = [*factors]
        turned[k] = elementary_derivative(axis, float(angle))
        out.append(turned[0] @ turned[1] @ turned[2])
    return np.array(out)


def sequence_angles(axes: str, rotation: Array) -> Array:
    """Angles (3,) rad that make `sequence(axes, angles)` the proper rotation given.

    The middle angle lies in [-pi/2, pi/2]. At its ends the outer two act about one axis and only their sum or
    difference is defined; the third is then set to zero.
    """
    i, j, k = ("xyz".index(a) for a in axes)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0  # even permutation of the axes or odd
    middle = np.arctan2(-sign * rotation[i, k], np.hypot(rotation[i, i], rotation[i, j]))
    if np.hypot(rotation[i, i], rotation[i, j]) < 1e-12:
        return np.array([np.arctan2(-sign * rotation[k, j], rotation[j, j]), middle, 0.0])
    first = np.arctan2(sign * rotation[j, k], rotation[k, k])
    third = np.arctan2(sign * rotation[i, j], rotation[i, i])
    return np.array([first, middle, third])


def cross_matrix(v: Array) -> Array:
    """Matrix (3, 3) of the cross product: ``cross_matrix(v) @ w == np.cross(v, w)``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def from_vector(vector: Array) -> Array:
    """Active rotation (3, 3) by |vector| rad about the direction of `vector` (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    w = cross_matrix(vector)
    half = np.sinc(angle / (2 * np.pi)) ** 2 / 2  # (1 - cos a)/a^2 without a loss at small angles
    out: Array = np.eye(3) + np.sinc(angle / np.pi) * w + half * w @ w
    return out


def to_vector(rotation: Array) -> Array:
    """Rotation vector (3,) rad of an active proper rotation, the inverse of `from_vector`; length in [0, pi]."""
    from scipy.spatial.transform import Rotation

    out: Array = Rotation.from_matrix(rotation).as_rotvec()
    return out


def angle_between(first: Array, second: Array) -> float:
    """Angle in rad of the rotation that leads from `first` to `second`, exact also for tiny angles."""
    return float(np.linalg.norm(to_vector(second @ first.T)))


def nearest_orthogonal(matrix: Array, determinant: int) -> Array:
    """The orthogonal matrix (3, 3) of the given determinant (1 or -1) nearest to `matrix`."""
    u, _, vt = np.linalg.svd(matrix)
    sign = determinant * np.sign(np.linalg.det(u @ vt))
    out: Array = (u * np.array([1.0, 1.0, sign])) @ vt
    return out
