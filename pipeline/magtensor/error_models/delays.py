"""Outputs that come late: brought back to their time exactly, where a rate of change is right for short delays only."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.error_models.terms import Terms

DEGREE = 5  # of the spline through the samples; straight lines where there are too few
REACH = 0.5  # of the time between samples: so far beyond an end the spline still knows the field


def cleared(
    raw: Array,
    time: Array,
    run: NDArray[np.int_],
    each: Sequence[Terms],
    theta: Sequence[Array],
) -> Array:
    """Outputs (N, S, 3) nT without what models do to them: first brought back to their time, for sampling comes last,
    then without what was added.

    Parameters
    ----------
    time: (N,) s; run: (N,) number of the contiguous run a sample belongs to.
    each: terms of the models; theta: their coefficients.
    """
    outputs = raw.shape[1] * 3
    late, out = lateness(each, theta, outputs), raw
    if late is not None:
        out = on_time(raw.reshape(len(raw), -1), time, run, late).reshape(raw.shape)
    for terms, coefficients in zip(each, theta, strict=True):
        if terms.delay is None:
            out = out - terms.contribution(coefficients, outputs).reshape(raw.shape)
    return out


def lateness(each: Sequence[Terms], theta: Sequence[Array], outputs: int) -> Array | None:
    """(N, outputs) s by which models make the outputs late; None if none does."""
    own = [terms.lateness(coefficients, outputs) for terms, coefficients in zip(each, theta, strict=True)]
    delays = [late for late in own if late is not None]
    return sum(delays[1:], delays[0]) if delays else None


def on_time(
    columns: Array, time: Array, run: NDArray[np.int_], late: Array, trusted: NDArray[np.bool_] | None = None
) -> Array:
    """Columns (N, K) that are late by (N, K) s as they would be on time: what is stamped t belongs to t - late.

    Each run by itself, by a spline of the fifth degree through its samples. Half a sample beyond its ends nobody has
    seen the outputs: there they follow their slope. A sample (N,), or a value (N, K) of one, that is not trusted, or
    missing, stays as it is, and the others are not interpolated from it.
    """
    out = columns.copy()
    usable = np.isfinite(columns)
    if trusted is not None:
        usable &= trusted.reshape(len(trusted), -1)
    for a, b in contiguous(run):
        for k in np.flatnonzero(late[a:b].any(axis=0)):
            own = np.flatnonzero(usable[a:b, k]) + a
            if len(own) >= 2:
                out[own, k] = _seen_at(time[own], columns[own, k], time[own] + late[own, k])
    return out


def unseen(time: Array, run: NDArray[np.int_], late: Array) -> NDArray[np.bool_]:
    """(N, K) whether what belongs to a sample's time was recorded after its run had ended, or before it began."""
    out = np.zeros(late.shape, dtype=bool)
    for a, b in contiguous(run):
        reach = REACH * float(np.median(np.diff(time[a:b]))) if b - a > 1 else 0.0
        when = time[a:b, None] + late[a:b]
        out[a:b] = (when < time[a] - reach) | (when > time[b - 1] + reach)
    return out


def contiguous(run: NDArray[np.int_]) -> list[tuple[int, int]]:
    """(first, one past last) sample of each contiguous run."""
    bounds = [0, *(np.flatnonzero(np.diff(run)) + 1).tolist(), len(run)]
    return list(pairwise(bounds))


def _seen_at(time: Array, values: Array, when: Array) -> Array:
    """A series at other times."""
    from scipy.interpolate import make_interp_spline

    spline = make_interp_spline(time, values, k=DEGREE if len(time) > DEGREE else 1)
    reach = REACH * float(np.median(np.diff(time)))
    within = np.clip(when, time[0] - reach, time[-1] + reach)
    out: Array = spline(within)
    beyond = when != within
    if beyond.any():
        out[beyond] += spline(within[beyond], 1) * (when - within)[beyond]
    return out
