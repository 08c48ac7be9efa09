"""Whether what seems to have happened once is what a logged channel did: at each of its times the channel was switched.

A mode that an instrument is put into, a range, a stage of a heater: what follows it by a law of its own jumps whenever
it is switched, and every jump looks like an event. By chance the times of an event are hardly those of a channel that
is switched seldom; where no law of that is known that explains the event, it is none all the same.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.excitation import Excitation
from magtensor.loop.fitting.log_noise import white_noise
from magtensor.loop.fitting.model import Adopted, State
from magtensor.loop.searching.contribution import moments
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.rivals import overlaps

CHANCE = 0.01  # that the times of an event are those at which any of the channels was switched
A_SWITCH = 6.0  # standard deviations of the log's noise in a step
BESIDE = 1.5  # samples between the time of an event and that of a switch


def switched_with(model: Adopted, state: State) -> tuple[str, ...]:
    """The logged channels that were switched at every time of an event; none of a model that is of no event."""
    times, x = moments(model), state.excitation
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


def of_no_law(event: Candidate, channels: Sequence[str], candidates: Sequence[Candidate], state: State) -> str:
    """Why an event is not adopted at whose times channels were switched: no candidate that follows one of them predicts
    most of what it does, so that it is what a channel does by a law that has no name; "" where one does, or there are
    no such channels."""
    if not channels:
        return ""
    follows = [c for c in candidates if c.model.channels(state.excitation) & set(channels)]
    if any(overlaps(event, c, state) for c in follows):
        return ""
    names = " and ".join(channels)
    return f"{names} was switched at each of its times, by no law of which it is explained"


def _switches(values: Array, x: Excitation) -> Array:
    """Times at which a channel (N,) was switched, s after the survey's start: half way between two samples."""
    steps = np.abs(np.diff(values))
    least = max(A_SWITCH * np.sqrt(2.0) * float(white_noise(values, x.run)[0]), 1e-9 * float(np.ptp(values)))
    at = np.flatnonzero(steps > least)
    return np.asarray((x.elapsed[at] + x.elapsed[at + 1]) / 2.0)
