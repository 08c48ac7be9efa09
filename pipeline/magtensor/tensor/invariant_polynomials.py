"""The invariants as polynomials of measured components: monomials, and coefficients as functions of H.

With g = H t the invariants I1 = -1/2 g' METRIC g and I2 = det G are a quadratic and a cubic form of the offset-free
measurement t (Sui 2017 eqs. 15-19). Their 15 and 35 coefficients y and z depend on H alone.
"""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from magtensor.tensor.elements import METRIC, NINE_OF_FIVE

Array = NDArray[np.float64]

PAIRS = np.array(list(combinations_with_replacement(range(5), 2)))
TRIPLES = np.array(list(combinations_with_replacement(range(5), 3)))


def _trilinear_determinant() -> Array:
    """D (5, 5, 5), symmetric, with det(full(g)) = D_abc g_a g_b g_c."""
    epsilon = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        epsilon[i, j, k], epsilon[i, k, j] = 1.0, -1.0
    e = NINE_OF_FIVE.reshape(3, 3, 5)
    out: Array = np.einsum("ijk,lmn,ila,jmb,knc->abc", epsilon, epsilon, e, e, e, optimize=True) / 6
    return out


DETERMINANT = _trilinear_determinant()

_PAIR_COUNT = np.where(PAIRS[:, 0] == PAIRS[:, 1], 1.0, 2.0)
_TRIPLE_COUNT = np.array([{1: 1.0, 2: 3.0, 3: 6.0}[len(set(t))] for t in TRIPLES.tolist()])


def quadratic_monomials(t: Array) -> Array:
    """(N, 15): t_a t_b, those of different components doubled, so that a symmetric matrix is the coefficients."""
    out: Array = t[:, PAIRS[:, 0]] * t[:, PAIRS[:, 1]] * _PAIR_COUNT
    return out


def cubic_monomials(t: Array) -> Array:
    """(N, 35): t_a t_b t_c."""
    out: Array = t[:, TRIPLES[:, 0]] * t[:, TRIPLES[:, 1]] * t[:, TRIPLES[:, 2]]
    return out


def symmetric_matrix(coefficients: Array) -> Array:
    """(5, 5) of the 15 coefficients of `quadratic_monomials`."""
    out = np.zeros((5, 5))
    out[PAIRS[:, 0], PAIRS[:, 1]] = out[PAIRS[:, 1], PAIRS[:, 0]] = coefficients
    return out


def quadratic_derivatives(t: Array) -> Array:
    """(N, 15, 5): the derivatives of `quadratic_monomials` by t."""
    out = np.zeros((len(t), len(PAIRS), 5))
    for column, (pair, count) in enumerate(zip(PAIRS, _PAIR_COUNT, strict=True)):
        out[:, column, pair[0]] += count * t[:, pair[1]]
        out[:, column, pair[1]] += count * t[:, pair[0]]
    return out


def cubic_derivatives(t: Array) -> Array:
    """(N, 35, 5): the derivatives of `cubic_monomials` by t."""
    out = np.zeros((len(t), len(TRIPLES), 5))
    for column, triple in enumerate(TRIPLES):
        for k in range(3):
            i, j = np.delete(triple, k)
            out[:, column, triple[k]] += t[:, i] * t[:, j]
    return out


def i1_coefficients(h: Array) -> tuple[Array, Array]:
    """The 15 coefficients y of I1 and their derivative (15, 25) by H, row by row.

    The correct form of Sui's eq. 17 under its own order of the components is
    ``y1 = -(h11^2 + h11 h41 + h41^2 + h21^2 + h31^2 + h51^2)``.
    """
    mh = METRIC @ h
    y = -0.5 * h.T @ mh
    i, j = PAIRS.T
    slope = np.zeros((len(PAIRS), 5, 5))
    row = np.arange(len(PAIRS))
    slope[row, :, i] -= 0.5 * mh[:, j].T
    slope[row, :, j] -= 0.5 * mh[:, i].T
    return y[i, j], slope.reshape(-1, 25)


def i2_coefficients(h: Array) -> tuple[Array, Array]:
    """The 35 coefficients z of I2 (Sui 2017 eqs. 18, 19) and their derivative (35, 25) by H, row by row."""
    partial = np.einsum("abc,bj,ck->ajk", DETERMINANT, h, h, optimize=True)
    z = np.einsum("ai,ajk->ijk", h, partial)
    i, j, k = TRIPLES.T
    slope = np.zeros((len(TRIPLES), 5, 5))
    row = np.arange(len(TRIPLES))
    for one, two, three in ((i, j, k), (j, i, k), (k, i, j)):
        slope[row, :, one] += (_TRIPLE_COUNT * partial[:, two, three]).T
    return _TRIPLE_COUNT * z[i, j, k], slope.reshape(-1, 25)
