"""Missing values of a field that several sensors see, filled from those that are there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array


def filled(values: Array, good: NDArray[np.bool_] | None = None) -> Array:
    """Calibrated fields (N, S, 3) nT with values where there are none, so that what is lost does not spoil a filter.

    A field that turns goes through a long gap on no straight line, but the other sensors see it too: what is missing
    is, on each axis, theirs, and by how much this sensor differs from each of them as the samples to either side of the
    gap have it. So it does not matter which of them are there from sample to sample. Where none is, each axis goes
    straight from one neighbour in time to the next, and is 0 where it has none at all.

    Parameters
    ----------
    good: (N,) samples that are asked first for the differences; all alike if None.
    """
    present = np.isfinite(values)
    if present.all():
        return values
    out = values.copy()
    for sensor, axis in np.argwhere(~present.all(axis=0)):
        missing = np.flatnonzero(~present[:, sensor, axis])
        out[missing, sensor, axis] = _as_others_see(values[:, :, axis], present[:, :, axis], sensor, missing, good)
    index = np.arange(len(out))
    known = np.isfinite(out)
    for sensor, axis in np.argwhere(~known.all(axis=0)):
        own, column = known[:, sensor, axis], out[:, sensor, axis]
        column[~own] = np.interp(index[~own], index[own], column[own]) if own.any() else 0.0
    return out


def _as_others_see(
    values: Array,
    present: NDArray[np.bool_],
    sensor: int,
    missing: NDArray[np.int_],
    good: NDArray[np.bool_] | None,
) -> Array:
    """One axis of a sensor at the samples (n,) where it is missing, from that of all sensors (N, S): the mean of what
    each of the others says; NaN where none is there."""
    total, count = np.zeros((2, len(missing)))
    for other in np.delete(np.arange(values.shape[1]), sensor):
        there = present[missing, other]
        both = present[:, sensor] & present[:, other]
        if good is not None and (both & good).any():
            both &= good
        at = _beside(missing, np.flatnonzero(both))
        apart = np.interp(missing, at, values[at, sensor] - values[at, other]) if len(at) else 0.0
        total += np.where(there, values[missing, other] + apart, 0.0)
        count += there
    return np.divide(total, count, out=np.full(len(missing), np.nan), where=count > 0)


def _beside(missing: NDArray[np.int_], known: NDArray[np.int_]) -> NDArray[np.int_]:
    """Of the known samples those next to a missing one, to either side."""
    after = np.searchsorted(known, missing)
    near = np.unique(np.concatenate([after - 1, after]))
    return known[near[(near >= 0) & (near < len(known))]]
