"""What is seen of |b| - F between two readings of the base station, where nobody saw the field.

Something that happened once: a field that moves as it does elsewhere makes as much of it, and how much that is the
readings tell that are as far apart. A tone: what a field does that is read every T and has a period of its own is off
by a wave of about T, which is gone at the readings.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.station import Station
from magtensor.loop.evidence.residual import taken_off
from magtensor.loop.fitting.model import Record, State
from magtensor.loop.remainder.sparse_readings import EACH, as_far_as_unread
from magtensor.loop.searching.contribution import a_tone, happens_once

MOSTLY = 0.5  # of its power is gone where the readings show it; of its size, is there at the readings
NEAR = 0.15  # of the time between two readings: what of the field is unread is half as large there as midway
BETWEEN = "fitted, it acts between readings of the base station: a field that moves as elsewhere would look the same"


def between_readings(record: Record, state: State, place: int) -> bool:
    """Whether one of the adopted models, of something that happened once or of a tone, is what the field between two
    readings of the base station would make."""
    model, station, residual = state.adopted[place], record.station, state.residual
    if station is None or residual.along is None:
        return False
    none = replace(residual, along=np.zeros_like(residual.along), sighted=None)
    none = none if none.across is None else replace(none, across=np.zeros_like(none.across))
    left = taken_off(none, model.terms(state.excitation).at(residual.samples), state.theta[place])
    assert left.along is not None
    time, made = record.time[residual.samples], left.along / residual.reference_gain
    if a_tone(model):
        if left.across is not None and np.sum(left.across**2) > np.sum(left.along**2):
            return False
        return _gone_at_readings(made, made - residual.along / residual.reference_gain, time, station)
    if not (happens_once(model) and model.component.effect in ("site", "reference")):
        return False
    readings = station.time[(station.time >= time[0]) & (station.time <= time[-1])]
    if len(readings) < 2:
        return False
    unseen = made - np.interp(time, readings, np.interp(readings, time, made))
    if np.sum(unseen**2) <= MOSTLY * np.sum(made**2):
        return False
    furthest = int(np.argmax(np.abs(unseen)))
    apart_s = float(station.between(time).apart_s[furthest])
    return as_far_as_unread(float(np.abs(unseen[furthest])), apart_s, record)


def _gone_at_readings(made: Array, seen: Array, time: Array, station: Station) -> bool:
    """Whether less than half of what is made (N,) nT is in what was seen (N,) nT near the readings.

    Parameters
    ----------
    time: (N,) s.
    """
    if station.step_s < EACH * float(np.median(np.diff(time))):
        return False
    share = station.between(time).share
    near = np.minimum(share, 1.0 - share) < NEAR
    known = float(made[near] @ made[near])
    return known > 0.0 and float(made[near] @ seen[near]) < MOSTLY * known
