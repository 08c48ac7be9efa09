"""Logged channels that were switched at certain times: a pump, a range, a mode that an instrument is put into."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.excitation import Excitation
from magtensor.loop.fitting.log_noise import white_noise

CHANCE = 0.01  # that so many times are those at which any of the channels was switched
A_SWITCH = 6.0  # standard deviations of the log's noise in a step
BESIDE = 1.5  # samples between a time and that of a switch


def switched_at(times: Sequence[float], x: Excitation) -> tuple[str, ...]:
    """The logged channels that were switched at every one of some times, s after the survey's start, and seldom else;
    none where there are no times."""
    single = {name: values for name, values in x.logged.items() if values.ndim == 1}
    if not times or not single:
        return ()
    beside = BESIDE * float(np.median(np.diff(x.elapsed)))
    found = []
    for name, values in sorted(single.items()):
        switches = _switches(values, x)
        share = 2.0 * beside * len(switches) / max(x.duration, beside)
        if len(switches) == 0 or share ** len(times) * len(single) > CHANCE:
            continue
        if all(float(np.min(np.abs(switches - time))) <= beside for time in times):
            found.append(name)
    return tuple(found)


def _switches(values: Array, x: Excitation) -> Array:
    """Times at which a channel (N,) was switched, s after the survey's start: half way between two samples."""
    steps = np.abs(np.diff(values))
    least = max(A_SWITCH * np.sqrt(2.0) * float(white_noise(values, x.run)[0]), 1e-9 * float(np.ptp(values)))
    at = np.flatnonzero(steps > least)
    return np.asarray((x.elapsed[at] + x.elapsed[at + 1]) / 2.0)
