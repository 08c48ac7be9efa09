"""Recordings that are read in pieces, whole or in an even selection, wherever they are kept."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .types import Array, Mask

READ_AT_ONCE = 65536  # samples; with four sensors 6 MiB
BLOCK = 256  # consecutive samples of a selection: second differences in time show the noise


class Recording(Protocol):
    """Raw outputs and total field that can be read again and again, piece by piece.

    Attributes:
        count: samples; sensors: number of sensors.
        usable: (count,) samples that may enter a fit; None for all. The others are never looked at.
    """

    @property
    def count(self) -> int: ...

    @property
    def sensors(self) -> int: ...

    @property
    def usable(self) -> Mask | None: ...

    def read(self, start: int, stop: int) -> tuple[Array, Array]:
        """Raw outputs (n, S, 3) nT and total field (n,) nT of the samples from start to stop."""
        ...


@dataclass(frozen=True)
class InMemory:
    """A recording that is there already: raw (N, S, 3) nT, total_field (N,) nT."""

    raw: Array
    total_field: Array
    usable: Mask | None = None

    @property
    def count(self) -> int:
        return len(self.raw)

    @property
    def sensors(self) -> int:
        return int(self.raw.shape[1])

    def read(self, start: int, stop: int) -> tuple[Array, Array]:
        return self.raw[start:stop], self.total_field[start:stop]


def pieces(recording: Recording, at_once: int = READ_AT_ONCE) -> Iterator[tuple[slice, Array, Array]]:
    """The whole recording, piece after piece: where it is, raw outputs (n, S, 3) and total field (n,)."""
    for start in range(0, recording.count, at_once):
        stop = min(start + at_once, recording.count)
        raw, total_field = recording.read(start, stop)
        yield slice(start, stop), raw, total_field


def even_blocks(count: int, samples: int) -> NDArray[np.intp]:
    """Some `samples` of `count` in blocks of consecutive ones, the blocks spread evenly with a fixed jitter, so that
    no motion can keep step with them."""
    if samples >= count:
        return np.arange(count)
    blocks = max(samples // BLOCK, 1)
    room = max(count / blocks - BLOCK, 0.0)
    jitter = np.random.default_rng(0).uniform(size=blocks)
    starts = np.floor(np.arange(blocks) * (count / blocks) + jitter * room).astype(np.intp)
    chosen = (starts[:, None] + np.arange(BLOCK)).ravel()
    return chosen if room else np.unique(chosen)


def even_samples(count: int, samples: int) -> NDArray[np.intp]:
    """Some `samples` of `count`, spread evenly with a fixed jitter."""
    if samples >= count:
        return np.arange(count)
    jitter = np.random.default_rng(0).uniform(size=samples)
    return np.unique(np.floor((np.arange(samples) + jitter) * (count / samples)).astype(np.intp))


def selected(recording: Recording, index: NDArray[np.intp]) -> tuple[Array, Array]:
    """The samples of a sorted index, raw (n, S, 3) and total field (n,); runs of neighbours are read at once."""
    if isinstance(recording, InMemory):
        return recording.raw[index], recording.total_field[index]
    edges = np.flatnonzero(np.diff(index) != 1) + 1
    runs = [recording.read(int(run[0]), int(run[-1]) + 1) for run in np.split(index, edges)]
    return np.concatenate([raw for raw, _ in runs]), np.concatenate([field for _, field in runs])
