"""What follows a pause of the record is what an adopted model had come to by then, and no event.

A response that lags goes on while nothing is recorded, by steady change as far as anyone knows; what it was off by at
the end of the pause dies away with its lag, and an offset for a while stands for that.
"""

from __future__ import annotations

import itertools

from magtensor.loop.fitting.model import State
from magtensor.loop.searching.beginnings import beginning
from magtensor.loop.searching.contribution import moments

NEAR = 2.0  # samples before the pause
MEMORIES = 4.0  # lags after it, when 2 % are left


def left_by_a_pause(state: State, place: int) -> str:
    """The name of an adopted model whose memory of a pause one of the others may be, which lasts for a while, and lies
    within the pause and the time that it is remembered for; "" where there is none."""
    x, model = state.excitation, state.adopted[place]
    when = moments(model)
    if len(when) != 2:
        return ""
    for (_, stop), (start, _) in itertools.pairwise(x.runs()):
        begun, over = (float(x.elapsed[i]) for i in (stop - 1, start))
        for other in (a for i, a in enumerate(state.adopted) if i != place):
            found = beginning(other.component, other.settings)
            lag = 0.0 if found is None else float(other.settings.get(found[1].lag, 0.0))
            shared = set(model.sensors or x.sensors) & set(other.sensors or x.sensors)
            if shared and begun - NEAR * x.spacing <= when[0] and when[1] <= over + MEMORIES * lag:
                return other.name
    return ""
