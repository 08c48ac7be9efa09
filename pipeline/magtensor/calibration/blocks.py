"""What contiguous blocks of samples say, as sums over each: from them the scores of every block at any parameters.

The samples of a block are neighbours in time. How the scores of blocks scatter tells what noise of any colour does to
the parameters (`score_colour`), without a second look at the samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from .common_field import CommonField
from .maximum_likelihood import CHUNK, NOTHING, Along, ScalarFit, Scores, along, products_of, scores_of_blocks
from .types import Array

BLOCKS = 128  # of a recording; of a long one three quarters as many to three halves
LEAST_PER_BLOCK = 4  # samples


@dataclass(frozen=True)
class BlockScores:
    """Half the derivative of the cost by block, and its expected information; B blocks.

    Attributes:
        across: (B, 3 S - 3, 4) sum of the whitened residual in each direction across the plane times (1, field);
            across_normal: (B, 4, 4), the same for every direction.
        along: (B, 9) with the parameters of `Scores`; along_normal: (B, 9, 9).
    """

    across: Array
    across_normal: Array
    along: Array
    along_normal: Array


@dataclass
class Blocks:
    """Sums over each block in whitened outputs, turned (the first three are the plane's coordinates) and centred.

    Attributes:
        axes: (3 S, 3 S) orthonormal columns, the plane's three first; mean: (3 S,), the plane's. Whitened outputs are
            axes @ z + mean.
        turn: (3 S, 3 S) from raw outputs; centre: (3 S,) the mean, turned: z = turn @ raw - centre.
        total: of z, (3 S,) each; square: of z z', (3 S, 3 S) each, zero for a single sensor, whose plane is all there
            is; scores: of the scalar part.
        number: of the last block.
    """

    axes: Array
    mean: Array
    turn: Array
    centre: Array
    total: list[Array] = field(default_factory=list)
    square: list[Array] = field(default_factory=list)
    scores: list[Scores] = field(default_factory=list)
    number: int = -1

    @classmethod
    def of(cls, plane: CommonField) -> Blocks:
        """None yet."""
        axes = np.linalg.qr(plane.basis, mode="complete")[0]
        axes[:, :3] = plane.basis
        return cls(axes, plane.mean, (axes / plane.noise[:, None]).T, axes.T @ plane.mean)

    def add(self, number: int, edges: Sequence[int], z: Array, seen: Along, total_field: Array) -> None:
        """Samples z (3 S, n) of consecutive blocks, the first with its number, from each edge to the next. The first
        may go on where the last one ended."""
        size = len(z)
        one = np.vstack([z, np.ones(z.shape[1])]) if size > 3 else np.empty((0, 0))
        for own, (start, stop) in zip(scores_of_blocks(seen, total_field, edges), pairwise(edges), strict=True):
            sums = products_of(one, size, start, stop) if size > 3 else np.zeros((size, size + 1))
            square, total = sums[:, :size], sums[:, size]
            if number == self.number:
                self.total[-1] += total
                self.square[-1] += square
                self.scores[-1] += own
            elif own.samples:
                self.number = number
                self.total.append(total)
                self.square.append(square)
                self.scores.append(own)
            number += 1

    def summed(self) -> tuple[Array, Array, Scores]:
        """The sums over all blocks."""
        size = len(self.mean)
        return (
            np.sum([np.zeros(size), *self.total], axis=0),
            np.sum([np.zeros((size, size)), *self.square], axis=0),
            sum(self.scores, NOTHING),
        )

    def at(self, plane: CommonField, scalar: ScalarFit) -> BlockScores:
        """The scores at the parameters of a fit, whose noise is that of these whitened outputs."""
        normal = np.stack([s.normal for s in self.scores])
        gradient = np.stack([s.gradient for s in self.scores])
        along_ = gradient - normal @ np.linalg.solve(normal.sum(axis=0), gradient.sum(axis=0))
        count, size = len(self.scores), len(self.mean)
        if size == 3:
            last_first = np.ix_([3, 0, 1, 2], [3, 0, 1, 2])
            own = np.stack([s.moments[last_first] for s in self.scores])
            return BlockScores(np.zeros((count, 0, 4)), own, along_, normal)
        moments = np.empty((count, size + 1, size + 1))
        moments[:, :size, :size] = np.stack(self.square)
        moments[:, size, :size] = moments[:, :size, size] = np.stack(self.total)
        moments[:, size, size] = [s.samples for s in self.scores]
        outputs = np.column_stack([self.axes, self.mean])
        one = np.zeros((1, size + 1))
        one[0, size] = 1.0
        field_ = scalar.matrix @ (plane.basis.T @ outputs - np.outer(scalar.offset, one))
        residual = complement(plane).T @ (outputs - np.outer(plane.mean, one))
        z = np.vstack([one, field_])
        return BlockScores(residual @ moments @ z.T, z @ moments @ z.T, along_, normal)


def complement(plane: CommonField) -> Array:
    """(3 S, 3 S - 3) orthonormal, perpendicular to the plane."""
    out: Array = np.linalg.qr(plane.basis, mode="complete")[0][:, 3:]
    return out


def length_of(count: int) -> int:
    """Samples of a block of a recording: a power of two, so that pieces in which it is read hold whole blocks."""
    length = CHUNK
    while 4 * count < 3 * BLOCKS * length:
        length //= 2
    while 2 * count > 3 * BLOCKS * length:
        length *= 2
    return length


def blocks_of(plane: CommonField, scalar: ScalarFit, raw: Array, total_field: Array, reference_noise: float) -> Blocks:
    """The blocks of samples raw (N, S, 3), total_field (N,) that are all used, none longer than `CHUNK`."""
    found, flat = Blocks.of(plane), raw.reshape(len(raw), -1)
    many = max(min(BLOCKS, len(raw) // LEAST_PER_BLOCK), -(-len(raw) // CHUNK), 1)
    edges = np.linspace(0, len(raw), many + 1).round().astype(int)
    together = max(CHUNK * many // (len(raw) + many), 1)
    for number in range(0, many, together):
        own = edges[number : number + together + 1]
        part = slice(int(own[0]), int(own[-1]))
        z = found.turn @ flat[part].T - found.centre[:, None]
        seen = along(scalar.matrix, scalar.offset - found.centre[:3], z[:3], total_field[part], reference_noise)
        found.add(number, (own - own[0]).tolist(), z, seen, total_field[part])
    return found
