"""Evidence for regressors: block Gram matrices, from which every statistic follows without another pass.

Across the plane the fit's own freedom is (b, 1) in every direction, so two regressors that act on outputs i and j
with series d and e share Q_ij (d - P d) . (e - P e), P the projection on (b, 1): one small Gram of distinct series
serves every output. Along the field the regressors are products with the gain, a plain Gram.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.error_models.terms import REFERENCE, Terms, joined
from magtensor.loop.evidence.colour import Colour
from magtensor.loop.evidence.columns import Columns, Made, across_directions, along_the_field
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.evidence.turned import TurnedColour

_INNER_RANK = 1e-9
ENTRIES = 4_000_000  # of the products of all pieces that are held at a time


@dataclass(frozen=True)
class Pieces:
    """What coefficients do across, series by series.

    Attributes:
        term, series: (R,) whose coefficient times which series.
        across: (R, 3 S) 1/nT, how it acts on the whitened outputs, what the sensors share projected off.
        shown: (R, R) products of that; alone: (R,) its square, were each output seen by itself.
        noise: (P,) part of the variance of each term that is noise.
    """

    term: NDArray[np.int_]
    series: NDArray[np.int_]
    across: Array
    shown: Array
    alone: Array
    noise: Array

    @cached_property
    def pairs(self) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """(K,), (K,) all ordered pairs of two different pieces of one term."""
        same = self.term[:, None] == self.term
        np.fill_diagonal(same, False)
        first, second = np.nonzero(same)
        return first, second

    @classmethod
    def of(cls, terms: Terms, residual: Residual) -> Pieces:
        raw = np.flatnonzero(terms.part_output != REFERENCE)
        count, on = max(terms.series.shape[1], 1), terms.part_output[raw]
        kinds, which = np.unique(terms.part_term[raw] * count + terms.part_series[raw], return_inverse=True)
        outputs = np.zeros((len(kinds), len(residual.noise)))
        np.add.at(outputs, (which, on), terms.part_weight[raw] / residual.noise[on])
        across = outputs @ residual.projector
        alone = outputs**2 @ np.diagonal(residual.projector)
        return cls(kinds // count, kinds % count, across, across @ across.T, alone, terms.noise_of_each)


@dataclass(frozen=True)
class Grams:
    """Sums over each of B blocks.

    Attributes:
        zz, zd, dd: (B, A, A), (B, A, K), (B, K, K) of the affine functions z and the series d, whitened.
        ze, de: (B, A, 3 S), (B, K, 3 S) with the residual across.
        ee: (B,) square of the residual across.
        aa, ar: (B, 3 A + P, 3 A + P), (B, 3 A + P) of the columns along and with the residual along, those of known
            directions added.
        rr: (B,) square of the residual along, that of known directions added.
        samples: (B,) how many samples a block holds.
        pieces, count: of the terms.
        one_survey: whether each block is the whole survey, with terms of its own: the fit's freedom is the same in all.
    """

    zz: Array
    zd: Array
    dd: Array
    ze: Array
    de: Array
    ee: Array
    aa: Array
    ar: Array
    rr: Array
    samples: Array
    pieces: Pieces
    count: int
    one_survey: bool = False

    @property
    def own(self) -> int:
        """3 A, the columns along that are the fit's own freedom."""
        return int(self.aa.shape[1]) - self.count

    def merged(self, blocks: int) -> Grams:
        """The same in fewer, longer blocks of consecutive ones."""
        starts = np.linspace(0, len(self.zz), blocks, endpoint=False).round().astype(int)
        return self._with(lambda a: np.add.reduceat(a, starts, axis=0))

    def total(self) -> Grams:
        """All blocks as one."""
        return self if len(self.zz) == 1 else self._with(lambda a: a.sum(axis=0, keepdims=True))

    def without_each(self) -> Grams:
        """For each block, the sum of all others."""
        return self._with(lambda a: a.sum(axis=0, keepdims=True) - a)

    def chosen(self, masks: NDArray[np.bool_]) -> Grams:
        """For each row of masks (R, B), the sum of the blocks it marks."""
        return self._with(lambda a: np.tensordot(masks.astype(float), a, axes=1))

    def _with(self, f: Callable[[Array], Array]) -> Grams:
        return Grams(
            f(self.zz), f(self.zd), f(self.dd), f(self.ze), f(self.de), f(self.ee), f(self.aa), f(self.ar), f(self.rr),
            f(self.samples), self.pieces, self.count,
        )  # fmt: skip


