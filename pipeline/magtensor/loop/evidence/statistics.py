"""Significance that autocorrelation cannot fake: the first gate of METHODS A2 steps 3 to 5."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.evidence.grams import Grams, normal

IDENTIFIABLE = 1e-6  # of a regressor's own information: a direction with less left is not estimated
MOSTLY_NOISE = 2.0  # times the noise in regressors: less is left in a direction of which they show noise above all
BLOCK_COUNTS = (120, 30, 12)  # long blocks protect against correlation longer than a short block
LEAST_BLOCKS = 6
LEAST_LEFT = 1e-3  # of the information in a direction, without any one block
SINGULAR = 1e-8  # of the largest eigenvalue
MANY = 2  # times the coefficients tested: with so many others one inverse of all serves all tests


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
    basis, values = _directions(n, own)
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
    return _directions(n, own)[0]


def _directions(n: Array, own: Own) -> tuple[Array, Array]:
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


def explained_by_each(g: Grams) -> tuple[Array, NDArray[np.int_]]:
    """(B,) reduction of the sum of squares by all terms of each block or set, in noise of unit variance, and (B,) how
    many directions are identifiable."""
    n, y = normal(g)
    root = np.sqrt(np.maximum(own_information_of_each(g), 1e-300))
    values, _, shown = _directions_of_each(n, y, Own(root[0] ** 2, g.pieces.noise), root)
    return np.sum(shown**2 / values, axis=1), np.isfinite(values).sum(axis=1)


def family_p(g: Grams, sensors: Sequence[str], subset: Sequence[int] | None = None) -> float:
    """P value that the subset's coefficients (all if None) are zero, the others being free, as in `Families`.

    Parameters
    ----------
    g: the finest blocks.
    sensors: (P,) whose each term is.
    """
    return Families(g, tuple(sensors)).p_value(range(g.count) if subset is None else subset)


@dataclass(frozen=True)
class Families:
    """Tests of families of coefficients in the same blocks.

    For several block lengths, the largest p taken: a noise correlated for longer than the short blocks does not fool
    the long ones. Where a family has more directions than a third of the blocks, it is tested sensor by sensor and the
    sensors are combined (valid under any dependence). Where no block length serves a family that way, as that of a
    source beside a hundred postures, as many of its best determined directions are tested as a third of the blocks.

    Attributes:
        finest: the finest blocks.
        sensors: (P,) whose each term is.
    """

    finest: Grams
    sensors: tuple[str, ...]

    @cached_property
    def _jackknives(self) -> list[_Jackknife]:
        finest = len(self.finest.zz)
        counts = sorted({min(count, finest) for count in BLOCK_COUNTS}, reverse=True)
        used = [count for count in counts if count >= LEAST_BLOCKS]
        return [_Jackknife(self.finest if count == finest else self.finest.merged(count)) for count in used]

    def p_value(self, subset: Sequence[int]) -> float:
        """That the subset's coefficients are zero, the others being free."""
        chosen = list(subset)
        owners = dict.fromkeys(self.sensors[i] for i in chosen)
        groups = [[i for i in chosen if self.sensors[i] == name] for name in owners]
        found: list[float] = []
        for blocks in self._jackknives:
            count = len(blocks.blocks.zz)
            if 3 * len(chosen) <= count:
                found.append(blocks.p_value(chosen))
                continue
            fitting = [blocks.p_value(group, alone=chosen) for group in groups if 3 * len(group) <= count]
            if len(fitting) == len(groups) > 1:
                found.append(cauchy_combination(fitting))
        if not found and self._jackknives:
            finest = self._jackknives[0]
            found.append(finest.p_value(chosen, most=len(finest.blocks.zz) // 3))
        return max(found, default=1.0)


def wald_p(g: Grams, chosen: Sequence[int], alone: Sequence[int] = (), most: int | None = None) -> float:
    """P value that the chosen coefficients are zero, the others free: delete-block jackknife (CR3), Hotelling's F.

    Parameters
    ----------
    alone: coefficients that are not free but zero where they are not chosen. A family whose part common to all sensors
        cannot be seen says nothing of one sensor as long as the other sensors' coefficients are free.
    most: directions tested, those with the most information; all if None.
    """
    return _Jackknife(g).p_value(chosen, alone, most)


@dataclass(frozen=True)
class _Jackknife:
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

    def p_value(self, chosen: Sequence[int], alone: Sequence[int] = (), most: int | None = None) -> float:
        """As `wald_p`."""
        from scipy.special import fdtrc

        count, terms = len(self.blocks.zz), self.blocks.count
        subset = np.asarray(chosen, dtype=int)
        (full_n, full_y), (n, y) = self._equations(subset, np.setdiff1d(np.arange(terms), [*chosen, *alone]))
        basis, values = _directions(full_n[0], self.own.of(subset))
        basis = basis[:, np.argsort(values)[::-1][:most]]
        p = basis.shape[1]
        if p == 0 or p >= count:
            return 1.0
        basis = _confirmed(basis @ np.linalg.inv(np.linalg.cholesky(basis.T @ full_n[0] @ basis)).T, n)
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


def cauchy_combination(p_values: Sequence[float]) -> float:
    """One p value from several that may depend on each other (ACAT, Liu and Xie 2020)."""
    if min(p_values) >= 1.0:
        return 1.0
    p = np.clip(np.asarray(p_values, dtype=float), 1e-300, 1 - 1e-12)
    # tan(pi (1/2 - p)) is 1 / (pi p) for the smallest p, where the tangent itself overflows its accuracy
    statistic = np.mean(np.where(p < 1e-15, 1 / (np.pi * p), np.tan(np.pi * (0.5 - p))))
    if statistic > 1e15:
        return float(1 / (np.pi * statistic))
    return float(0.5 - np.arctan(statistic) / np.pi)


def fisher_combination(p_values: Sequence[float]) -> float:
    """One p value from several independent ones (Fisher 1925); 1 of none."""
    from scipy.special import chdtrc

    if not len(p_values):
        return 1.0
    p = np.maximum(np.asarray(p_values, dtype=float), 1e-300)
    return float(chdtrc(2.0 * len(p), -2.0 * np.sum(np.log(p))))
