"""Outputs that come late: brought back to their time exactly, where a rate of change is right for short delays only."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.terms import Terms

DEGREE = 5  # of the spline through the samples; straight lines where there are too few


def cleared(
    raw: Array,
    time: Array,
    run: NDArray[np.int_],
    each: Sequence[Terms],
    theta: Sequence[Array],
    trusted: NDArray[np.bool_] | None = None,
) -> Array:
    """Outputs (N, S, 3) nT without what models do to them: first brought back to their time, for sampling comes last,
    then without what was added.

    Parameters
    ----------
    time: (N,) s; run: (N,) number of the contiguous run a sample belongs to.
    each: terms of the models; theta: their coefficients.
    trusted: (N,) samples between which others are interpolated; all if None.
    """
    outputs = raw.shape[1] * 3
    out, late = raw, np.zeros(0)
    for terms, coefficients in zip(each, theta, strict=True):
        own = terms.lateness(coefficients, outputs)
        late = late if own is None else own + (late if late.size else 0.0)
    if late.any():
        out = on_time(raw.reshape(len(raw), -1), time, run, late, trusted).reshape(raw.shape)
    for terms, coefficients in zip(each, theta, strict=True):
        if terms.delay is None:
            out = out - terms.contribution(coefficients, outputs).reshape(raw.shape)
    return out


def on_time(
    columns: Array, time: Array, run: NDArray[np.int_], late: Array, trusted: NDArray[np.bool_] | None = None
) -> Array:
    """Columns (N, K) that are late by (N, K) s as they would be on time: what is stamped t belongs to t - late.

    Each run by itself, by a spline of the fifth degree through its samples; beyond its ends along their slope. A sample
    that is not trusted, or missing, stays as it is.
    """
    out = columns.copy()
    usable = np.isfinite(columns)
    if trusted is not None:
        usable &= trusted[:, None]
    edges = [0, *(np.flatnonzero(np.diff(run)) + 1).tolist(), len(run)]
    for a, b in pairwise(edges):
        for k in np.flatnonzero(late[a:b].any(axis=0)):
            own = np.flatnonzero(usable[a:b, k]) + a
            if len(own) >= 2:
                out[own, k] = _seen_at(time[own], columns[own, k], time[own] + late[own, k])
    return out


def _seen_at(time: Array, values: Array, when: Array) -> Array:
    """A series at other times."""
    from scipy.interpolate import make_interp_spline

    spline = make_interp_spline(time, values, k=DEGREE if len(time) > DEGREE else 1)
    within = np.clip(when, time[0], time[-1])
    out: Array = spline(within)
    beyond = when != within
    if beyond.any():
        out[beyond] += spline(within[beyond], 1) * (when - within)[beyond]
    return out
