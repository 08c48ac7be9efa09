"""Quantities of the gradient tensor that do not depend on the array's orientation, and their uncertainty.

All take symmetric traceless tensors (N, 3, 3) in nT/m; where a sample is not finite the result is NaN. The
standard deviations are first order in the uncertainty of the five components (delta method).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError
from magtensor.tensor.elements import METRIC, NINE_OF_FIVE, five

Array = NDArray[np.float64]

_CHUNK = 65536  # samples whose eigenvectors and gradients are held at a time


class Invariants(NamedTuple):
    """Rotation invariants, (N,) each.

    Attributes:
        i1: -1/2 sum G_ij^2, (nT/m)^2. Sui 2017 eq. 10. For a traceless tensor it equals the sum of the
            principal minors, Pedersen and Rasmussen's I1.
        i2: det G, (nT/m)^3. Sui 2017 eq. 11, Pedersen and Rasmussen's I2.
        magnitude: C_T = sqrt(sum G_ij^2), nT/m.
        source_strength: normalised source strength sqrt(-l2^2 - l1 l3) of the eigenvalues l1 >= l2 >= l3,
            nT/m (Clark 2012, Beiki et al. 2012). Of a dipole m at distance r it is 3 (mu0 / 4 pi) m / r^4 in
            every direction.
    """

    i1: Array
    i2: Array
    magnitude: Array
    source_strength: Array


def invariants(tensor: Array) -> Invariants:
    """The invariants of (N, 3, 3) nT/m."""
    g, finite = _checked(tensor)
    squares = np.where(finite, np.einsum("nij,nij->n", g, g), np.nan)
    i1 = -squares / 2
    determinant = np.einsum("ni,ni->n", g[:, 0], np.cross(g[:, 1], g[:, 2]))
    middle = np.linalg.eigvalsh(g)[:, 1]
    strength = np.sqrt(np.maximum(-i1 - 2 * middle**2, 0))
    return Invariants(i1, np.where(finite, determinant, np.nan), np.sqrt(squares), strength)


def invariants_std(tensor: Array, covariance: Array) -> Invariants:
    """Standard deviations of the invariants, (N,) each in the units of the invariants.

    Where two eigenvalues coincide to within the noise the normalised source strength has no derivative; what
    is given there is its mean-square slope over all orientations of the coinciding pair, which by Poincare's
    inequality is never less than the scatter of Gaussian noise, and at most 1.53 times it. At a vanishing
    tensor, where C_T has a kink too, it is the root mean square of C_T, an upper bound.

    Parameters
    ----------
    tensor : (N, 3, 3) nT/m.
    covariance : (5, 5) or (N, 5, 5) in (nT/m)^2 of xx, xy, xz, yy, yz.

    Raises
    ------
    DataError : a covariance of another shape.
    """
    g, finite = _checked(tensor)
    c = np.asarray(covariance, dtype=float)
    if c.shape not in ((5, 5), (len(g), 5, 5)):
        raise DataError(
            f"the covariance of the components has shape {c.shape}",
            where="covariance",
            hint=f"(5, 5) or ({len(g)}, 5, 5) is right for {len(g)} tensors",
        )
    parts = [slice(start, start + _CHUNK) for start in range(0, len(g), _CHUNK)] or [slice(0)]
    pieces = [_std(g[part], c if c.ndim == 2 else c[part]) for part in parts]
    whole = (np.concatenate(columns) for columns in zip(*pieces, strict=True))
    return Invariants(*(np.where(finite, column, np.nan) for column in whole))


def _checked(tensor: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The tensors, zero where they are not finite (LAPACK refuses NaN), and where they are finite."""
    g = np.asarray(tensor, dtype=float)
    if g.ndim != 3 or g.shape[1:] != (3, 3):
        raise DataError(f"the tensor has shape {g.shape}", where="tensor", hint="(time, 3, 3) is right")
    finite = np.isfinite(g).all(axis=(1, 2))
    return np.where(finite[:, None, None], g, 0.0), finite


def _std(g: Array, covariance: Array) -> Invariants:
    covariance = np.broadcast_to(covariance, (len(g), 5, 5))
    slope1 = -five(g) @ METRIC
    cofactors = _cofactors(g).reshape(-1, 9) @ NINE_OF_FIVE
    size = np.sqrt(np.einsum("nij,nij->n", g, g))
    zero = size == 0
    kink = np.sqrt(np.einsum("nab,ab->n", covariance, METRIC))  # root mean square of C_T at G = 0
    std1 = np.sqrt(_square(slope1, covariance))
    magnitude = np.where(zero, kink, std1 / np.where(zero, 1, size))
    strength = np.sqrt(_strength_variance(g, covariance))
    # of a given C_T the source strength is at most C_T / sqrt 2 (middle eigenvalue zero)
    strength = np.where(zero, kink / np.sqrt(2), strength)
    return Invariants(std1, np.sqrt(_square(cofactors, covariance)), magnitude, strength)


def _cofactors(g: Array) -> Array:
    """d det / d G_ij, all nine taken as independent."""
    rows = [np.cross(g[:, (i + 1) % 3], g[:, (i + 2) % 3]) for i in range(3)]
    return np.stack(rows, axis=1)


def _strength_variance(g: Array, covariance: Array) -> Array:
    """Variance (N,) of the normalised source strength; zeros where the tensor vanishes.

    mu^2 = -I1 - 2 l2^2. The middle eigenvalue moves by v2' dG v2 while it stands alone. Near one of its
    neighbours (half gap D) it is m -+ sqrt((D + u)^2 + w^2), with u and w the half difference and the
    off-diagonal element of dG in the pair's plane: its slope is that of m -+ (u cos a + w sin a). Alone
    a = 0; in a coinciding pair the mean over a does not depend on which of its eigenvectors came out.
    """
    values, vectors = np.linalg.eigh(g)
    pair = np.where(values[:, 1] > 0, 2, 0)  # the nearer neighbour: the three add up to zero
    n = np.arange(len(g))
    sign = np.where(pair == 2, 1.0, -1.0)  # of (partner - middle)
    v, p = vectors[:, :, 1], vectors[n, :, pair]
    half_gap = np.abs(values[n, pair] - values[:, 1]) / 2
    own = np.einsum("ni,nj->nij", v, v).reshape(-1, 9) @ NINE_OF_FIVE
    partner = np.einsum("ni,nj->nij", p, p).reshape(-1, 9) @ NINE_OF_FIVE
    mean = (own + partner) / 2
    u = sign[:, None] * (partner - own) / 2
    w = np.einsum("ni,nj->nij", v, p).reshape(-1, 9) @ NINE_OF_FIVE
    strength = np.sqrt(np.maximum(np.einsum("nij,nij->n", g, g) / 2 - 2 * values[:, 1] ** 2, 0))
    double = np.where(strength > 0, 2 * strength, 1)[:, None]
    slope_middle = -4 * values[:, 1, None] / double
    rest = five(g) @ METRIC / double + slope_middle * mean
    turn_u = -slope_middle * sign[:, None] * u
    turn_w = -slope_middle * sign[:, None] * w
    alone = _square(rest + turn_u, covariance)
    averaged = _square(rest, covariance) + (_square(turn_u, covariance) + _square(turn_w, covariance)) / 2
    scatter = _square(u, covariance) + _square(w, covariance)
    weight = half_gap**2 / np.where(half_gap**2 + scatter > 0, half_gap**2 + scatter, 1)
    variance: Array = weight * alone + (1 - weight) * averaged
    return variance


def _square(slope: Array, covariance: Array) -> Array:
    out: Array = np.einsum("na,nab,nb->n", slope, covariance, slope)
    return out
