"""Evidence for regressors: block Gram matrices, from which every statistic follows without another pass.

Across the plane the fit's own freedom is (b, 1) in every direction, so two regressors that act on outputs i and j
with series d and e share Q_ij (d - P d) . (e - P e), P the projection on (b, 1): one small Gram of distinct series
serves every output. Along the field the regressors are products with the gain, a plain Gram.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.colour import Colour
from magtensor.loop.residual import Residual
from magtensor.loop.terms import REFERENCE, Terms, joined
from magtensor.loop.turned import TurnedColour

IDENTIFIABLE = 1e-6  # of a regressor's own information: less than this is left after the fit's own freedom
_INNER_RANK = 1e-9


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
        part_term, part_output, part_series, count: of the terms.
        projector: (3 S, 3 S); noise: (3 S,) nT, of the residual.
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
    part_term: NDArray[np.int_]
    part_output: NDArray[np.int_]
    part_series: NDArray[np.int_]
    count: int
    projector: Array
    noise: Array

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
            f(self.samples), self.part_term, self.part_output, self.part_series, self.count, self.projector, self.noise,
        )  # fmt: skip


@dataclass(frozen=True)
class Columns:
    """Columns of P terms along the field, base @ mix, of few that are worked on: base (N, Q), mix (Q, P)."""

    base: Array
    mix: Array


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
        over_time: whether the rows are samples; where only sums over all of them are asked for they need not be.
    """

    residual: Residual
    across: Colour
    along: Colour | TurnedColour
    given: Terms | None
    known_across: Array | None
    known_along: Array | None
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
        known_across = known_along = None
        if residual.across is not None:
            series = [] if given is None else [given.series * _seen_across(given)]
            known = np.hstack([residual.affine, *series, residual.across])
            known_across = across.whiten(known, back=over_time)
        if residual.along is not None:
            columns = [] if given is None else [_made(along_the_field(residual, given))]
            known = np.hstack([residual.inner, *columns, residual.along[:, None]])
            known_along = along.whiten(known, back=over_time)
        return cls(residual, across, along, given, known_across, known_along, over_time)

    @cached_property
    def _sums(self) -> dict[int, tuple[Array | None, Array | None]]:
        return {}

    def sums(self, blocks: int) -> tuple[Array | None, Array | None]:
        """(B, ., .) products of all that is known across with each other, and of all that is known along."""
        if blocks not in self._sums:
            known = self.known_across, self.known_along
            first, second = (None if k is None else _products(k, k, self.edges(blocks)) for k in known)
            self._sums[blocks] = first, second
        return self._sums[blocks]

    def edges(self, blocks: int) -> NDArray[np.int_]:
        """(B + 1,) where blocks begin and end."""
        assert self.over_time or blocks == 1
        return np.linspace(0, len(self.residual.affine), blocks + 1).round().astype(int)


def _seen_across(terms: Terms) -> float:
    return 1.0 if (terms.part_output != REFERENCE).any() else 0.0


def _made(columns: Columns) -> Array:
    out: Array = columns.base @ columns.mix
    return out


def _products(a: Array, b: Array, edges: NDArray[np.int_]) -> Array:
    """(B, K, L) products of the columns of (N, K) and (N, L) in each block."""
    return np.stack([a[i:j].T @ b[i:j] for i, j in itertools.pairwise(edges)])


def grams(residual: Residual, terms: Terms, across: Colour, along: Colour | TurnedColour, blocks: int = 1) -> Grams:
    """Gram matrices of terms evaluated at the residual's samples, in contiguous blocks.

    Parameters
    ----------
    terms: their series have the residual's samples as rows.
    across, along: the colours of the two parts of the residual.
    """
    return grams_in(Whitened.of(residual, across, along), terms, blocks)


