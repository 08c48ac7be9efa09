"""Quaternions (scalar last, platform to world) and elementary rotations.

Products are written out term by term: the result for one sample must not depend on how many samples are
computed at once, which a matrix product of a numerical library does not promise.
"""

from __future__ import annotations

import numpy as np

from magtensor.simulate.spec import Array


def multiply(p: Array, q: Array) -> Array:
    """Hamilton product p q of quaternions (..., 4): first q, then p, as rotations."""
    px, py, pz, pw = (p[..., i] for i in range(4))
    qx, qy, qz, qw = (q[..., i] for i in range(4))
    return np.stack(
        [
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
            pw * qw - px * qx - py * qy - pz * qz,
        ],
        axis=-1,
    )


def conjugate(q: Array) -> Array:
    """The inverse rotation of unit quaternions (..., 4)."""
    return q * np.array([-1.0, -1.0, -1.0, 1.0])


def normalised(q: Array) -> Array:
    norm = np.sqrt(q[..., 0] ** 2 + q[..., 1] ** 2 + q[..., 2] ** 2 + q[..., 3] ** 2)
    out: Array = q / norm[..., None]
    return out


def exponential(vector: Array) -> Array:
    """Quaternion (..., 4) of the rotation vector (..., 3) rad."""
    angle = np.sqrt(vector[..., 0] ** 2 + vector[..., 1] ** 2 + vector[..., 2] ** 2)
    half_sinc = 0.5 * np.sinc(angle / (2 * np.pi))
    return np.concatenate([vector * half_sinc[..., None], np.cos(angle / 2)[..., None]], axis=-1)


def logarithm(q: Array) -> Array:
    """Rotation vector (..., 3) rad, of length at most pi, of unit quaternions (..., 4)."""
    q = np.where(q[..., 3:] < 0, -q, q)
    sine = np.sqrt(q[..., 0] ** 2 + q[..., 1] ** 2 + q[..., 2] ** 2)
    angle = 2 * np.arctan2(sine, q[..., 3])
    factor = np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 2.0)
    out: Array = q[..., :3] * factor[..., None]
    return out


def cumulative(q: Array) -> Array:
    """Running products q0, q0 q1, q0 q1 q2, ... of (n, 4), in about 2 sqrt(n) vectorised steps."""
    n = len(q)
    length = max(1, int(np.sqrt(n)))
    blocks = -(-n // length)
    padded = np.zeros((blocks * length, 4))
    padded[:, 3] = 1.0
    padded[:n] = q
    out = padded.reshape(blocks, length, 4)
    for i in range(1, length):
        out[:, i] = normalised(multiply(out[:, i - 1], out[:, i]))
    carry = np.array([0.0, 0.0, 0.0, 1.0])
    for block in range(blocks):
        out[block] = multiply(carry[None, :], out[block])
        carry = normalised(out[block, -1])
    return normalised(out.reshape(-1, 4)[:n])


def matrices(q: Array) -> Array:
    """Rotation matrices (..., 3, 3), platform to world, of unit quaternions (..., 4)."""
    x, y, z, w = (q[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def transform(matrix: Array, vector: Array) -> Array:
    """matrix (..., 3, 3) times vector (..., 3), broadcast."""
    out: Array = (
        matrix[..., :, 0] * vector[..., None, 0]
        + matrix[..., :, 1] * vector[..., None, 1]
        + matrix[..., :, 2] * vector[..., None, 2]
    )
    return out


def transform_back(matrix: Array, vector: Array) -> Array:
    """Transposed matrix (..., 3, 3) times vector (..., 3), broadcast: world to platform."""
    return transform(np.swapaxes(matrix, -1, -2), vector)


def congruence_back(matrix: Array, tensor: Array) -> Array:
    """R^T G R for matrices (..., 3, 3): a tensor given in the world seen from the platform."""
    half = np.stack([transform_back(matrix, tensor[..., :, j]) for j in range(3)], axis=-1)
    return np.stack([transform_back(matrix, half[..., i, :]) for i in range(3)], axis=-2)


def quaternions(matrix: Array) -> Array:
    """Unit quaternions (..., 4) of rotation matrices (..., 3, 3); of q and -q the one with w >= 0."""
    m = matrix
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    # Four times each squared component; the largest one is divided by, so that nothing small is.
    squares = np.stack([1 + 2 * m[..., i, i] - trace for i in range(3)] + [1 + trace], axis=-1)
    largest = np.argmax(squares, axis=-1)
    products = np.empty((*m.shape[:-2], 4, 4))
    for i in range(4):
        products[..., i, i] = squares[..., i]
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        products[..., i, j] = products[..., j, i] = m[..., j, i] + m[..., i, j]
        products[..., k, 3] = products[..., 3, k] = m[..., j, i] - m[..., i, j]
    q = normalised(np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :])
    out: Array = np.where(q[..., 3:] < 0, -q, q)
    return out


def passive(axis: str, angle: Array | float) -> Array:
    """Matrix (..., 3, 3) that gives a vector's components after its frame turned by angle (rad) about an axis.

    These are the elementary matrices of Chi 2017 eq. 4 and Li 2018 eq. 5.
    """
    c, s = np.cos(angle), np.sin(angle)
    out = np.zeros((*np.shape(angle), 3, 3))
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    out[..., i, i] = 1.0
    out[..., j, j] = out[..., k, k] = c
    out[..., j, k] = s
    out[..., k, j] = -s
    return out


def uniform_attitudes(rng: np.random.Generator, count: int) -> Array:
    """Quaternions (count, 4), uniform over all attitudes."""
    return normalised(rng.standard_normal((count, 4)))
