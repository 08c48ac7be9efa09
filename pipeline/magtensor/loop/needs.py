"""Whether a survey has what an error model needs.

A need is the name of a channel (`acceleration`, `current_*`), a fact of the survey (`attitude`, `position`,
`total_field`, `rotation`, `gradient`, `travel`, `waveform`), or several of these of which one will do
(`acceleration|attitude`). A gradient is that of the field which an array travels through, or of the calibration site,
known once an error model of the site is adopted.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from magtensor.components import Component
from magtensor.loop.excitation import SPLINED, Excitation, derivative_of
from magtensor.loop.settings import AnyChannel

LARGEST_TURN = 0.5  # rad between neighbouring samples above which rates of change mean nothing
LEAST_IN_A_RUN = 2 * SPLINED - 1  # samples that show a rate of change, and every second of them whether it is right
WORST_RATE = 0.5  # of the rate of change, moved by leaving out every second sample; with all of them the error of a
# difference formula is then some tenths of that, where the attitudes are unrelated all of it and more


def _turns(x: Excitation) -> bool:
    """Whether the field turns, and slowly enough between the samples of a run for its rate to be known."""
    b = x.field[:, 0]
    together = np.diff(x.run) == 0
    long_runs = [(i, j) for i, j in x.runs() if j - i >= LEAST_IN_A_RUN]
    if not long_runs or not together.any():
        return False
    change = np.diff(b, axis=0)[together]
    typical = np.sqrt(np.mean(np.sum(change**2, axis=1)) / np.mean(np.sum(b**2, axis=1)))
    rates = [(derivative_of(x.time[i:j], b[i:j])[::2], derivative_of(x.time[i:j:2], b[i:j:2])) for i, j in long_runs]
    every, half = (np.concatenate(each) for each in zip(*rates, strict=True))
    moved = np.sqrt(np.sum((every - half) ** 2) / max(float(np.sum(every**2)), 1e-300))
    return bool(moved < WORST_RATE and typical < LARGEST_TURN)


FACTS: dict[str, Callable[[Excitation], bool]] = {
    "attitude": lambda x: x.attitude is not None,
    "position": lambda x: x.position is not None,
    "total_field": lambda x: x.total_field is not None,
    "rotation": _turns,
    "gradient": lambda x: x.site is not None or not x.uniform,
    "travel": lambda x: not x.uniform,
    "waveform": lambda x: x.waveform is not None,
}


def missing(component: Component, x: Excitation) -> list[str]:
    """The needs of an error model that a survey does not meet, as the model words them."""
    notes = [m for p in component.parameters.values() for m in getattr(p.annotation, "__metadata__", ())]
    markers = [m for m in notes if isinstance(m, AnyChannel)]

    def met(need: str) -> bool:
        if need in FACTS:
            return FACTS[need](x)
        return bool(x.channels_like(need)) or any(m.pattern == need and m.values(x) for m in markers)

    declares = component.declared({})
    return [need for need in declares.needs if not any(met(option) for option in need.split("|"))]
