"""How unlikely it is that something would explain as much at another time as it does at its own.

Where the law of the noise is not known, the survey itself is: a course that is moved along it, and back from its end
again, would explain as much of any noise that goes on as it does where it is. What it explains of the residual without
itself, at as many times, is the scale by which it is judged (a test against placebos in time).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.terms import Terms

TIMES = 32


def as_at_other_times(
    explained: float, rank: int, elsewhere: Callable[[Terms], tuple[float, int, float]], terms: Terms
) -> float:
    """Probability that terms, which explain so much for each of `rank` directions, do so by chance.

    Parameters
    ----------
    elsewhere: what terms explain of the residual without these, in how many directions and from how many values the
        scale of that is known.
    terms: (N samples) of series that are added to the axes.
    """
    from scipy.special import fdtrc

    beside = [elsewhere(replace(terms, series=moved(terms.series, k / TIMES))) for k in range(1, TIMES)]
    each = [found / count for found, count, _ in beside if count]
    if not each:
        return 1.0
    return float(fdtrc(rank, rank * len(each), explained / max(float(np.mean(each)), 1.0)))


def moved(series: Array, share: float) -> Array:
    """Series (N, K) later by a share of twice their length; what goes beyond the end comes back from there."""
    there_and_back = np.concatenate([series, series[::-1]])
    return np.roll(there_and_back, round(share * len(there_and_back)), axis=0)[: len(series)]
