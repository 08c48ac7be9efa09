"""Events that came or went along one vector: something that switches."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.fitting.model import State
from magtensor.loop.searching.contribution import happens_once, moments

ALONG = 0.95  # cosine, with a source's vector or another event's; of one sensor 5 % of all directions are as near


def along_one_vector(state: State, fixed: int) -> tuple[list[int], list[str]] | None:
    """The places of several adopted events, not of the first ones, that lie along one vector, and the sensors that it
    moves; None where there are none."""
    known = events(state, fixed)
    for _, first in known:
        places = [i for i, v in known if is_along(v, first) or is_along(first, v)]
        if len(places) > 1:
            moved = zip(state.excitation.sensors, first.reshape(-1, 3), strict=True)
            return places, [s for s, v in moved if v.any()]
    return None


def switching_words(state: State, fixed: int) -> list[str]:
    """That they do, for who looks for one cause of them."""
    several = along_one_vector(state, fixed)
    if several is None:
        return []
    places, sensors = several
    dated = [f"{m.name} at {moments(m)[0]:.5g} s" for m in (state.adopted[place] for place in places)]
    return [f"{' and '.join(dated)} lie along one vector, as where one thing in {', '.join(sensors)} switches"]


def events(state: State, fixed: int) -> list[tuple[int, Array]]:
    """The places of the adopted events that have one series, and their vectors (3 S,) nT."""
    found = [(i, vector_of(state, i)) for i, a in enumerate(state.adopted) if i >= fixed and happens_once(a)]
    return [(i, v) for i, v in found if v is not None]


def vector_of(state: State, place: int) -> Array | None:
    """(3 S,) nT for a unit of the one series of an adopted model, by which it moves each output; None where it has
    several series."""
    terms = state.adopted[place].terms(state.excitation)
    if terms.series.shape[1] != 1 or terms.delay is not None:
        return None
    vector = np.zeros(3 * len(state.excitation.sensors))
    raw = terms.part_output >= 0
    np.add.at(vector, terms.part_output[raw], terms.part_weight[raw] * state.theta[place][terms.part_term[raw]])
    return vector if vector.any() else None


def is_along(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Whether a vector lies along another one, in the outputs that it moves."""
    seen = np.where(one != 0.0, other, 0.0)
    return abs(np.vdot(one, seen)) > ALONG * float(np.linalg.norm(one) * np.linalg.norm(seen))
