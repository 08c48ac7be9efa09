"""Whether a survey has what an error model needs.

A need is the name of a channel (`acceleration`, `current_*`), a fact of the survey (`attitude`, `position`,
`total_field`, `rotation`, `gradient`, `waveform`), or several of these of which one will do (`acceleration|attitude`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from magtensor.components import Component
from magtensor.loop.excitation import Excitation
from magtensor.loop.settings import AnyChannel

LARGEST_TURN = 0.5  # rad between neighbouring samples above which rates of change mean nothing
ROUGHEST = 0.5  # second over first differences: noise alone gives 1.7, attitudes one by one 1.7, a smooth turn little


def _turns(x: Excitation) -> bool:
    """Whether the field turns, and slowly enough between the samples of a run for its rate to be known."""
    together = np.diff(x.run) == 0
    if not together.any():
        return False
    b = x.field[:, 0]
    first = np.diff(b, axis=0)
    thrice = together[1:] & together[:-1]
    if not thrice.any():
        return False
    change = float(np.mean(np.sum(first[together] ** 2, axis=1)))
    bend = float(np.mean(np.sum(np.diff(first, axis=0)[thrice] ** 2, axis=1)))
    typical = np.sqrt(change / np.mean(np.sum(b**2, axis=1)))
    return bool(bend < ROUGHEST**2 * change and typical < LARGEST_TURN)


FACTS: dict[str, Callable[[Excitation], bool]] = {
    "attitude": lambda x: x.attitude is not None,
    "position": lambda x: x.position is not None,
    "total_field": lambda x: x.total_field is not None,
    "rotation": _turns,
    "gradient": lambda x: not x.uniform,
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
