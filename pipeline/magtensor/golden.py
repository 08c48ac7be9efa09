"""The best value of a setting between two limits, by golden section."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

REFINEMENTS = 8


def golden(f: Callable[[float], float], low: float, high: float, best: float, steps: int = REFINEMENTS) -> float:
    """Where f is largest between two limits, by golden section; `best` if nothing exceeds f there."""
    ratio = (np.sqrt(5.0) - 1) / 2
    a, b = low, high
    c, d = b - ratio * (b - a), a + ratio * (b - a)
    fc, fd, known = f(c), f(d), f(best)
    for _ in range(steps):
        if fc > fd:
            b, d, fd = d, c, fc
            c = b - ratio * (b - a)
            fc = f(c)
        else:
            a, c, fc = c, d, fd
            d = a + ratio * (b - a)
            fd = f(d)
    value, top = (c, fc) if fc > fd else (d, fd)
    return float(value) if top > known else best
