"""A base station that is read too seldom, or was not read for a while: what is left is larger midway between its
readings than at them.

Nothing else knows when the station was read. Its own noise is largest at the readings, where no neighbour lessens it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array, Mask
from magtensor.in_a_row import in_a_row
from magtensor.loop.fitting.model import Record, State

ALPHA = 0.001
MOST_BLOCKS = 20
LEAST_BLOCKS = 12  # of fewer no signs are as unlikely as asked for
LEAST_PER_BLOCK = 30
POWERS = (0.5, 1.0, 2.0)  # of the profile: what is faster than the readings, a random walk, a curve that bends evenly
A_LITTLE = 2.0  # times the time between two readings, that others may be apart
NOTHING = 0.01  # of what is midway
FAR = 4.0  # times the rms of what others miss: no natural field moves as far meanwhile
LEAST_READINGS = 10  # as far apart, that tell how far it moves
EACH = 1.5  # samples to a reading: with fewer, few are far from one


@dataclass(frozen=True)
class SparseReadings:
    """What is left of |b| - F beside and between the readings of the base station.

    Attributes:
        step_s: between two readings; at, midway: nT rms; between: nT rms over all samples beyond what is at them.
    """

    step_s: float
    at: float
    midway: float
    between: float

    @property
    def words(self) -> str:
        """What they say."""
        at = f"{self.at:.3g} nT" if self.at > NOTHING * self.midway else "next to nothing"
        return (
            f"{self.midway:.3g} nT rms of |b| - F midway between the base station's readings, which are "
            f"{self.step_s:.4g} s apart, and {at} at them: it is read too seldom for a field that moves so fast"
        )


def sparse_readings(state: State, record: Record) -> SparseReadings | None:
    """What the place between two readings says of the residual's square; None where it says nothing."""
    from scipy.special import bdtrc, stdtr

    residual, station = state.residual, record.station
    if residual.along is None or station is None or len(residual.along) < LEAST_BLOCKS * LEAST_PER_BLOCK:
        return None
    blocks = min(len(residual.along) // LEAST_PER_BLOCK, MOST_BLOCKS)
    time = record.time[residual.samples]
    if station.step_s < EACH * float(np.median(np.diff(time))):
        return None
    share = station.between(time).share
    between = 4.0 * share * (1.0 - share)
    square = (residual.along / residual.reference_gain) ** 2
    growth = []
    for y, z in zip(np.array_split(square, blocks), np.array_split(between, blocks), strict=True):
        off = z - z.mean()
        growth.append(float(off @ y) / max(float(off @ off), 1e-300))
    mean, error = float(np.mean(growth)), float(np.std(growth, ddof=1)) / np.sqrt(blocks)
    p_mean = float(stdtr(blocks - 1, -mean / max(error, 1e-300)))
    p_signs = float(bdtrc(int(np.sum(np.array(growth) > 0)) - 1, blocks, 0.5))  # whatever comes in a single burst
    if mean <= 0 or 2.0 * min(p_mean, p_signs) > ALPHA:
        return None
    best = min((_level(square, between**power) for power in POWERS), key=lambda level: level[0])
    at, midway, beyond = np.sqrt(np.maximum(best[1:], 0.0))
    return SparseReadings(station.step_s, float(at), float(midway), float(beyond))


def _level(square: Array, profile: Array) -> tuple[float, float, float, float]:
    """What a profile between readings leaves of a square (N,), and the square at them, midway, and beyond what is at
    them."""
    columns = np.column_stack([np.ones_like(profile), profile])
    (base, slope), *_ = np.linalg.lstsq(columns, square, rcond=None)
    left = float(np.sum((square - base - slope * profile) ** 2))
    return left, float(base), float(base + slope), float(slope * profile.mean())


def between_readings(some: Mask, record: Record) -> bool:
    """Whether each run of some samples (N,) lies between two readings of the base station."""
    assert record.station is not None
    edges = in_a_row(some)
    number = record.station.between(record.time).number
    return bool((number[edges[:, 0]] == number[edges[:, 1] - 1]).all())


def as_far_as_unread(amount_nT: float, span_s: float, record: Record) -> bool:
    """Whether the total field may move by so much between two readings of the base station that are so far apart, as
    others tell, each from two that are so far apart or a little further, on either side of it."""
    assert record.station is not None and record.total_field is not None
    time = record.station.time
    field = np.interp(time, record.time, record.total_field)
    before = np.searchsorted(time, time - 0.5 * span_s, side="right") - 1
    after = np.searchsorted(time, time + 0.5 * span_s, side="left")
    inside = np.flatnonzero((before >= 0) & (after < len(time)) & (time >= record.time[0]) & (time <= record.time[-1]))
    before, after = before[inside], after[inside]
    share = (time[inside] - time[before]) / (time[after] - time[before])
    missed = field[inside] - (1.0 - share) * field[before] - share * field[after]
    missed = missed[time[after] - time[before] <= A_LITTLE * span_s]
    return len(missed) >= LEAST_READINGS and bool(amount_nT <= FAR * float(np.sqrt(np.mean(missed**2))))
