"""Whether what seems to have happened once is what a logged channel did: at each of its times the channel was switched.

A mode that an instrument is put into, a range, a stage of a heater: what follows it by a law of its own jumps whenever
it is switched, and every jump looks like an event. By chance the times of an event are hardly those of a channel that
is switched seldom; where no law of that is known that explains the event, it is none all the same.
"""

from __future__ import annotations

from collections.abc import Sequence

from magtensor.loop.fitting.model import Adopted, State
from magtensor.loop.remainder.switches import switched_at
from magtensor.loop.searching.contribution import moments
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.rivals import overlaps


def switched_with(model: Adopted, state: State) -> tuple[str, ...]:
    """The logged channels that were switched at every time of an event; none of a model that is of no event."""
    return switched_at(moments(model), state.excitation)


def of_no_law(event: Candidate, channels: Sequence[str], candidates: Sequence[Candidate], state: State) -> str:
    """Why an event is not adopted at whose times channels were switched: no candidate that follows one of them predicts
    most of what it does, so that it is what a channel does by a law that has no name; "" where one does, or there are
    no such channels."""
    if not channels:
        return ""
    follows = [c for c in candidates if c.model.channels(state.excitation) & set(channels)]
    if any(overlaps(event, c, state) for c in follows):
        return ""
    return f"each of its times is a switching of {' and '.join(channels)}, by no law of which it is explained"
