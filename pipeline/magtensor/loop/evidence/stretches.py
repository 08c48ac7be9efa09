"""Samples that a fit doubts and that their neighbours bear out: an effect without a model, not a spike.

A strong effect that lasts (warming up, a thermoelectric current at switch-on) lies beyond all noise while it does.
Left out as disturbed it would take the evidence for itself along. A spike stands alone.

What differs from posture to posture (a gain that has jumped) has no neighbours like itself. It is no disturbance where
it lasts longer than a held-out fold: other folds can confirm it then.

Noise that is louder for a while is no disturbance either. Where it is so loud that all samples together, each counting
alike, tell less than the quiet ones alone, the calibration does without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magtensor.calibration.joint import JointFit
from magtensor.calibration.joint_together import ABOUT, FALSE_REJECTION, MOSTLY, among_their_like
from magtensor.calibration.types import Array, Mask
from magtensor.in_a_row import in_a_row
from magtensor.loop.evidence.folds import FOLDS
from magtensor.loop.evidence.residual import residual_of

NEIGHBOURS = 5  # samples of a running median: what lasts for three of them is no spike
LEAST_LOUD = 50  # samples: of fewer nobody knows how loud they are
LIMITS = 40  # of the loudness, tried
WORTH_IT = 0.5  # of the variance of a calibration from all samples is left, where some are left out for it


def borne_out(fit: JointFit, raw: Array, total_field: Array, reference_noise: float = 0.0) -> Mask:
    """(N,) the samples of a fit, and those it doubts that depart from their neighbours by no more than noise or lie in
    a stretch longer than a fold.

    Parameters
    ----------
    raw: (N, S, 3) nT and total_field: (N,) nT, those the fit was made from.
    """
    return borne_out_in(fit.keep, _parts(fit, raw, total_field, reference_noise))


def louder(fit: JointFit, raw: Array, total_field: Array, reference_noise: float = 0.0) -> Mask:
    """(N,) the samples of a fit, and those it doubts where the noise is louder and is all that they have.

    The parameters are those of `borne_out`.
    """
    return louder_in(fit.keep, _parts(fit, raw, total_field, reference_noise))


def too_loud(
    fit: JointFit, raw: Array, total_field: Array, effects: Sequence[Array], reference_noise: float = 0.0
) -> Mask:
    """(N,) the samples that a calibration is better without: the noise of most sensors is louder there for a while, by
    so much that C and o from the others alone have at most `WORTH_IT` of the variance, and no effect a larger one.

    Parameters
    ----------
    effects: (N, S, 3) nT, what each of the adopted ones has added; the others as for `borne_out`.
    """
    every = residual_of(replace(fit, keep=np.ones_like(fit.keep)), raw, total_field, reference_noise)
    if every.across is None:
        return np.zeros(len(raw), dtype=bool)
    return too_loud_in(every.across, every.affine, [np.sum(e**2, axis=(1, 2)) for e in effects])


def too_loud_in(values: Array, affine: Array, effects: Sequence[Array] = ()) -> Mask:
    """The same of residuals (N, 3 S) across the plane that the sensors share, where the freedom of a fit in each output
    is affine (N, A).

    With variances v of the samples, which count alike, and M the sum of z z' over those that are used, what is fitted
    has the covariance M^-1 (sum v z z') M^-1. Judged is the variance that it gives at the attitudes of all samples,
    without those that are louder than some.

    Parameters
    ----------
    effects: (N,) squares of what each effect does at a sample.
    """
    from scipy.ndimage import median_filter

    out = np.zeros(len(values), dtype=bool)
    if len(values) < 4 * LEAST_LOUD:
        return out
    rough = np.diff(values, axis=0, prepend=values[:1]) ** 2
    rough[0] = rough[1]
    each = median_filter(rough.reshape(len(rough), -1, 3).sum(axis=2), size=(ABOUT, 1), mode="mirror")
    level = np.median(each / np.maximum(np.median(each, axis=0), 1e-300), axis=1)
    basis = np.linalg.qr(affine)[0]

    def variance(used: Mask) -> float:
        z = basis[used]
        try:
            made = np.linalg.inv(z.T @ z)
        except np.linalg.LinAlgError:
            return np.inf
        return float(np.trace(made @ (z.T * level[used]) @ z @ made))

    limits = np.quantile(level, np.arange(1, LIMITS + 1) / LIMITS)
    found = [variance(level <= limit) for limit in limits]
    best = int(np.argmin(found))
    if not found[best] <= WORTH_IT * found[-1]:
        return out
    loud = median_filter((level > limits[best]).astype(int), size=ABOUT, mode="nearest")
    for first, end in in_a_row(loud):
        out[first:end] = end - first >= LEAST_LOUD
    for square in effects:
        if level[~out] @ square[~out] * square.sum() ** 2 > level @ square * square[~out].sum() ** 2:
            return np.zeros_like(out)
    return out


def louder_in(keep: Mask, parts: Sequence[tuple[int, Array]]) -> Mask:
    """The same of a fit that keeps some of its samples (N,); the parameters are those of `borne_out_in`.

    Noise is what differs from one sample to the next. A spike's neighbours have no more of it than others, and what
    passes by is smooth: neither is taken for noise. What is wrong for a while comes near what is right now and then: of
    a stretch of which the fit doubts most, most is louder or nothing is believed.
    """
    from scipy.ndimage import median_filter
    from scipy.special import chdtri

    count = len(keep)
    good = np.ones(count, dtype=bool)
    for freedom, values in parts:
        rough = np.diff(values, axis=0, prepend=values[:1]) / np.sqrt(2.0)
        own, its = np.sum(values**2, axis=1), np.sum(rough**2, axis=1)
        level = median_filter(its, size=ABOUT, mode="mirror")
        limit = chdtri(freedom, FALSE_REJECTION / (count * len(parts))) / chdtri(freedom, 0.5)
        good &= own <= limit * np.maximum(level, np.median(its))
    out = keep | good
    for first, end in in_a_row(among_their_like(~keep)):
        if end - first > ABOUT and np.mean(out[first:end]) < MOSTLY:
            out[first:end] = False
    return out


def _parts(fit: JointFit, raw: Array, total_field: Array, reference_noise: float) -> list[tuple[int, Array]]:
    """How many independent values a sample has across and along, and the whitened residuals (N, Q) of all samples."""
    every = residual_of(replace(fit, keep=np.ones_like(fit.keep)), raw, total_field, reference_noise)
    given = [(every.freedom - 1, every.across), (1, every.along)]
    return [(freedom, p.reshape(len(raw), -1)) for freedom, p in given if p is not None]


def borne_out_in(keep: Mask, parts: Sequence[tuple[int, Array]]) -> Mask:
    """The same of a fit that keeps some of its samples (N,).

    Parameters
    ----------
    parts: whitened residuals (N, Q) of all samples, and how many independent values a sample has in each.
    """
    from scipy.ndimage import median_filter
    from scipy.special import chdtri

    count = len(keep)
    good = np.ones(count, dtype=bool)
    for freedom, values in parts:
        about = median_filter(values, size=(NEIGHBOURS, 1), mode="nearest")
        end = NEIGHBOURS // 2  # the first and the last have neighbours on one side: what is alone there has none either
        about[:end], about[-end:] = about[end], about[-end - 1]
        apart = values - about
        square = np.sum(apart**2, axis=1)
        limit = chdtri(freedom, FALSE_REJECTION / (count * len(parts))) / chdtri(freedom, 0.5)
        good &= square <= limit * np.median(square)
    out = keep | good
    doubtful = median_filter((~keep).astype(np.uint8), size=NEIGHBOURS, mode="nearest")
    for first, end in in_a_row(doubtful):
        if end - first > count / FOLDS:
            out[first:end] = True
    return out
