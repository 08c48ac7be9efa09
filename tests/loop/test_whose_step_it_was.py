"""An effect is that of the one sensor that makes all of it, also where the part common to all hardly shows."""

from __future__ import annotations

import numpy as np
import pytest
from loop_cases import linear_state, synthetic

from magtensor.loop.fitting.model import Fitting, State
from magtensor.loop.searching import adopting, by_hand, on_fewer_sensors
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


@pytest.mark.parametrize(("seen", "lost", "found"), [
    (1, 7.4, ("S2",)),  # p 0.007, which would be kept of what is seen altogether
    (1, 10.5, None),
    (3, 7.4, ("S2",)),
    (3, 11.5, None),  # nothing is hidden, and the others are significant
])  # fmt: skip
def test_one_sensor_may_lose_a_little_where_a_part_of_all_is_not_seen(
    seen: int, lost: float, found: tuple[str, ...] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three coefficients for the other sensor the survey shows so many; shared out, what is not seen is wrong on
    both."""
    record = synthetic(2, 600, sensors=2)
    state = linear_state(record)
    step = by_hand.candidate(Registry.load().find("error_model", "offset_drift"), {}, state, 30, ALPHA)
    state = adopting.on_all_sensors(record, state, step, Fitting())

    def without_others(_: State, __: int, sensors: tuple[str, ...]) -> tuple[int, int, float]:
        return 3, seen, lost if sensors == ("S2",) else 150.0

    monkeypatch.setattr(on_fewer_sensors, "_without_others", without_others)
    monkeypatch.setattr(on_fewer_sensors, "_spare", lambda *_: True)
    monkeypatch.setattr(on_fewer_sensors, "sensors_showing", lambda *_: None)
    assert on_fewer_sensors._needed(state, 0) == found
