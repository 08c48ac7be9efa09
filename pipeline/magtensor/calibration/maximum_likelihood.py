"""The ellipsoid by maximum likelihood: unbiased where the attitudes cover little.

A sample y = B b + c + noise (unit variance on every coordinate) with |b| = F known has the least squared distance
(|U (y - c)| - F)^2 / (u' U U' u + s_F^2) to the surface, to first order in noise over F; u is the direction of the
field, U = B^-1, s_F the noise of the reference. That distance, with its denominator differentiated too, is
minimised. Leaving the denominator out of the derivative, or out altogether, shrinks U to shrink the noise: the
attenuation of METHODS A4.7.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.errors import NotEnoughData

from .factors import upper
from .quadric import ellipsoid_restricted, fit_ellipsoid
from .types import Array

START_SAMPLES = 20_000  # the algebraic fit is only where the iteration begins
_CHUNK = 65536
_UPPER = np.array([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)])


@dataclass(frozen=True)
class ScalarFit:
    """b = matrix @ (y - offset), the matrix upper triangular.

    Attributes:
        matrix: (3, 3) nT per unit of y; offset: (3,) in units of y.
        chi2: mean square of the whitened residual per degree of freedom.
    """

    matrix: Array
    offset: Array
    chi2: float


def whitened_residual(
    matrix: Array, offset: Array, y: Array, total_field: Array, reference_noise: float
) -> tuple[Array, Array]:
    """The residual (N,) and its derivative (N, 9): six elements of the upper triangle row by row, three offsets."""
    shifted = y - offset
    b = shifted @ matrix.T
    length = np.linalg.norm(b, axis=1)
    u = b / length[:, None]
    g = u @ matrix  # d|b|/dy
    spread = np.sqrt(np.einsum("ni,ni->n", g, g) + reference_noise**2)
    r = (length - total_field) / spread
    d_length = np.empty((len(y), 9))
    d_length[:, :6] = u[:, _UPPER[:, 0]] * shifted[:, _UPPER[:, 1]]
    d_length[:, 6:] = -g
    # d(spread^2)/2 = g . dg with dg = du @ U + u @ dU and du = (db - u (u . db)) / |b|
    back = g @ matrix.T
    turned = (back - u * np.einsum("ni,ni->n", u, back)[:, None]) / length[:, None]
    d_spread2 = np.empty((len(y), 9))
    d_spread2[:, :6] = (
        turned[:, _UPPER[:, 0]] * shifted[:, _UPPER[:, 1]] + u[:, _UPPER[:, 0]] * g[:, _UPPER[:, 1]]
    )
    d_spread2[:, 6:] = -turned @ matrix
    jacobian = d_length / spread[:, None] - (r / spread**2)[:, None] * d_spread2
    return r, jacobian


def fit_scalar(y: Array, total_field: Array, reference_noise: float = 0.0, most_iterations: int = 50) -> ScalarFit:
    """Fit matrix and offset by maximum likelihood, started from the algebraic ellipsoid.

    Parameters
    ----------
    y: (N, 3), noise of unit variance on every coordinate.
    total_field: (N,) nT.
    reference_noise: nT, of the total field.

    Raises
    ------
    NotEnoughData: the algebraic fit is no ellipsoid, the normal equations are singular, or it does not converge.
    """
    thin = slice(None, None, max(1, len(y) // START_SAMPLES))
    found = fit_ellipsoid(y[thin], total_field[thin], ellipsoid_restricted)
    p = np.concatenate([upper(found.shape)[_UPPER[:, 0], _UPPER[:, 1]], found.offset])
    cost = _cost(p, y, total_field, reference_noise)
    damping = 0.0
    for _ in range(most_iterations):
        normal, gradient = _normal(p, y, total_field, reference_noise)
        scale = np.sqrt(np.diag(normal))
        if not (np.isfinite(scale).all() and (scale > 0).all()):
            raise NotEnoughData("the scalar fit has a parameter that no sample depends on")
        scaled = normal / np.outer(scale, scale)
        while True:
            step = -np.linalg.solve(scaled + damping * np.eye(9), gradient / scale) / scale
            trial = _cost(p + step, y, total_field, reference_noise)
            if np.isfinite(trial) and trial <= cost * (1 + 1e-12):
                break
            damping = max(10 * damping, 1e-6)
            if damping > 1e6:
                raise NotEnoughData(
                    "the scalar fit does not converge", hint="look for disturbed samples, or add attitudes"
                )
        expected = -float(gradient @ step)  # twice the decrease of the quadratic model
        p, cost, damping = p + step, trial, damping / 10 if damping > 1e-9 else 0.0
        if expected < 1e-8:  # the step moves the parameters by less than 1e-4 of their standard deviations
            break
    else:
        raise NotEnoughData("the scalar fit does not converge", hint="look for disturbed samples, or add attitudes")
    matrix = np.zeros((3, 3))
    matrix[_UPPER[:, 0], _UPPER[:, 1]] = p[:6]
    return ScalarFit(matrix, p[6:], cost / max(len(y) - 9, 1))


def _unpack(p: Array) -> tuple[Array, Array]:
    matrix = np.zeros((3, 3))
    matrix[_UPPER[:, 0], _UPPER[:, 1]] = p[:6]
    return matrix, p[6:]


def _cost(p: Array, y: Array, total_field: Array, reference_noise: float) -> float:
    matrix, offset = _unpack(p)
    total = 0.0
    for start in range(0, len(y), _CHUNK):
        part = slice(start, start + _CHUNK)
        b = (y[part] - offset) @ matrix.T
        length = np.linalg.norm(b, axis=1)
        g = (b / length[:, None]) @ matrix
        variance = np.einsum("ni,ni->n", g, g) + reference_noise**2
        total += float(np.sum((length - total_field[part]) ** 2 / variance))
    return total


def _normal(p: Array, y: Array, total_field: Array, reference_noise: float) -> tuple[Array, Array]:
    matrix, offset = _unpack(p)
    normal, gradient = np.zeros((9, 9)), np.zeros(9)
    for start in range(0, len(y), _CHUNK):
        part = slice(start, start + _CHUNK)
        r, jacobian = whitened_residual(matrix, offset, y[part], total_field[part], reference_noise)
        normal += jacobian.T @ jacobian
        gradient += jacobian.T @ r
    return normal, gradient
