"""Tests whose noise is what estimates scatter by when each block of a survey is left out in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.evidence.estimate import Own, directions, identifiable, own_information, symmetric_eigen
from magtensor.loop.evidence.grams import Grams, normal

LEAST_LEFT = 1e-3  # of the information in a direction, without any one block
SINGULAR = 1e-8  # of the largest eigenvalue
MANY = 2  # times the coefficients tested: with so many others one inverse of all serves all tests


@dataclass(frozen=True)
class Jackknife:
    """Blocks, each of which is left out in turn.

    Attributes:
        beside: of coefficients that are free beside those tested, what `_Others` knows; one sensor after the other is
            tested beside the same.
    """

    blocks: Grams
    beside: dict[tuple[int, ...], tuple[_Others, _Others]] = field(default_factory=dict)

    @cached_property
    def every(self) -> tuple[Array, Array]:
        """(1, P, P), (1, P) normal equations of all blocks."""
        return normal(self.blocks.total())

    @cached_property
    def without_each(self) -> tuple[Array, Array]:
        """(B, P, P), (B, P) those without each block."""
        return normal(self.blocks.without_each())

    @cached_property
    def own(self) -> Own:
        return own_information(self.blocks)

    def p_value(
        self,
        chosen: Sequence[int],
        alone: Sequence[int] = (),
        most: int | None = None,
        within: Array | None = None,
    ) -> float:
        """As `statistics.wald_p`.

        Parameters
        ----------
        within: (p, q) directions of the chosen coefficients, no others are; all where not given.
        """
        from scipy.special import fdtrc

        count, terms = len(self.blocks.zz), self.blocks.count
        subset = np.asarray(chosen, dtype=int)
        (full_n, full_y), (n, y) = self._equations(subset, np.setdiff1d(np.arange(terms), [*chosen, *alone]))
        own = self.own.of(subset)
        if within is not None:
            (full_n, full_y), (n, y) = ((within.T @ m @ within, v @ within) for m, v in ((full_n, full_y), (n, y)))
            own = own.along(within)
        basis, values = directions(full_n[0], own)
        basis = basis[:, np.argsort(values)[::-1][:most]]
        p = basis.shape[1]
        if p == 0 or p >= count:
            return 1.0
        try:
            root = np.linalg.cholesky(basis.T @ full_n[0] @ basis)
        except np.linalg.LinAlgError:
            return 1.0  # beside the others these tell nothing but rounding: the field never moved
        basis = _confirmed(basis @ np.linalg.inv(root).T, n)
        p = basis.shape[1]
        if p == 0:
            return 1.0  # single blocks hold nearly all there is to know: nothing can confirm it
        theta = np.linalg.solve(basis.T @ full_n[0] @ basis, basis.T @ full_y[0])
        small, right = basis.T @ n @ basis, y @ basis
        spread = np.linalg.solve(small, right[:, :, None])[:, :, 0] - theta
        covariance = (count - 1) / count * spread.T @ spread
        try:
            t2 = float(theta @ np.linalg.solve(covariance, theta))
        except np.linalg.LinAlgError:
            return 1.0
        return float(fdtrc(p, count - p, max((count - p) / (p * (count - 1)) * t2, 0.0)))

    def _equations(
        self, chosen: NDArray[np.int_], free: NDArray[np.int_]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Normal equations (1, p, p), (1, p) of the chosen coefficients, some others free, and (B, p, p), (B, p)
        without each block."""
        if len(free) > MANY * len(chosen) and len(free) + len(chosen) == self.blocks.count:
            found = self._beside_all_others(chosen)
            if found is not None:
                return found
        together, apart = self._others(tuple(free.tolist()))
        return together.projected_off(*self.every, chosen), apart.projected_off(*self.without_each, chosen)

    def _others(self, free: tuple[int, ...]) -> tuple[_Others, _Others]:
        """Of all blocks together, and without each."""
        if free not in self.beside:
            which = np.array(free, dtype=int)
            basis = np.zeros((self.blocks.count, 0))
            if free:  # in the directions that the data show
                seen = identifiable(self.every[0][0][np.ix_(which, which)], self.own.of(which))
                basis = np.zeros((self.blocks.count, seen.shape[1]))
                basis[which] = seen
            self.beside[free] = _Others.of(*self.every, basis), _Others.of(*self.without_each, basis)
        return self.beside[free]

    @cached_property
    def _inverses(self) -> tuple[Array, Array] | None:
        """(1, P, P), (B, P, P) of all coefficients' information, of all blocks together and without each; None where
        some direction is not seen."""
        if identifiable(self.every[0][0], self.own).shape[1] < self.blocks.count:
            return None
        root = self.own.root
        scaled = [n / np.outer(root, root) for n in (self.every[0], self.without_each[0])]
        try:
            found = [np.linalg.inv(n).astype(float, copy=False) for n in scaled]
        except np.linalg.LinAlgError:
            return None
        if any(_singular(n, inverse).any() for n, inverse in zip(scaled, found, strict=True)):
            return None
        return found[0] / np.outer(root, root), found[1] / np.outer(root, root)

    def _beside_all_others(self, chosen: NDArray[np.int_]) -> tuple[tuple[Array, Array], tuple[Array, Array]] | None:
        """Normal equations of some coefficients, all others free, of all blocks together and without each, by one
        inverse for whichever are chosen; None where some direction is not seen."""
        if self._inverses is None:
            return None
        out = []
        for inverse, (_, y) in zip(self._inverses, (self.every, self.without_each), strict=True):
            n = np.linalg.inv(inverse[:, chosen[:, None], chosen]).astype(float, copy=False)
            theta = (inverse[:, chosen] @ y[:, :, None])[:, :, 0]
            out.append((n, (n @ theta[:, :, None])[:, :, 0]))
        return out[0], out[1]


