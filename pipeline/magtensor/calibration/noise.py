"""The noise of the sensors, from the data themselves and not from a fit's residual."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array

MAD_TO_SIGMA = 1.482602218505602  # for a normal distribution
MAD_EFFICIENCY = 0.37  # of the median absolute deviation, beside the plain one, in normal noise
SERIAL = 35.0 / 18.0  # second differences overlap: 1 + 2 (2/3)^2 + 2 (1/6)^2, the sum of their squared correlations
LEAST_SHARE = 0.02  # of the noise variance of two sensors, that the quieter one is believed to have


def noise_std(b: Array, total_field: Array | None = None) -> Array:
    """White-noise standard deviation of each sensor and axis, from second differences in time.

    Between sensors that see one field the contrasts b_s - mean(b) hold no field, and second differences
    (divided by sqrt 6) hold nothing slower than a few samples: what remains is the noise at the highest
    frequencies. Slow (1/f) noise and every slow effect are left out by construction.

    Args:
        b: (N, S, 3) nT, calibrated to one frame, samples in order.
        total_field: (N,) nT, the reference. One sensor needs it: |b| - F gives the noise along the field, and the
            three axes are taken as equal. For two sensors it tells whose the noise of their only contrast is.

    Returns:
        (S, 3) nT; NaN where fewer than four samples, or nothing to compare with, leave it open. Of three sensors or
        more the axes differ as far as the samples show that they do: what chance makes of a few postures is drawn to
        the mean of each sensor, and the sensors to that of the array.
    """
    n, sensors, _ = b.shape
    if n < 4 or (sensors == 1 and total_field is None):
        return np.full((sensors, 3), np.nan)
    if sensors == 1:
        assert total_field is not None
        along = np.linalg.norm(b[:, 0], axis=1) - total_field
        return np.full((1, 3), second_difference_std(along[:, None])[0])
    if sensors == 2:  # the two contrasts are one and the same
        share = np.full(2, 0.5) if total_field is None else shares_of_two(b, total_field)
        return np.sqrt(share)[:, None] * second_difference_std(b[:, 0] - b[:, 1])
    contrasts = b - b.mean(axis=1, keepdims=True)
    variance = second_difference_std(contrasts.reshape(n, -1)).reshape(sensors, 3) ** 2
    # var(contrast_s) = (1 - 2/S) v_s + sum(v) / S^2 and sum over s gives sum(v) (1 - 1/S)
    total = variance.sum(axis=0) / (1.0 - 1.0 / sensors)
    own = (variance - total / sensors**2) / (1.0 - 2.0 / sensors)
    # a sensor much quieter than its neighbours may come out below zero by chance
    own = np.maximum(own, 0.01 * total / sensors)
    known = MAD_EFFICIENCY * (n - 2) / SERIAL * (1.0 - 2.0 / sensors) ** 2 / (1.0 - 1.0 / sensors) ** 2
    of_sensor = _drawn(own.mean(axis=1, keepdims=True), own.mean(), 3.0 * known)
    return np.sqrt(_drawn(own, of_sensor, known))


def _drawn(variance: Array, target: Array | float, freedom: float) -> Array:
    """Variances, each known from so many independent values, drawn to a target as far as they scatter by chance about
    it: the weight of positive-part empirical Bayes (Efron and Morris 1973)."""
    chance = 2.0 / freedom
    beyond = max(float(np.mean((variance / np.maximum(target, np.finfo(float).tiny) - 1.0) ** 2)) - chance, 0.0)
    out: Array = target + beyond / (beyond + chance) * (variance - target)
    return out


def shares_of_two(b: Array, total_field: Array) -> Array:
    """Which part of the noise variance of two sensors' contrast each of them has.

    The contrast itself does not tell. |b_s| - F does: the second differences of the two have the reference's noise in
    common, and nothing else.

    Args:
        b: (N, 2, 3) nT, calibrated, samples in order.
        total_field: (N,) nT.

    Returns:
        (2,) shares, of sum 1.
    """
    along = np.linalg.norm(b, axis=2) - total_field[:, None]
    each = second_difference_std(along) ** 2
    sums = second_difference_std(np.column_stack([along.sum(axis=1), along[:, 0] - along[:, 1]])) ** 2
    own = each - max((sums[0] - sums[1]) / 4.0, 0.0)
    if not own.sum() > 0:
        return np.full(2, 0.5)
    own = np.maximum(own, LEAST_SHARE * each.sum())
    shares: Array = own / own.sum()
    return shares


def second_difference_std(series: Array) -> Array:
    """Robust standard deviation of white noise in each column of (N, K)."""
    second = np.diff(series, n=2, axis=0) / np.sqrt(6.0)
    robust = MAD_TO_SIGMA * np.median(np.abs(second - np.median(second, axis=0)), axis=0)
    # coarse quantisation makes the median zero; the plain figure then says more
    return np.where(robust > 0, robust, second.std(axis=0))
