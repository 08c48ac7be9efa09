"""An effect is that of the one sensor that makes all of it, also where the part common to all hardly shows."""

from __future__ import annotations

import numpy as np
from loop_cases import linear_state, synthetic

from magtensor.loop.fitting.model import Fitting
from magtensor.loop.searching import by_hand
from magtensor.loop.searching.adopting import adopt
from magtensor.loop.searching.gates import ALPHA
from magtensor.registry import Registry


def test_a_step_across_the_field_is_of_the_sensor_that_made_it() -> None:
    """Offsets along x, which the field is never nearer to than 86 degrees: what all four share shows by a tenth, so
    that none of their steps is significant by itself."""
    samples = 12000
    added = np.zeros((samples, 4, 3))
    added[samples // 2 :, 1, 0] = 3.0
    every = synthetic(1, samples, added=added)
    record = every.at(np.flatnonzero(np.abs(every.raw[:, 0, 0]) < 0.06 * 50000.0))
    state = linear_state(record)
    step = by_hand.candidate(Registry.load().find("error_model", "offset_step"), {}, state, 30, ALPHA)
    after = adopt(record, state, step, Fitting())
    assert after.adopted[0].sensors == ("S2",)
    assert abs(after.theta[0][0] - 3.0) < 0.4 and np.abs(after.theta[0][1:]).max() < 0.4
