"""Samples that a fit doubts and that their neighbours bear out: an effect without a model, not a spike.

A strong effect that lasts (warming up, a thermoelectric current at switch-on) lies beyond all noise while it does.
Left out as disturbed it would take the evidence for itself along. A spike stands alone.

What differs from posture to posture (a gain that has jumped) has no neighbours like itself. It is no disturbance where
it lasts longer than a held-out fold: other folds can confirm it then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magtensor.calibration.joint import JointFit
from magtensor.calibration.joint_together import FALSE_REJECTION
from magtensor.calibration.types import Array, Mask
from magtensor.loop.residual import residual_of
from magtensor.loop.statistics import FOLDS

NEIGHBOURS = 5  # samples of a running median: what lasts for three of them is no spike


def borne_out(fit: JointFit, raw: Array, total_field: Array, reference_noise: float = 0.0) -> Mask:
    """(N,) the samples of a fit, and those it doubts that depart from their neighbours by no more than noise or lie in
    a stretch longer than a fold.

    Parameters
    ----------
    raw: (N, S, 3) nT and total_field: (N,) nT, those the fit was made from.
    """
    every = residual_of(replace(fit, keep=np.ones_like(fit.keep)), raw, total_field, reference_noise)
    given = [(every.freedom - 1, every.across), (1, every.along)]
    return borne_out_in(fit.keep, [(freedom, p.reshape(len(raw), -1)) for freedom, p in given if p is not None])


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
        apart = values - median_filter(values, size=(NEIGHBOURS, 1), mode="nearest")
        square = np.sum(apart**2, axis=1)
        limit = chdtri(freedom, FALSE_REJECTION / (count * len(parts))) / chdtri(freedom, 0.5)
        good &= square <= limit * np.median(square)
    out = keep | good
    doubtful = median_filter((~keep).astype(int), size=NEIGHBOURS, mode="nearest")
    edges = np.flatnonzero(np.diff(doubtful, prepend=0, append=0)).reshape(-1, 2)
    for first, end in edges:
        if end - first > count / FOLDS:
            out[first:end] = True
    return out
