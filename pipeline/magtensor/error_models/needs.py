"""Whether a survey has what an error model needs.

A need is the name of a channel (`acceleration`, `current_*`), a fact of the survey (`attitude`, `position`,
`total_field`, `base_station`, `turning`, `rotation`, `gradient`, `travel`, `waveform`), or several of these of which
one will do (`acceleration|attitude`). A base station has a total field that was measured: a constant has none, and errs
in no way that a station does. On a platform that stands still, memory of the field would be of the station's noise. A
gradient is that of the field which an array travels through, or of the calibration site, known once an error model of
the site is adopted.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel

CONSTANT = 1e-9  # of the total field: what interpolation makes of one
STILL = 0.01  # rad: the variation of the field turns it by a tenth of that, and by this in a great storm


def measured(total_field: Array) -> bool:
    """Whether a total field (N,) nT is more than a constant."""
    return bool(np.ptp(total_field) >= CONSTANT * np.mean(total_field))


FACTS: dict[str, Callable[[Excitation], bool]] = {
    "attitude": lambda x: x.attitude is not None,
    "position": lambda x: x.position is not None,
    "total_field": lambda x: x.total_field is not None,
    "base_station": lambda x: x.total_field is not None and measured(x.total_field),
    "turning": lambda x: x.swept > STILL,
    "rotation": lambda x: x.turns,
    "gradient": lambda x: x.site is not None or not x.uniform,
    "travel": lambda x: not x.uniform,
    "waveform": lambda x: x.waveform is not None,
}


IN_WORDS = {
    "base_station": "a total field that was measured, and is no mere constant",
    "turning": "a field that turns in the platform, by more than it varies by itself",
    "rotation": "a field that turns, so slowly between samples that its rate of change is known",
    "gradient": "a field that differs between the sensors",
    "travel": "a field that changes along the way",
}


def in_words(need: str) -> str:
    """A need as one says it to somebody who has not read the error model."""
    return " or ".join(IN_WORDS.get(option, option) for option in need.split("|"))


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
