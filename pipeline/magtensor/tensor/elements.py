"""The elements of a gradient tensor: five independent ones, nine in the matrix, and how they turn.

``tensor[i, j] = dB_i/dx_j`` in nT/m. Where current is absent it is symmetric and traceless, so five numbers
say all: xx, xy, xz, yy, yz, in this order everywhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COMPONENTS = ("xx", "xy", "xz", "yy", "yz")
AXES = "xyz"

NINE_OF_FIVE = np.zeros((9, 5))
for _column, _name in enumerate(COMPONENTS):
    _i, _j = AXES.index(_name[0]), AXES.index(_name[1])
    NINE_OF_FIVE[3 * _i + _j, _column] = NINE_OF_FIVE[3 * _j + _i, _column] = 1.0
NINE_OF_FIVE[8, [0, 3]] = -1.0

FIVE_OF_NINE = np.linalg.pinv(NINE_OF_FIVE)
"""(5, 9): the orthogonal projection of any matrix on the symmetric traceless ones."""

METRIC = NINE_OF_FIVE.T @ NINE_OF_FIVE
"""(5, 5): g @ METRIC @ g is the sum of the nine squared elements."""


def full(five_components: Array) -> Array:
    """Five components (..., 5) to the symmetric traceless matrix (..., 3, 3)."""
    g = np.asarray(five_components, dtype=float)
    out: Array = (g @ NINE_OF_FIVE.T).reshape(*g.shape[:-1], 3, 3)
    return out


def five(tensor: Array) -> Array:
    """The five components (..., 5) of (..., 3, 3).

    A matrix that is not symmetric and traceless is projected: the off-diagonal pairs are averaged and a third
    of the trace is taken from each diagonal element.
    """
    t = np.asarray(tensor, dtype=float)
    out: Array = t.reshape(*t.shape[:-2], 9) @ FIVE_OF_NINE.T
    return out


def separate(tensor: Array) -> dict[str, Array]:
    """Every element on its own, ``{"Bxx": (...), "Bxy": dB_x/dy, "Byx": dB_y/dx, ...}``, in nT/m.

    The tables of Chi 2017 and Li 2018 list Bxy and Byx separately, before they are averaged.
    """
    t = np.asarray(tensor, dtype=float)
    return {f"B{a}{b}": t[..., i, j] for i, a in enumerate(AXES) for j, b in enumerate(AXES)}


def closure(tensor: Array) -> dict[str, Array]:
    """What is zero for a true gradient tensor: trace (div B) and asymmetries (curl B), (...) each, nT/m.

    Of a tensor whose elements were measured separately; NaN where a member of a pair was not measured (a
    planar cross measures Bxy - Byx only).
    """
    t = np.asarray(tensor, dtype=float)
    skew = {
        "Bxy - Byx": t[..., 0, 1] - t[..., 1, 0],
        "Bxz - Bzx": t[..., 0, 2] - t[..., 2, 0],
        "Byz - Bzy": t[..., 1, 2] - t[..., 2, 1],
    }
    return {"trace": np.trace(t, axis1=-2, axis2=-1)} | skew


def rotation_of_five(rotation: Array) -> Array:
    """The 5x5 representation S(Q) of a rotation: five(Q G Q') = S(Q) five(G).

    Parameters
    ----------
    rotation : (..., 3, 3) proper rotation matrices.

    Returns
    -------
    (..., 5, 5); orthogonal in the sense S' METRIC S = METRIC.
    """
    q = np.asarray(rotation, dtype=float)
    turned = np.einsum("...ik,...jl->...ijkl", q, q).reshape(*q.shape[:-2], 9, 9)
    out: Array = FIVE_OF_NINE @ turned @ NINE_OF_FIVE
    return out


def _generators() -> Array:
    cross = np.zeros((3, 3, 3))
    for k, (i, j) in enumerate([(1, 2), (2, 0), (0, 1)]):
        cross[k, j, i], cross[k, i, j] = 1.0, -1.0
    identity = np.eye(3)
    nine = np.stack([np.kron(c, identity) + np.kron(identity, c) for c in cross])
    return FIVE_OF_NINE @ nine @ NINE_OF_FIVE


GENERATORS = _generators()
"""(3, 5, 5): dS/d(angle) at the identity for rotations about x, y, z."""
