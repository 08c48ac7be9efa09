"""Where blocks of a survey begin and end, and the contiguous folds that a model is asked to predict.

Folds of equal length ask of what acts everywhere. What happened once and is over soon lies in one or two of them, and
no other fold knows anything of it: one part of a vehicle's passing is predicted by its other parts alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.error_models.terms import Terms

FOLDS = 10
FINEST_BLOCKS = 120
LEAST_PER_BLOCK = 4
BLOCKS_OF_A_PART = 3  # the first and last of them are the gaps between training and test
NEARLY_ALL = 0.95  # of what is known of an effect: by the others its coefficients err four times as much
NOTHING = 0.01  # the same: by so little coefficients err ten times as much
FEW = 3  # neighbouring folds: in more of them other folds may well confirm what happened


@dataclass(frozen=True)
class Blocks:
    """Contiguous blocks, and folds of them.

    Attributes:
        edges: (B + 1,) samples where the blocks begin and end.
        folds: (folds + 1,) the blocks with which the folds begin, and B.
        divided: the number of the first fold that is a part of something that is over soon, and that of the first one
            after these; twice 0 where no such thing is asked for.
    """

    edges: NDArray[np.int_]
    folds: NDArray[np.int_]
    divided: tuple[int, int] = (0, 0)

    @classmethod
    def equal(cls, samples: int) -> Blocks:
        """Blocks of equal length in folds of equal length."""
        count = block_count(samples)
        edges = np.linspace(0, samples, count + 1).round().astype(int)
        return cls(edges, np.linspace(0, count, min(FOLDS, count) + 1).round().astype(int))

    @classmethod
    def of_an_event(cls, terms: Terms) -> Blocks:
        """The same, but where a few neighbouring folds hold nearly all that can be known of the terms they are divided
        into parts that know equally much: that follows from the terms (N samples) and not from the data."""
        plain = cls.equal(len(terms.series))
        known, starts = known_until(terms), plain.edges[plain.folds]
        for many in range(1, min(FEW, len(starts) - 2) + 1):
            held = known[starts[many:]] - known[starts[:-many]]
            if held.max() > NEARLY_ALL:
                first = int(held.argmax())
                return plain._divided(first, first + many, known)
        return plain

    def _divided(self, first: int, last: int, known: Array) -> Blocks:
        """With the folds from `first` to before `last` divided where a share of what is `known` (N + 1,) is reached."""
        start, end = self.edges[self.folds[first]], self.edges[self.folds[last]]
        share = np.arange(1, FOLDS * BLOCKS_OF_A_PART) / (FOLDS * BLOCKS_OF_A_PART)
        inner: list[int] = []
        for at in np.searchsorted(known, known[start] + (known[end] - known[start]) * share).tolist():
            if at - (inner[-1] if inner else start) >= LEAST_PER_BLOCK and end - at >= LEAST_PER_BLOCK:
                inner.append(at)
        before, after = self.edges[: self.folds[first] + 1], self.edges[self.folds[last] :]
        count = len(inner) + 1
        parts = np.linspace(0, count, min(FOLDS, count) + 1).round().astype(int)
        shift = len(before) - 1
        moved = shift + count - self.folds[last]
        folds = np.concatenate([self.folds[:first], shift + parts, self.folds[last + 1 :] + moved])
        edges = np.concatenate([before, np.array(inner, dtype=int), after])
        return Blocks(edges, folds, (first, first + len(parts) - 1))

    def among(self, samples: int) -> Blocks:
        """The same of a survey with more or fewer samples."""
        if samples == self.edges[-1]:
            return self
        return Blocks((self.edges * (samples / self.edges[-1])).round().astype(int), self.folds, self.divided)


def block_count(samples: int) -> int:
    """Blocks for a survey of so many samples."""
    return int(np.clip(samples // LEAST_PER_BLOCK, 1, FINEST_BLOCKS))


def known_until(terms: Terms) -> Array:
    """(N + 1,) part of what is known of the coefficients of terms, constants left out, that so many samples know."""
    square = (terms.series - terms.series.mean(axis=0)) ** 2
    share = square / np.maximum(square.sum(axis=0), 1e-300)
    return np.concatenate([[0.0], np.cumsum(share[:, terms.part_series].mean(axis=1))])