@dataclass(frozen=True)
class Whitened:
    """A residual, the fit's own freedom and the models already in it, in noise made white: what new terms are added to.

    Attributes:
        residual: of N samples; across, along: the colours of its two parts.
        given: terms that are in already; None without any.
        known_across: (N, A + K + 3 S) the affine functions, the series of the given terms and the residual across; None
            for a single sensor.
        known_along: (N, 3 A + P + 1) the fit's own freedom, the columns of the given terms and the residual along; None
            without a total field.
        known_sighted: (2 N, 3 A + P + 1) the same of known directions, None without; they are white already.
        over_time: whether the rows are samples; where only sums over all of them are asked for they need not be.
    """

    residual: Residual
    across: Colour
    along: Colour | TurnedColour
    given: Terms | None
    known_across: Array | None
    known_along: Array | None
    known_sighted: Array | None
    over_time: bool = True

    @classmethod
    def of(
        cls,
        residual: Residual,
        across: Colour,
        along: Colour | TurnedColour,
        given: Terms | None = None,
        *,
        over_time: bool = True,
    ) -> Whitened:
        known_across = known_along = known_sighted = None
        if residual.across is not None:
            series = [] if given is None else [given.series * _seen_across(given)]
            known = np.hstack([residual.affine, *series, residual.across])
            known_across = across.whiten(known, back=over_time)
        if residual.along is not None:
            columns = [] if given is None else [along_the_field(residual, [given]).made]
            known = np.hstack([residual.inner, *columns, residual.along[:, None]])
            known_along = along.whiten(known, back=over_time)
        if residual.sighted is not None:
            columns = [] if given is None else [across_directions(residual, [given]).made]
            known_sighted = np.hstack([residual.sighted.inner, *columns, residual.sighted.residual[:, None]])
        return cls(residual, across, along, given, known_across, known_along, known_sighted, over_time)

    @cached_property
    def _sums(self) -> dict[bytes, tuple[Array | None, Array | None, Array | None]]:
        return {}

    def sums(self, blocks: int | NDArray[np.int_]) -> tuple[Array | None, Array | None, Array | None]:
        """(B, ., .) products of all that is known across with each other, of all that is along, and sighted."""
        key = self.edges(blocks).tobytes()
        if key not in self._sums:
            across, along, sighted = (
                None if k is None else _products(k, k, self.edges(blocks, len(k)))
                for k in (self.known_across, self.known_along, self.known_sighted)
            )
            self._sums[key] = across, along, sighted
        return self._sums[key]

    def edges(self, blocks: int | NDArray[np.int_], rows: int | None = None) -> NDArray[np.int_]:
        """(B + 1,) where blocks of equal length, or those given, begin and end, in samples or in so many rows, as many
        of each sample."""
        assert self.over_time or np.ndim(blocks) or blocks == 1
        count = len(self.residual.affine)
        edges = np.linspace(0, count, blocks + 1).round().astype(int) if isinstance(blocks, int) else blocks
        return edges * ((rows or count) // count)


def _seen_across(terms: Terms) -> float:
    return 1.0 if (terms.part_output != REFERENCE).any() else 0.0


def _products(a: Array, b: Array, edges: NDArray[np.int_]) -> Array:
    """(B, K, L) products of the columns of (N, K) and (N, L) in each block."""
    return np.stack([a[i:j].T @ b[i:j] for i, j in itertools.pairwise(edges)])


def grams(
    residual: Residual,
    terms: Terms,
    across: Colour,
    along: Colour | TurnedColour,
    blocks: int | NDArray[np.int_] = 1,
) -> Grams:
    """Gram matrices of terms evaluated at the residual's samples, in contiguous blocks.

    Parameters
    ----------
    terms: their series have the residual's samples as rows.
    across, along: the colours of the two parts of the residual.
    blocks: how many of equal length, or (B + 1,) samples where they begin and end.
    """
    return grams_in(Whitened.of(residual, across, along), terms, blocks)


_Sums = Callable[[Array, Array], tuple[Array, Array]]  # of what is known and what is new (N, .), and of the new alone


def grams_in(white: Whitened, terms: Terms | None, blocks: int | NDArray[np.int_] = 1) -> Grams:
    """The same of the terms that are in a whitened residual already, and of more where there are any."""

    def sums(known: Array, new: Array) -> tuple[Array, Array]:
        edges = white.edges(blocks, len(new))
        return _products(known, new, edges), _products(new, new, edges)

    samples = np.diff(white.edges(blocks)).astype(float)
    several = [] if terms is None else [terms]
    made = Made.of(white.residual, several) if several else None
    return _grams(white, several, made, sums, white.sums(blocks), samples)


def grams_of_each(white: Whitened, several: Sequence[Terms], made: Made | None = None) -> Grams:
    """The same over all samples of each of several sets of terms, one in the place of each block; only in their series
    do they differ. What is made of them may be given: it is the same in noise of any colour."""
    count = len(several)

    def sums(known: Array, new: Array) -> tuple[Array, Array]:
        each = np.ascontiguousarray(new.T).reshape(count, -1, len(new))
        return (each @ known).swapaxes(1, 2), each @ each.swapaxes(1, 2)

    across, along, sighted = (None if s is None else s.repeat(count, axis=0) for s in white.sums(1))
    samples = np.full(count, float(len(white.residual.affine)))
    made = made or Made.of(white.residual, several)
    return replace(_grams(white, several, made, sums, (across, along, sighted), samples), one_survey=True)


def _grams(
    white: Whitened,
    several: Sequence[Terms],
    made: Made | None,
    sums: _Sums,
    known: tuple[Array | None, Array | None, Array | None],
    samples: Array,
) -> Grams:
    """Gram matrices of what is in a whitened residual and of sets of new terms.

    Parameters
    ----------
    several: the sets, or none, and what is made of them; sums: of what is known and new, and of what is new.
    known: products of what is known (B, ., .), across, along and sighted; samples: (B,).
    """
    residual, given, batch = white.residual, white.given, len(samples)
    together = joined([t.at(np.arange(0)) for t in (given, *several[:1]) if t is not None])  # without their series
    own, size = residual.affine.shape[1], len(residual.noise)
    k, p = together.series.shape[1], together.count
    zz, zd, dd = np.zeros((batch, own, own)), np.zeros((batch, own, k)), np.zeros((batch, k, k))
    ze, de, ee = np.zeros((batch, own, size)), np.zeros((batch, k, size)), np.zeros(batch)
    aa, ar, rr = np.zeros((batch, 3 * own + p, 3 * own + p)), np.zeros((batch, 3 * own + p)), np.zeros(batch)
    across, along, sighted = known
    if across is not None and white.known_across is not None:
        m = across.shape[1] - size  # z and the series of the given terms
        zz, ze, ee = across[:, :own, :own], across[:, :own, m:], np.trace(across[:, m:, m:], axis1=1, axis2=2)
        zd[:, :, : m - own], dd[:, : m - own, : m - own] = across[:, :own, own:m], across[:, own:m, own:m]
        de[:, : m - own] = across[:, own:m, m:]
        if made is not None and _seen_across(several[0]):
            series = made.series
            new = slice(m - own, None)
            d = white.across.whiten(series.reshape(-1, series.shape[2]).T, back=white.over_time)
            seen, dd[:, new, new] = sums(white.known_across, d)
            zd[:, :, new], de[:, new] = seen[:, :own], seen[:, m:].swapaxes(1, 2)
            dd[:, : m - own, new], dd[:, new, : m - own] = seen[:, own:m], seen[:, own:m].swapaxes(1, 2)

    def add(products: Array, known: Array, columns: Columns | None, whiten: Callable[[Array], Array]) -> None:
        m = products.shape[1] - 1  # the fit's own freedom and the columns of the given terms
        aa[:, :m, :m] += products[:, :m, :m]
        ar[:, :m] += products[:, :m, m]
        rr[:] += products[:, m, m]
        if columns is not None:
            mix = columns.mix
            seen, new = sums(known, whiten(columns.base))
            seen = seen @ mix
            aa[:, :m, m:] += seen[:, :m]
            aa[:, m:, :m] += seen[:, :m].swapaxes(1, 2)
            ar[:, m:] += seen[:, m]
            aa[:, m:, m:] += mix.T @ new @ mix

    if along is not None and white.known_along is not None:
        columns = None if made is None else made.along
        add(along, white.known_along, columns, partial(white.along.whiten, back=white.over_time))
    if sighted is not None and white.known_sighted is not None:
        add(sighted, white.known_sighted, None if made is None else made.sighted, lambda c: c)
    return Grams(
        zz, zd, dd, ze, de, ee, aa, ar, rr, samples, Pieces.of(together, residual), p,
    )  # fmt: skip


def normal(g: Grams, first: int = 0) -> tuple[Array, Array]:
    """Normal matrix (B, P, P) and right side (B, P) of the terms for each set, the fit's own freedom projected off.

    Parameters
    ----------
    first: of the coefficients that are asked for, those before it known already: the columns (B, P, P - first) of them.
    """
    batch = len(g.zz)
    n = np.zeros((batch, g.count, g.count - first))
    y = np.zeros((batch, g.count - first))
    asked = g.pieces.term >= first
    if asked.any() and g.zz.any():
        most = max(ENTRIES // (len(asked) * int(asked.sum())), 1)
        for begin in range(0, batch, most):
            _add_across(g, slice(begin, begin + most), int(np.argmax(asked)), n, y)
    if g.aa.any():
        m = g.own
        own = _inverse((g.aa[:1] if g.one_survey else g.aa)[:, :m, :m])
        mixed, known = g.aa[:, :m, m + first :], g.aa[:, :m, m:]
        turned = own @ mixed
        n += g.aa[:, m:, m + first :] - known.swapaxes(1, 2) @ turned
        y += g.ar[:, m + first :] - (turned.swapaxes(1, 2) @ g.ar[:, :m, None])[:, :, 0]
    return n, y


def _add_across(g: Grams, sets: slice, first: int, n: Array, y: Array) -> None:
    """Add what some of the sets know across, of the pieces from a number on, to all normal matrices (B, P, p) and right
    sides (B, p); the pieces and their series are in the order of the terms."""
    zd, pieces, series = g.zd[sets], g.pieces, g.pieces.series
    begin = int(series[first:].min())
    zd_asked, k = zd[:, :, begin:], g.dd.shape[1] - begin
    solve = np.linalg.solve(g.zz[:1] if g.one_survey else g.zz[sets], np.concatenate([zd_asked, g.ze[sets]], axis=2))
    t = g.dd[sets][:, :, begin:] - np.swapaxes(zd, 1, 2) @ solve[:, :, :k]
    c = g.de[sets][:, begin:] - np.swapaxes(zd_asked, 1, 2) @ solve[:, :, k:]
    asked = series[first:] - begin
    parts = t[:, series[:, None], asked[None, :]] * pieces.shown[:, first:]
    found = np.einsum("bro,ro->br", c[:, asked], pieces.across[first:])
    starts = np.flatnonzero(np.diff(pieces.term, prepend=-1))
    own = pieces.term[starts]
    starts_asked = starts[starts >= first] - first
    own_asked = pieces.term[first:][starts_asked] - (n.shape[1] - n.shape[2])
    if len(starts) < len(pieces.term):
        parts = np.add.reduceat(np.add.reduceat(parts, starts, axis=1), starts_asked, axis=2)
        found = np.add.reduceat(found, starts_asked, axis=1)
    n[sets, own[:, None], own_asked] += parts
    y[sets, own_asked] += found


def _inverse(information: Array) -> Array:
    """(B, Q, Q) pseudo-inverses of symmetric matrices of no negative eigenvalue; the rank along the field is known to
    be smaller than Q."""
    values, vectors = np.linalg.eigh(information)
    seen = values > _INNER_RANK * values[:, -1:]
    out: Array = (vectors * np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)[:, None, :]) @ vectors.swapaxes(1, 2)
    return out


def held_out(train: Grams, test: Grams, theta: Array, blocked: NDArray[np.bool_] | None = None) -> tuple[Array, Array]:
    """Sum of squared residuals of each test set, without and with the terms.

    The fit's own freedom is fitted anew on each training set, with the terms held at theta (their residual is what
    it is fitted to).

    Parameters
    ----------
    train, test: R sets each.
    theta: (R, P) coefficients from the training sets; those of `blocked` (P,) count in both cases.
    """
    zero = np.zeros_like(theta) if blocked is None else np.where(blocked, theta, 0.0)
    return _loss(train, test, zero), _loss(train, test, theta)


def _loss(train: Grams, test: Grams, theta: Array) -> Array:
    batch = len(theta)
    loss = np.zeros(batch)
    if train.zz.any():
        pieces = train.pieces
        w = np.zeros((batch, train.dd.shape[1], train.ze.shape[2]))
        for term, series, across in zip(pieces.term, pieces.series, pieces.across, strict=True):
            w[:, series] += theta[:, term, None] * across
        own = np.linalg.solve(train.zz, train.ze - train.zd @ w)
        loss += test.ee + np.sum(own * (test.zz @ own + 2 * (test.zd @ w - test.ze)), axis=(1, 2))
        loss += np.sum(w * (test.dd @ w - 2 * test.de), axis=(1, 2))
    if train.aa.any():
        m = train.own
        inverse = _inverse(train.aa[:, :m, :m])
        right = train.ar[:, :m] - np.einsum("bij,bj->bi", train.aa[:, :m, m:], theta)
        full = np.concatenate([np.einsum("bij,bj->bi", inverse, right), theta], axis=1)
        loss += test.rr - 2 * np.einsum("bi,bi->b", full, test.ar) + np.einsum("bi,bij,bj->b", full, test.aa, full)
    return loss
