"""Long series made short enough to draw, without losing what the eye must see: spikes, gaps, and slopes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array

COLUMNS = 600  # about what a page resolves
CELLS = 48  # across a hemisphere: some 2 deg at its pole
GAP = 5.0  # sampling intervals after which a line is broken


@dataclass(frozen=True)
class Envelope:
    """A series as columns: what the values reach in each, and their mean.

    Attributes:
        time: (C,) middle of each column's samples; low, high, mean: (C,), NaN where a column is empty, between
            stretches of data.
        samples: how many finite values the series has.
    """

    time: Array
    low: Array
    high: Array
    mean: Array
    samples: int

    @property
    def zigzag(self) -> tuple[Array, Array]:
        """(2 C,) points of a line that touches both ends of every column."""
        return np.repeat(self.time, 2), np.column_stack([self.low, self.high]).ravel()


def envelope(time: Array, values: Array, columns: int = COLUMNS) -> Envelope:
    """A series (N,) over time (N,) s, increasing, in at most some 2 `columns` columns; NaN values are left out."""
    known = np.isfinite(values) & np.isfinite(time)
    t, v = time[known], values[known]
    if t.size == 0:
        empty = np.empty(0)
        return Envelope(empty, empty, empty, empty, 0)
    starts = column_starts(t, columns)
    counts = np.diff(np.append(starts, len(t)))
    middle = np.add.reduceat(t, starts) / counts
    low, high = np.minimum.reduceat(v, starts), np.maximum.reduceat(v, starts)
    mean = np.add.reduceat(v, starts) / counts
    breaks = _breaks(t, starts)
    low, high, mean = (np.insert(r, breaks, np.nan) for r in (low, high, mean))
    return Envelope(np.insert(middle, breaks, middle[breaks - 1]), low, high, mean, int(t.size))


def column_starts(time: Array, columns: int) -> np.ndarray:
    """Index of the first sample of each column: equal slices of time, or each sample its own where there are few."""
    if len(time) <= 2 * columns:
        return np.arange(len(time))
    span = time[-1] - time[0]
    slot = np.minimum(((time - time[0]) / span * columns).astype(np.int64), columns - 1)
    return np.flatnonzero(np.diff(slot, prepend=-1))


def _breaks(time: Array, starts: np.ndarray) -> np.ndarray:
    """Columns (indices into `starts`) before which a gap lies."""
    if len(time) < 2:
        return np.empty(0, dtype=np.int64)
    step = np.diff(time)
    before = starts[1:]
    return 1 + np.flatnonzero(step[before - 1] > GAP * np.median(step))


def stretches(time: Array, known: np.ndarray) -> list[slice]:
    """Runs of consecutive samples in use without a gap in time.

    Args:
        time: (N,) s.
        known: (N,) True where a value may be used.
    """
    if not known.any():
        return []
    step = np.diff(time)
    usual = np.median(step) if step.size else 0.0
    joined = known[1:] & known[:-1] & (step < 1.5 * usual)
    first = known & ~np.concatenate(([False], joined))
    last = known & ~np.concatenate((joined, [False]))
    return [slice(a, b + 1) for a, b in zip(np.flatnonzero(first), np.flatnonzero(last), strict=True)]


@dataclass(frozen=True)
class Spectrum:
    """One-sided amplitude spectral density.

    Attributes:
        frequency: (K,) Hz, without zero; density: (K,) nT/sqrt(Hz).
        averaged: how many half-overlapping pieces went into it.
    """

    frequency: Array
    density: Array
    averaged: int


LEAST_PIECE = 16  # samples: a spectrum of fewer shows nothing


def spectrum(time: Array, values: Array) -> Spectrum | None:
    """Welch's spectrum over the gap-free stretches of a series (N,), pieces of one length weighted alike.

    Returns:
        None where no stretch of `LEAST_PIECE` samples is in use.
    """
    from matplotlib.mlab import psd  # drawn with it anyway; scipy.signal takes a second to load

    runs = stretches(time, np.isfinite(values) & np.isfinite(time))
    lengths = np.array([r.stop - r.start for r in runs])
    if not lengths.size or lengths.max() < LEAST_PIECE:
        return None
    # as long as half of the samples allow, and short enough that at least some pieces are averaged
    ordered = np.sort(lengths)[::-1]
    common = int(ordered[np.searchsorted(np.cumsum(ordered), 0.5 * ordered.sum())])
    piece = max(LEAST_PIECE, 1 << int(np.log2(max(min(common, int(ordered.sum()) // 8), LEAST_PIECE))))
    rate = 1.0 / float(np.median(np.diff(time)))
    power, averaged = np.zeros(piece // 2 + 1), 0
    frequency = np.empty(0)
    for run in runs:
        if run.stop - run.start < piece:
            continue
        pieces = 1 + (run.stop - run.start - piece) // (piece - piece // 2)
        found, at = psd(values[run], NFFT=piece, Fs=rate, noverlap=piece // 2, detrend="linear")
        frequency = np.asarray(at)
        power += pieces * found
        averaged += pieces
    return Spectrum(frequency[1:], np.sqrt(power[1:] / averaged), averaged)


def thinned(spectrum: Spectrum, per_decade: int = 60) -> Spectrum:
    """The same spectrum averaged (in power) into bins of equal width in log frequency; narrow lines stay visible."""
    f, d = spectrum.frequency, spectrum.density
    slot = np.floor(np.log10(f / f[0]) * per_decade).astype(np.int64)
    starts = np.flatnonzero(np.diff(slot, prepend=-1))
    counts = np.diff(np.append(starts, len(f)))
    return Spectrum(
        np.exp(np.add.reduceat(np.log(f), starts) / counts),
        np.sqrt(np.add.reduceat(d**2, starts) / counts),
        spectrum.averaged,
    )


def disc(direction: Array) -> Array:
    """Directions (N, 3) to (N, 2) in the unit disc of their hemisphere, equal areas staying equal (Lambert).

    The rim is the plane z = 0; x to the right and y up in both hemispheres, both seen from +z.
    """
    radius = np.sqrt(1.0 - np.clip(np.abs(direction[:, 2]), 0.0, 1.0))
    length = np.hypot(direction[:, 0], direction[:, 1])
    unit = np.divide(direction[:, :2], length[:, None], out=np.zeros_like(direction[:, :2]), where=length[:, None] > 0)
    return np.asarray(radius[:, None] * unit)


def cell_means(points: Array, values: Array, cells: int = CELLS) -> Array:
    """Means over square cells of the square around the unit disc.

    Args:
        points: (N, 2) in the disc, finite.
        values: (N,), NaN ignored.
        cells: across the disc.

    Returns:
        (cells, cells), first index along y; NaN where no value is known.
    """
    column, row = np.clip(((points + 1.0) * 0.5 * cells).astype(np.int64), 0, cells - 1).T
    known = np.isfinite(values)
    cell = (row * cells + column)[known]
    count = np.bincount(cell, minlength=cells**2)
    total = np.bincount(cell, values[known], minlength=cells**2)
    mean = np.divide(total, count, out=np.full(cells**2, np.nan), where=count > 0)
    return np.asarray(mean.reshape(cells, cells))


@dataclass(frozen=True)
class Trend:
    """Means of a series over slices of another.

    Attributes:
        centre: (K,); mean, error: (K,) mean and its standard error as if the samples were independent.
    """

    centre: Array
    mean: Array
    error: Array


def trend(abscissa: Array, values: Array, edges: Array, least: int = 5) -> Trend:
    """Means of `values` (N,) over the slices of `abscissa` (N,) between `edges`; slices with too few are left out."""
    known = np.isfinite(abscissa) & np.isfinite(values)
    slot = np.clip(np.digitize(abscissa[known], edges) - 1, 0, len(edges) - 2)
    v, bins = values[known], len(edges) - 1
    count = np.bincount(slot, minlength=bins)
    used = count >= least
    n = count[used]
    mean = np.bincount(slot, v, minlength=bins)[used] / n
    spread = np.bincount(slot, (v - _at(mean, used, slot)) ** 2, minlength=bins)[used] / np.maximum(n - 1, 1)
    return Trend(0.5 * (edges[1:] + edges[:-1])[used], mean, np.sqrt(spread / n))


def _at(means: Array, used: np.ndarray, slot: np.ndarray) -> Array:
    full = np.zeros(len(used))
    full[used] = means
    return np.asarray(full[slot])
