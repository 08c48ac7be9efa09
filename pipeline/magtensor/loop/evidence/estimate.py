"""Coefficients from normal equations: their values, their covariance, and the directions in which they are seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.evidence.grams import Grams, normal

IDENTIFIABLE = 1e-6  # of a regressor's own information: a direction with less left is not estimated
MOSTLY_NOISE = 2.0  # times the noise in regressors: less is left in a direction of which they show noise above all


@dataclass(frozen=True)
class Estimate:
    """Coefficients and what is known of them.

    Attributes:
        theta: (P,) in the units of the terms; minimum norm where directions are not identifiable.
        covariance: (P, P).
        normal: (P, P), the information, the fit's own freedom projected off.
        rank: identifiable directions.
    """

    theta: Array
    covariance: Array
    normal: Array
    rank: int

    def seen(self, theta: Array) -> Array:
        """Coefficients (P,) without their part in directions that are not identifiable."""
        out: Array = self.covariance @ (self.normal @ theta)
        return out

    def beside(self, first: int) -> Array:
        """The information on the coefficients from a number on, those before it free."""
        n, mixed = self.normal, self.normal[first:, :first]
        return np.asarray(n[first:, first:] - mixed @ np.linalg.pinv(n[:first, :first], hermitian=True) @ mixed.T)

    def explained_beside(self, first: int) -> float:
        """Sum of squares that these explain beside those before, on all blocks."""
        own = self.theta[first:]
        return float(own @ self.beside(first) @ own)


def symmetric_eigen(m: Array) -> tuple[Array, Array]:
    """Eigenvalues and vectors of symmetric matrices (..., P, P).

    LAPACK may give up on a matrix that lacks nothing; it does not when it reads the other triangle.
    """
    try:
        values, vectors = np.linalg.eigh(m)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(m, UPLO="U")
    return values, vectors


@dataclass(frozen=True)
class Own:
    """What regressors tell by themselves.

    Attributes:
        information: (P,) of each before the fit's own freedom was projected off.
        noise: (P,) part of it that says nothing: what noise of the outputs makes of a rate of change, above all, and
            what the law of a turn leaves open.
    """

    information: Array
    noise: Array

    def of(self, which: NDArray[np.int_] | slice) -> Own:
        """Those of some regressors."""
        return Own(self.information[which], self.noise[which])

    def along(self, directions: Array) -> Own:
        """Those of sums of regressors, whose coefficients have these directions (P, q), at most."""
        each = self.information[:, None] * directions**2
        whole = np.maximum(each.sum(axis=0), 1e-300)
        return Own(np.count_nonzero(directions, axis=0) * whole, self.noise @ each / whole)

    @property
    def root(self) -> Array:
        """(P,) a unit of which each is measured in."""
        out: Array = np.sqrt(np.maximum(self.information, 1e-300))
        return out

    def shown(self, values: Array, vectors: Array) -> NDArray[np.bool_]:
        """(..., P) whether regressors, in their units, show a direction, of which information (..., P) is left: more
        than rounding, and than the noise in them."""
        noise = MOSTLY_NOISE * (self.noise @ vectors**2) if self.noise.any() else 0.0
        return values > np.maximum(IDENTIFIABLE, noise)


def solve(n: Array, y: Array, own: Own) -> Estimate:
    """Least squares in the identifiable directions of one normal matrix.

    Parameters
    ----------
    n: (P, P), y: (P,).
    own: of each regressor.
    """
    basis, values = directions(n, own)
    inverse = basis / values @ basis.T
    return Estimate(inverse @ y, inverse, n, basis.shape[1])


def theta_of_each(n: Array, y: Array, own: Own) -> Array:
    """(B, P) the coefficients that `solve` gives for each of the normal matrices (B, P, P) and right sides (B, P)."""
    values, vectors, shown = _directions_of_each(n, y, own, np.broadcast_to(own.root, y.shape))
    out: Array = (vectors @ (shown / values)[:, :, None])[:, :, 0] / own.root
    return out


def _directions_of_each(n: Array, y: Array, own: Own, root: Array) -> tuple[Array, Array, Array]:
    """Of each set the information (B, P) in its directions, these (B, P, P) and what the data say along them (B, P), in
    coefficients times root (B, P); directions that are not identifiable have infinite information and say nothing."""
    values, vectors = symmetric_eigen(n / (root[:, :, None] * root[:, None, :]))
    seen = own.shown(values, vectors)
    shown = (vectors.swapaxes(1, 2) @ (y / root)[:, :, None])[:, :, 0]
    return np.where(seen, values, np.inf), vectors, np.where(seen, shown, 0.0)


def identifiable(n: Array, own: Own) -> Array:
    """(P, p) the directions that an information matrix (P, P) tells from nothing, `own` as in `solve`."""
    return directions(n, own)[0]


def directions(n: Array, own: Own) -> tuple[Array, Array]:
    """Identifiable directions (P, p) and their information (p,), in scaled coordinates undone again."""
    root = own.root
    values, vectors = symmetric_eigen(n / np.outer(root, root))
    seen = own.shown(values, vectors)
    return vectors[:, seen] / root[:, None], values[seen]


def own_information(g: Grams) -> Own:
    """What each regressor would tell if the fit had no freedom of its own, constants left out."""
    return Own(own_information_of_each(g.total())[0], g.pieces.noise)


def own_information_of_each(g: Grams) -> Array:
    """(B, P) the same of each block or set."""
    out = np.zeros((len(g.zz), g.count))
    pieces = g.pieces
    if len(pieces.term) and g.zz.any():
        varying = g.zd[:, 3:] / np.sqrt(np.maximum(np.diagonal(g.zz, axis1=1, axis2=2)[:, 3:], 1e-300))[:, :, None]

        def of_pairs(i: NDArray[np.int_], j: NDArray[np.int_]) -> Array:
            a, b = pieces.series[i], pieces.series[j]
            found: Array = g.dd[:, a, b] - np.sum(varying[:, :, a] * varying[:, :, b], axis=1)
            return found

        every = np.arange(len(pieces.term))
        size = of_pairs(every, every)
        alone = np.maximum(size, 1e-12 * g.dd[:, pieces.series, pieces.series]) * pieces.alone
        np.add.at(out.T, pieces.term, alone.T)
        # what moves all sensors alike is in the plane that they share, whatever each output shows alone
        together = np.zeros_like(out)
        np.add.at(together.T, pieces.term, (size * np.diagonal(pieces.shown)).T)
        i, j = pieces.pairs
        if len(i):
            np.add.at(together.T, pieces.term[i], (of_pairs(i, j) * pieces.shown[i, j]).T)
        out = np.maximum(together, IDENTIFIABLE * out)
    if g.aa.any():
        out += np.diagonal(g.aa, axis1=1, axis2=2)[:, g.own :]
    return out


def explained_beside_each(g: Grams, known: Estimate | None) -> tuple[Array, NDArray[np.int_]]:
    """(B,) reduction of the sum of squares by the terms of each block or set beside those that come first and are the
    same in all, in noise of unit variance, and (B,) how many directions are identifiable beside them.

    Parameters
    ----------
    known: the coefficients of those that come first, estimated without the others; None where there are none.
    """
    first = 0 if known is None else len(known.theta)
    n, y = normal(g, first)
    if known is not None:
        mixed = n[:, :first].swapaxes(1, 2)
        y = y - mixed @ known.theta
        n = n[:, first:] - mixed @ known.covariance @ n[:, :first]
    root = np.sqrt(np.maximum(own_information_of_each(g)[:, first:], 1e-300))
    values, _, shown = _directions_of_each(n, y, Own(root[0] ** 2, g.pieces.noise[first:]), root)
    return np.sum(shown**2 / values, axis=1), np.isfinite(values).sum(axis=1)