def grams_in(white: Whitened, terms: Terms | None, blocks: int = 1) -> Grams:
    """The same of the terms that are in a whitened residual already, and of more where there are any."""
    residual, given, edges = white.residual, white.given, white.edges(blocks)
    together = joined([t for t in (given, terms) if t is not None])
    own, size = residual.affine.shape[1], len(residual.noise)
    k, p = together.series.shape[1], together.count
    zz, zd, dd = np.zeros((blocks, own, own)), np.zeros((blocks, own, k)), np.zeros((blocks, k, k))
    ze, de, ee = np.zeros((blocks, own, size)), np.zeros((blocks, k, size)), np.zeros(blocks)
    aa, ar, rr = np.zeros((blocks, 3 * own + p, 3 * own + p)), np.zeros((blocks, 3 * own + p)), np.zeros(blocks)
    across, along = white.sums(blocks)
    if across is not None and white.known_across is not None:
        m = across.shape[1] - size  # z and the series of the given terms
        zz, ze, ee = across[:, :own, :own], across[:, :own, m:], np.trace(across[:, m:, m:], axis1=1, axis2=2)
        zd[:, :, : m - own], dd[:, : m - own, : m - own] = across[:, :own, own:m], across[:, own:m, own:m]
        de[:, : m - own] = across[:, own:m, m:]
        if terms is not None and _seen_across(terms):
            d = white.across.whiten(terms.series, back=white.over_time)
            new, seen = slice(m - own, None), _products(white.known_across, d, edges)
            zd[:, :, new], de[:, new] = seen[:, :own], seen[:, m:].swapaxes(1, 2)
            dd[:, : m - own, new], dd[:, new, : m - own] = seen[:, own:m], seen[:, own:m].swapaxes(1, 2)
            dd[:, new, new] = _products(d, d, edges)
    if along is not None and white.known_along is not None:
        m = along.shape[1] - 1  # the fit's own freedom and the columns of the given terms
        aa[:, :m, :m], ar[:, :m], rr = along[:, :m, :m], along[:, :m, m], along[:, m, m]
        if terms is not None:
            columns = along_the_field(residual, terms)
            base, mix = white.along.whiten(columns.base, back=white.over_time), columns.mix
            seen = _products(white.known_along, base, edges) @ mix
            aa[:, :m, m:], aa[:, m:, :m], ar[:, m:] = seen[:, :m], seen[:, :m].swapaxes(1, 2), seen[:, m]
            aa[:, m:, m:] = mix.T @ _products(base, base, edges) @ mix
    if residual.sighted is not None:
        every = np.hstack([residual.sighted.inner, across_directions(residual, together)])
        off = residual.sighted.residual
        aa, ar = aa + _products(every, every, 2 * edges), ar + _products(every, off[:, None], 2 * edges)[:, :, 0]
        rr = rr + _products(off[:, None], off[:, None], 2 * edges)[:, 0, 0]
    return Grams(
        zz, zd, dd, ze, de, ee, aa, ar, rr, np.diff(edges).astype(float),
        together.part_term, together.part_output, together.part_series, p, residual.projector, residual.noise,
    )  # fmt: skip


def along_the_field(residual: Residual, terms: Terms) -> Columns:
    """The terms' columns along the field."""
    found = _columns(residual, terms, residual.slow_modes.response, residual.shown_along)
    return found if residual.levels is None else replace(found, base=residual.levels.off(found.base))


def across_directions(residual: Residual, terms: Terms) -> Array:
    """(2 N, P): the terms' columns across known directions."""
    assert residual.sighted is not None
    twice = terms.at(np.repeat(np.arange(len(terms.series)), 2))
    found = _columns(residual, twice, residual.sighted.response, residual.shown_sighted)
    return found.base @ found.mix


