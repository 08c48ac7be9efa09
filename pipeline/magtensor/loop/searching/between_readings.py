"""Something that happened once to |b| - F between two readings of the base station, where nobody saw the field.

A field that moves as it does elsewhere makes as much of it: how much, the readings tell that are as far apart.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magtensor.loop.evidence.residual import taken_off
from magtensor.loop.fitting.model import Record, State
from magtensor.loop.remainder.sparse_readings import as_far_as_unread
from magtensor.loop.searching.contribution import happens_once

MOSTLY = 0.5  # of its power is gone where the readings show it
BETWEEN = "fitted, it acts between readings of the base station: a field that moves as elsewhere would look the same"


def between_readings(record: Record, state: State, place: int) -> bool:
    """Whether one of the adopted models is of something that happened once, which the field between two readings of the
    base station would make, moving no further than it does between others that are as far apart."""
    model, station, residual = state.adopted[place], record.station, state.residual
    if not (happens_once(model) and model.component.effect in ("site", "reference")):
        return False
    if station is None or residual.along is None:
        return False
    none = replace(residual, across=None, along=np.zeros_like(residual.along), sighted=None)
    left = taken_off(none, model.terms(state.excitation).at(residual.samples), state.theta[place]).along
    assert left is not None
    time, made = record.time[residual.samples], left / residual.reference_gain
    readings = station.time[(station.time >= time[0]) & (station.time <= time[-1])]
    if len(readings) < 2:
        return False
    unseen = made - np.interp(time, readings, np.interp(readings, time, made))
    if np.sum(unseen**2) <= MOSTLY * np.sum(made**2):
        return False
    furthest = int(np.argmax(np.abs(unseen)))
    after = int(np.clip(np.searchsorted(readings, time[furthest], side="right"), 1, len(readings) - 1))
    return as_far_as_unread(float(np.abs(unseen[furthest])), float(readings[after] - readings[after - 1]), record)