@dataclass(frozen=True)
class _Others:
    """Directions that are free beside what is tested, in a batch of normal equations.

    Attributes:
        basis: (P, q).
        inverse: (B, q, q) of their information.
        theta: (B, q) what they are without what is tested.
    """

    basis: Array
    inverse: Array
    theta: Array

    @classmethod
    def of(cls, n: Array, y: Array, basis: Array) -> _Others:
        """In normal equations (B, P, P), (B, P)."""
        inverse = _inverse_of_each(basis.T @ n @ basis)
        return cls(basis, inverse, (inverse @ (y @ basis)[:, :, None])[:, :, 0])

    def projected_off(self, n: Array, y: Array, chosen: NDArray[np.int_]) -> tuple[Array, Array]:
        """The part of the chosen coefficients in the normal equations."""
        mixed = n[:, chosen] @ self.basis
        n2 = n[:, chosen[:, None], chosen] - mixed @ self.inverse @ np.swapaxes(mixed, 1, 2)
        y2 = y[:, chosen] - (mixed @ self.theta[:, :, None])[:, :, 0]
        return n2, y2


def _inverse_of_each(m: Array) -> Array:
    """(B, q, q) of symmetric matrices, directions with next to nothing left out."""
    try:
        out = np.linalg.inv(m).astype(float, copy=False)
        singular = _singular(m, out)
    except np.linalg.LinAlgError:
        out, singular = np.empty_like(m), np.ones(len(m), dtype=bool)
    if singular.any():
        out[singular] = np.linalg.pinv(m[singular], rcond=SINGULAR, hermitian=True)
    return out


def _singular(m: Array, inverse: Array) -> NDArray[np.bool_]:
    """(B,) whether symmetric matrices (B, q, q) may have an eigenvalue that is next to nothing beside the largest."""
    norm = np.abs(m).sum(axis=1).max(axis=1, initial=0.0)
    condition = norm * np.abs(inverse).sum(axis=1).max(axis=1, initial=0.0)  # no less than the ratio of the two
    return ~(condition * SINGULAR < 1.0)


def _confirmed(basis: Array, n: Array) -> Array:
    """The directions of a basis (with unit information in all blocks together) that no single block is needed for.

    Parameters
    ----------
    basis: (P, p).
    n: (B, P, P), the information without each block.
    """
    values, vectors = symmetric_eigen(basis.T @ n @ basis)
    lost = vectors.transpose(0, 2, 1)[values < LEAST_LEFT]
    if not len(lost):
        return basis
    _, s, vt = np.linalg.svd(lost, full_matrices=True)
    rank = int(np.sum(s > 0.1 * s[0]))
    return basis @ vt[rank:].T