def _columns(residual: Residual, terms: Terms, response: Array, shown: Array) -> Columns:
    """The terms' columns in rows of whitened values.

    The outputs show in each of them through three responses only, so a series that acts on more than three of them has
    no more columns than three to be worked on.
    """
    term, output, series = terms.part_term, terms.part_output, terms.part_series
    wide = np.bincount(series[output != REFERENCE], minlength=terms.series.shape[1]) > 3
    own = ~wide[series] | (output == REFERENCE)
    base = [terms.series[:, series[own]] * shown[:, output[own]]]
    mix = [np.zeros((int(own.sum()), terms.count))]
    mix[0][np.arange(len(mix[0])), term[own]] = 1.0
    if wide.any():
        size = 3 * int(wide.sum())
        base.append((terms.series[:, wide, None] * response[:, None, :]).reshape(len(response), size))
        each = np.zeros((size // 3, 3, terms.count))
        place = (np.cumsum(wide) - 1)[series[~own]]
        by_output = residual.basis[output[~own]] / residual.noise[output[~own], None]
        np.add.at(each, (place[:, None], np.arange(3), term[~own, None]), by_output)
        mix.append(each.reshape(size, terms.count))
    found = Columns(np.hstack(base), np.vstack(mix))
    return found if len(found.mix) <= terms.count else Columns(found.base @ found.mix, np.eye(terms.count))


def normal(g: Grams) -> tuple[Array, Array]:
    """Normal matrix (B, P, P) and right side (B, P) of the terms for each set, the fit's own freedom projected off."""
    batch = len(g.zz)
    n = np.zeros((batch, g.count, g.count))
    y = np.zeros((batch, g.count))
    raw = g.part_output != REFERENCE
    if raw.any() and g.zz.any():
        solve = np.linalg.solve(g.zz, np.concatenate([g.zd, g.ze], axis=2))
        k = g.dd.shape[1]
        t = g.dd - np.swapaxes(g.zd, 1, 2) @ solve[:, :, :k]
        c = g.de - np.swapaxes(g.zd, 1, 2) @ solve[:, :, k:]
        o, s = g.part_output[raw], g.part_series[raw]
        parts = t[:, s[:, None], s[None, :]] * g.projector[o[:, None], o[None, :]]
        into = _incidence(g)
        n += into @ parts @ into.T
        y += c[:, s, o] @ into.T
    if g.aa.any():
        m = g.own
        own = _inverse(g.aa[:, :m, :m])
        mixed = g.aa[:, :m, m:]
        turned = np.swapaxes(mixed, 1, 2) @ own
        n += g.aa[:, m:, m:] - turned @ mixed
        y += g.ar[:, m:] - (turned @ g.ar[:, :m, None])[:, :, 0]
    return n, y


def _inverse(information: Array) -> Array:
    """(B, Q, Q) pseudo-inverses of symmetric matrices of no negative eigenvalue; the rank along the field is known to
    be smaller than Q."""
    values, vectors = np.linalg.eigh(information)
    seen = values > _INNER_RANK * values[:, -1:]
    out: Array = (vectors * np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)[:, None, :]) @ vectors.swapaxes(1, 2)
    return out


def _incidence(g: Grams) -> Array:
    """(P, parts on raw outputs): 1 / noise of the output where the part belongs to the term."""
    raw = np.flatnonzero(g.part_output != REFERENCE)
    into = np.zeros((g.count, len(raw)))
    into[g.part_term[raw], np.arange(len(raw))] = 1.0 / g.noise[g.part_output[raw]]
    return into


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
        k, size = train.dd.shape[1], len(train.noise)
        raw = np.flatnonzero(train.part_output != REFERENCE)
        w = np.zeros((batch, k, size))
        for j in raw:
            o = train.part_output[j]
            w[:, train.part_series[j], o] += theta[:, train.part_term[j]] / train.noise[o]
        w = w @ train.projector
        own = np.linalg.solve(train.zz, train.ze - train.zd @ w)
        loss += test.ee + np.einsum("bij,bik,bkj->b", own, test.zz, own) + np.einsum("bij,bik,bkj->b", w, test.dd, w)
        loss += 2 * np.einsum("bij,bik,bkj->b", own, test.zd, w)
        loss -= 2 * (np.einsum("bij,bij->b", own, test.ze) + np.einsum("bij,bij->b", w, test.de))
    if train.aa.any():
        m = train.own
        inverse = _inverse(train.aa[:, :m, :m])
        right = train.ar[:, :m] - np.einsum("bij,bj->bi", train.aa[:, :m, m:], theta)
        full = np.concatenate([np.einsum("bij,bj->bi", inverse, right), theta], axis=1)
        loss += test.rr - 2 * np.einsum("bi,bi->b", full, test.ar) + np.einsum("bi,bij,bj->b", full, test.aa, full)
    return loss
