"""The covariance of a joint fit, in the frame nearest to the raw axes."""

from __future__ import annotations

import numpy as np

from .blocks import complement
from .common_field import CommonField
from .maximum_likelihood import ScalarFit
from .score_colour import ScoreColour, whitening
from .types import Array

SYMMETRIC = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))  # the order of the scalar fit's parameters


def forward_covariance(
    plane: CommonField, scalar: ScalarFit, forward: Array, q: Array, colour: ScoreColour | None = None
) -> Array:
    """Covariance (12 S, 12 S) of C Q (row by row) and o of each sensor, in the frame of `nearest_frame`.

    In whitened outputs a change W (3 S, 4) of [C | o] moves a sample by W z, z = (b, 1). Perpendicular to the
    plane its information is sum(z z') for every direction; within the plane only u' U V' W z / spread is seen,
    which the rotation of b leaves unchanged: the three directions of the gauge have no information and are then
    fixed by the frame's own condition.

    Parameters
    ----------
    forward: (S, 3, 3) C Q; q: (3, 3) Q.
    colour: of the scores; white noise when None.
    """
    sensors = len(forward)
    turn = np.eye(4)
    turn[:3, :3] = q
    white = whitening(scalar.scores.moments, scalar.scores.normal)
    # within the plane: parameters A = V' W (3, 4), row by row, change the field by U A (Q' b, 1)
    to_field = np.zeros((9, 3, 4))
    for k, (i, j) in enumerate(SYMMETRIC):
        to_field[k, :, :3] = (np.outer(scalar.matrix[i], q[j]) + np.outer(scalar.matrix[j], q[i])) / 2
    to_field[6:, :, 3] = scalar.matrix
    inside = np.kron(plane.basis, np.eye(4)) @ np.linalg.pinv(to_field.reshape(9, 12)) @ white.along
    outside = np.kron(complement(plane), turn.T @ white.across)
    # rows of W: output after output, [C | o] along them
    moved = np.concatenate([outside, inside], axis=1) * np.repeat(plane.noise, 4)[:, None]
    if colour is None:
        moved[:, -9:] *= np.sqrt(max(scalar.chi2, 1.0))
        covariance = moved @ moved.T
    else:
        covariance = moved @ colour.covariance @ moved.T
    pick = []
    for s in range(sensors):
        pick += [4 * (3 * s + i) + j for i in range(3) for j in range(3)]
        pick += [4 * (3 * s + i) + 3 for i in range(3)]
    covariance = covariance[np.ix_(pick, pick)]
    fixing = frame_projection(forward)
    out: Array = fixing @ covariance @ fixing.T
    return out


def to_corrections(matrix: Array) -> Array:
    """(12 S, 12 S): derivative of the corrections' elements and offsets with C (row by row) and o of each sensor.

    Parameters
    ----------
    matrix: (S, 3, 3), C^-1.
    """
    out = np.eye(12 * len(matrix))
    for s, m in enumerate(matrix):
        block = slice(12 * s, 12 * s + 9)
        out[block, block] = -np.kron(m, m.T)
    return out


def frame_projection(forward: Array) -> Array:
    """(12 S, 12 S): adds to a change of C the rotation that keeps sum(C_s) symmetric, the condition of the frame."""
    sensors = len(forward)
    generators = np.zeros((3, 3, 3))
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        generators[k, i, j], generators[k, j, i] = -1.0, 1.0
    total = forward.sum(axis=0)

    def skew(a: Array) -> Array:
        return np.array([a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1]])

    response = np.column_stack([skew(total @ g) for g in generators])
    read = np.zeros((3, 12 * sensors))
    move = np.zeros((12 * sensors, 3))
    for s in range(sensors):
        for i in range(3):
            for j in range(3):
                unit = np.zeros((3, 3))
                unit[i, j] = 1.0
                read[:, 12 * s + 3 * i + j] = skew(unit)
        for k in range(3):
            move[12 * s : 12 * s + 9, k] = (forward[s] @ generators[k]).ravel()
    out: Array = np.eye(12 * sensors) - move @ np.linalg.solve(response, read)
    return out
