"""What terms gain on held-out blocks: the second gate of METHODS A2 steps 4 and 5."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.evidence.estimate import IDENTIFIABLE, own_information, theta_of_each
from magtensor.loop.evidence.folds import FOLDS, NOTHING, Blocks
from magtensor.loop.evidence.grams import Grams, held_out, normal
from magtensor.loop.evidence.statistics import LEAST_BLOCKS

INTERLEAVED_FOLDS = 20
LEAST_T = 2.0  # paired t of the held-out gain over folds
LEAST_SHARE_OF_FOLDS = 0.8  # a strong slow effect gains unevenly, which keeps t low, but nearly everywhere
WORSE = 4.0  # standard deviations below the mean of the folds, of the worst of ten
CONCENTRATED = 0.9  # of what is known, in one fold or two neighbours: the others do not predict it
MOST_FOLDS = 0.5  # that may be no judges


@dataclass(frozen=True)
class Gain:
    """What terms gain on data their coefficients have not seen.

    Attributes:
        before, after: (folds,) sums of squared whitened residuals.
        values: how many values each fold holds.
        judges: (folds,) the numbers of the folds, where not all of them judge.
    """

    before: Array
    after: Array
    values: Array
    judges: NDArray[np.int_] | None = None

    @property
    def total(self) -> float:
        """Reduction of the sum of squares; twice the log likelihood ratio."""
        return float(np.sum(self.before - self.after))

    @property
    def t(self) -> float:
        """Paired t of the reduction per value over folds."""
        each = (self.before - self.after) / self.values
        spread = float(each.std(ddof=1))
        return float(each.mean() / (spread / np.sqrt(len(each)))) if spread > 0 else 0.0

    def over(self, other: Gain) -> Gain:
        """What this gains over another on the folds that both were judged on."""
        mine, theirs = (np.arange(len(g.values)) if g.judges is None else g.judges for g in (self, other))
        common, i, j = np.intersect1d(mine, theirs, return_indices=True)
        return Gain(other.after[j], self.after[i], self.values[i], common)

    @property
    def consistent(self) -> bool:
        """Whether the gain is there in nearly every fold, or on average by more than its scatter explains."""
        better = (self.before > self.after).mean()
        return self.total > 0 and (self.t > LEAST_T or better >= LEAST_SHARE_OF_FOLDS)

    @property
    def contradicted(self) -> bool:
        """Whether one of the folds, all of which should gain as much, is made worse by more than chance: if what is
        true gains G on each, noise makes that scatter by 2 sqrt(G)."""
        each = self.before - self.after
        mean = float(each.mean())
        return bool(each.min() < 0 and mean - each.min() > WORSE * 2.0 * np.sqrt(max(mean, 0.0)))

    @property
    def rms(self) -> tuple[float, float]:
        """Whitened rms before and after."""
        count = float(self.values.sum())
        return float(np.sqrt(self.before.sum() / count)), float(np.sqrt(max(self.after.sum(), 0.0) / count))


def held_out_gain(
    g: Grams,
    freedom: int,
    blocked: NDArray[np.bool_] | None = None,
    blocks: Blocks | None = None,
    *,
    everywhere: bool = False,
) -> Gain:
    """Gain over contiguous folds, a block's gap between training and test.

    A fold that holds nearly all that is known of a term of both models is no judge: there the others leave what that
    term does, a passing vehicle say, and of two models the one that follows it by chance seems to do better.

    Parameters
    ----------
    g: the finest blocks.
    freedom: residual values a sample.
    blocked: (P,) terms that belong to both models compared.
    blocks: those of g and their folds; blocks and folds of equal length without.
    everywhere: whether such folds judge all the same.
    """
    count = len(g.zz)
    edges = blocks.folds if blocks else np.linspace(0, count, min(FOLDS, count) + 1).round().astype(int)
    return _gain_between(g, freedom, edges, blocked, everywhere)


def focused_gain(g: Grams, freedom: int, blocked: NDArray[np.bool_], *, everywhere: bool = False) -> Gain | None:
    """The same over contiguous folds that know equally much of the terms; None where a few blocks know nearly all.

    What acts in one part of a survey only lies in one fold of equal length, and what the others predict of it is one
    figure. A fold outside which nothing is known of the terms, as all that there was before a current was switched on
    for good, is no judge either.
    """
    edges = focused_folds(g, blocked)
    if len(edges) <= LEAST_BLOCKS:
        return None
    gain = _gain_between(g, freedom, edges, blocked, everywhere, ~blocked)
    return replace(gain, values=np.full(len(gain.values), gain.values.mean()))  # each fold should gain as much


def focused_folds(g: Grams, blocked: NDArray[np.bool_]) -> NDArray[np.int_]:
    """(folds + 1,) blocks where those folds begin and end: it follows from the terms and not from the data."""
    known = np.cumsum(_share_of_blocks(g, ~blocked))
    edges = np.unique(np.searchsorted(known, np.linspace(0.0, 1.0, FOLDS + 1)[1:-1], side="left") + 1)
    return np.concatenate([[0], edges[edges < len(g.zz)], [len(g.zz)]])


def concentrated(g: Grams, blocked: NDArray[np.bool_]) -> bool:
    """Whether two neighbouring folds of equal length hold nearly all that is known of the terms that are not blocked:
    an edge between folds may lie anywhere in what was on once."""
    share, count = _share_of_blocks(g, ~blocked), len(g.zz)
    edges = np.linspace(0, count, min(FOLDS, count) + 1).round().astype(int)[:-1]
    each = np.add.reduceat(share, edges)
    return bool((each[1:] + each[:-1]).max(initial=each.max()) > CONCENTRATED)


def _share_of_blocks(g: Grams, chosen: NDArray[np.bool_]) -> Array:
    """(B,) how much of what is known of some terms (P,) each block knows, constants left out; the sum is 1."""
    info = np.diagonal(g.aa, axis1=1, axis2=2)[:, g.own :].copy()
    pieces = g.pieces
    if len(pieces.term) and g.zz.any():
        own, mixed = g.zz[:, 3, 3], g.zd[:, 3]
        mean = mixed.sum(axis=0) / own.sum()
        size = np.diagonal(g.dd, axis1=1, axis2=2) - 2.0 * mean * mixed + mean**2 * own[:, None]
        np.add.at(info.T, pieces.term, (size[:, pieces.series] * pieces.alone).T)
    info = np.maximum(info[:, chosen], 0.0)
    out: Array = (info / np.maximum(info.sum(axis=0), 1e-300)).mean(axis=1)
    return out


def _gain_between(
    g: Grams,
    freedom: int,
    edges: NDArray[np.int_],
    blocked: NDArray[np.bool_] | None,
    everywhere: bool,
    asked: NDArray[np.bool_] | None = None,
) -> Gain:
    """Gain over folds of the finest blocks between edges, those that are judges beside the blocked terms and of those
    `asked` (P,)."""
    count, folds = len(g.zz), len(edges) - 1
    test_masks, train_masks = np.zeros((folds, count), dtype=bool), np.ones((folds, count), dtype=bool)
    gap = 1 if count >= 4 * folds else 0
    for k, (a, b) in enumerate(itertools.pairwise(edges)):
        test_masks[k, a:b] = True
        train_masks[k, max(a - gap, 0) : b + gap] = False
    every = np.ones(g.count, dtype=bool)
    before = ~every if blocked is None else blocked
    gain, n = gain_over(g, freedom, test_masks, train_masks, before, every)
    if everywhere or not (before.any() or asked is not None):
        return gain
    known = np.diagonal(normal(g.total())[0][0])
    seen = known > IDENTIFIABLE * own_information(g).information
    judges = judged_by(np.diagonal(n, axis1=1, axis2=2) / np.where(seen, known, 1.0), before & seen, asked)
    if len(judges) == folds:
        return gain
    return Gain(gain.before[judges], gain.after[judges], gain.values[judges], judges)


def judged_by(known: Array, given: NDArray[np.bool_], asked: NDArray[np.bool_] | None = None) -> NDArray[np.int_]:
    """The numbers of the folds outside which something is known of each of the given terms (P,), and of those `asked`
    together; all, where these are too few.

    Parameters
    ----------
    known: (folds, P) part of what is known of each term, the fit's own freedom projected off, that is outside each.
    """
    judges = np.asarray((known[:, given] >= 1.0 - CONCENTRATED).all(axis=1))
    if asked is not None:
        judges &= known[:, asked].mean(axis=1) >= NOTHING
    return np.flatnonzero(judges) if judges.sum() > MOST_FOLDS * len(judges) else np.arange(len(judges))


def interleaved_gain(g: Grams, freedom: int, before: NDArray[np.bool_], after: NDArray[np.bool_]) -> Gain:
    """Gain of the terms `after` (P,) over those `before` (P,) on folds of blocks that lie evenly between all others.

    For terms that change slowly over the survey: what they do in a long stretch does not follow from the others.
    """
    folds = min(INTERLEAVED_FOLDS, len(g.zz))
    number = np.arange(len(g.zz)) % folds
    test_masks = number == np.arange(folds)[:, None]
    return gain_over(g, freedom, test_masks, ~test_masks, before, after)[0]


def gain_over(
    g: Grams,
    freedom: int,
    test_masks: NDArray[np.bool_],
    train_masks: NDArray[np.bool_],
    before: NDArray[np.bool_],
    after: NDArray[np.bool_],
) -> tuple[Gain, Array]:
    """Gain of some terms over others of them, and the information (folds, P, P) on all outside each fold, the fit's own
    freedom projected off.

    Parameters
    ----------
    g: the finest blocks.
    freedom: residual values a sample.
    test_masks, train_masks: (folds, B) the blocks of each fold.
    before, after: (P,) terms of the two models compared.
    """
    train, test = g.chosen(train_masks), g.chosen(test_masks)
    n, y = normal(train)
    own = own_information(g)

    def loss(terms: NDArray[np.bool_]) -> Array:
        theta, use = np.zeros_like(y), np.flatnonzero(terms)
        if len(use):
            theta[:, use] = theta_of_each(n[:, use[:, None], use], y[:, use], own.of(use))
        return held_out(train, test, theta)[1]

    return Gain(loss(before), loss(after), test.samples * freedom), n
