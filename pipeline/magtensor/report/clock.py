"""Times as the page shows them: since the first sample, in a unit that suits the length, and as UTC."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta

import numpy as np

from magtensor.calibration.types import Array


@dataclass(frozen=True)
class Clock:
    """The time axis of the page: since the first sample, in the unit that suits the length.

    Attributes:
        values: (N,) in `unit`.
        unit: "s", "min", "h" or "d".
        label: of the axis.
        origin: s, the first sample on the survey's own axis; scale: s per unit.
    """

    values: Array
    unit: str
    label: str
    origin: float
    scale: float


def clock(time: Array, units: str) -> Clock:
    """The time axis for samples at `time` (N,) s on the epoch that `units` names."""
    known = time[np.isfinite(time)]
    origin = float(known[0]) if known.size else 0.0
    span = float(known[-1] - origin) if known.size else 0.0
    unit, scale = next(((u, s) for u, s in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)) if span > 3 * s), ("s", 1.0))
    name = {"d": "days", "h": "hours", "min": "minutes", "s": "seconds"}[unit]
    return Clock((time - origin) / scale, unit, f"{name} since {instant(origin, units)}", origin, scale)


def instant(seconds: float, units: str) -> str:
    """A time on the survey's axis as UTC, or in seconds where the epoch is not known."""
    from magtensor.survey.times import split_since

    try:
        found = split_since(units)
        if found is not None:
            moment = found[1] + timedelta(seconds=round(seconds, 3))
            return f"{moment:%Y-%m-%d %H:%M:%S} UTC"
    except (ValueError, OverflowError):
        pass
    return f"the survey's {seconds:.6g} s"
