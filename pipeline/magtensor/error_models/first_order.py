"""The exact response of a first-order lag, tau y' + y = x, to a series that is known at its samples, and back."""

from __future__ import annotations

import math

import numpy as np

from magtensor.calibration.types import Array

_SERIES_BELOW = 1.0  # sampling intervals in units of tau: below, the recurrence for the moments loses digits
_SERIES_TERMS = 20
_GAP = 3.0  # times the usual interval


def straight(time: Array, series: Array, tau: float) -> Array:
    """(N, ...) of a series that is straight between its samples, y starting at x[0]: of what may jump."""
    if len(time) < 2:
        return series
    step = np.diff(time)
    decays: Array = np.exp(-step / tau)
    ramps: Array = 1.0 - (1.0 - decays) * tau / step
    shape = (-1, *[1] * (series.ndim - 1))
    driven = ramps.reshape(shape) * series[1:] + (1.0 - decays - ramps).reshape(shape) * series[:-1]
    return _recursion(np.concatenate([[1.0], decays]), np.concatenate([series[:1], driven]))


def smooth(time: Array, series: Array, tau: float) -> Array:
    """(N, ...) of a cubic spline through four samples or more, y starting at x[0]: of what turns with the platform.

    Straight lines cut the corners of a turn: for half a radian from one sample to the next they lose 2 % of it.
    """
    from scipy.interpolate import CubicSpline

    return _to_cubics(time, series, CubicSpline(time, series).c, tau)


def rate(time: Array, series: Array, tau: float) -> Array:
    """(N, ...) how fast a series changes, 1/s, seen through a lag: (x - y) / tau; x' for a tau of 0.

    Between its samples the series is a cubic with the central differences for its slopes, across a gap it is straight:
    straight everywhere, it would be late by half an interval where tau is short.
    """
    if len(time) < 2:
        return np.zeros_like(series, dtype=float)
    slopes: Array = np.gradient(series, time, axis=0)
    if tau <= 0:
        return slopes
    from scipy.interpolate import CubicHermiteSpline

    step = np.diff(time)
    cubics = CubicHermiteSpline(time, series, slopes).c
    gaps = step > _GAP * np.median(step)
    cubics[:2, gaps] = 0.0
    cubics[2, gaps] = (np.diff(series, axis=0) / step.reshape(-1, *[1] * (series.ndim - 1)))[gaps]
    found: Array = (series - _to_cubics(time, series, cubics, tau)) / tau
    return found


def undone(time: Array, series: Array, tau: float) -> Array:
    """(N, ...) x of which a series y is the response: y + tau y', of what changes slowly from sample to sample."""
    if len(time) < 2:
        return series
    found: Array = series + tau * np.gradient(series, time, axis=0)
    return found


def ahead(time: Array, series: Array, lead: float) -> Array:
    """(N, ...) a series so much earlier, s, which beyond its end goes on straight."""
    if len(time) < 2:
        return series
    flat = series.reshape(len(time), -1)
    beyond = np.maximum(time + lead - time[-1], 0.0)
    slopes = (flat[-1] - flat[-2]) / (time[-1] - time[-2])
    moved = np.column_stack([np.interp(time + lead, time, column) for column in flat.T]) + np.outer(beyond, slopes)
    return moved.reshape(series.shape)


def _to_cubics(time: Array, series: Array, coefficients: Array, tau: float) -> Array:
    """(N, ...) the response to a piecewise cubic (4, N - 1, ...) of falling powers, y starting at x[0]."""
    step = np.diff(time)
    weights = _moments(step / tau) * step ** np.arange(4)[:, None]
    driven = sum(w.reshape(-1, *[1] * (series.ndim - 1)) * c for w, c in zip(weights, coefficients[::-1], strict=True))
    return _recursion(np.concatenate([[1.0], np.exp(-step / tau)]), np.concatenate([series[:1], driven]))


def _moments(a: Array) -> Array:
    """(4, N) a times the integral of exp(-a (1 - u)) u^m over u from 0 to 1, for m from 0 to 3.

    By parts each follows from the one before, 1 - m / a times it; where a is small that cancels, and the exponential's
    own series is summed.
    """
    found = np.empty((4, len(a)))
    found[0] = -np.expm1(-a)
    for m in range(1, 4):
        found[m] = 1.0 - m / a * found[m - 1]
    small = a < _SERIES_BELOW
    for m in range(4):
        terms = [math.factorial(m) / math.factorial(m + j + 1) for j in range(_SERIES_TERMS)]
        found[m, small] = a[small] * np.polynomial.polynomial.polyval(-a[small], terms)
    return found


def _recursion(decay: Array, drive: Array) -> Array:
    """y[k] = decay[k] y[k - 1] + drive[k] from y = drive[0], in about 2 sqrt(N) steps: affine maps compose."""
    n = len(decay)
    length = max(1, int(np.sqrt(n)))
    blocks = -(-n // length)
    factor = np.ones(blocks * length)
    value = np.zeros((blocks * length, *drive.shape[1:]))
    factor[1:n], value[:n] = decay[1:], drive
    factors, values = factor.reshape(blocks, length), value.reshape(blocks, length, -1)
    for i in range(1, length):
        values[:, i] += factors[:, i, None] * values[:, i - 1]
        factors[:, i] *= factors[:, i - 1]
    carry = np.zeros(values.shape[2])
    for block in range(blocks):
        values[block] += factors[block, :, None] * carry
        carry = values[block, -1].copy()
    out: Array = values.reshape(blocks * length, *drive.shape[1:])[:n]
    return out
