"""How many independent values a course in time amounts to."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array


def independent(course: Array) -> float:
    """Of a course (N,), as many as sines and cosines with as much power each would be; 0 of one that is constant.

    Between two courses of that spectrum, which have nothing to do with each other, the correlation has the variance of
    one of so many independent values (Bartlett, J. R. Stat. Soc. 98, 536, 1935).
    """
    from scipy.fft import rfft

    power = np.abs(rfft(course - course.mean())) ** 2
    return float(2.0 * power.sum() ** 2 / max(np.sum(power**2), 1e-300))
