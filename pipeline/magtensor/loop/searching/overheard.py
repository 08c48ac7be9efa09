"""Effects that sensors only seem to show, because another one that shows it far more is in the field they are compared
with.

A converter that changes its range bends one sensor's outputs as no smooth law does. What the law leaves is in the field
that all sensors are said to see, and so a little of the same law, alike and with the other sign, seems to be in each of
the others. Without that sensor they show nothing of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.excitation import VECTORS
from magtensor.errors import DataError
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.contribution import KEEP_ALPHA, families, happens_once, slices

LOUDER = 4.0  # times as much of its square stands out of the noise on one sensor as on any other: twice the size
POWER = 0.9  # with which the other sensors would show alone what they seem to show beside it


def shown_by_one(record: Record, state: State, which: int, how: Fitting) -> str:
    """The sensor without which no other one shows a model, though it would if it were as large as it seems; "" where
    there is none."""
    from scipy.special import chdtri, chndtr

    model = state.adopted[which]
    alone = {s: _stands_out(state, numbers) for s, numbers in _by_sensor(state, which).items()}
    if len(alone) < 2 or "" in alone or happens_once(model):
        return ""
    loudest, *others = sorted(alone, key=lambda s: -alone[s])
    if alone[loudest] < LOUDER * alone[others[0]]:
        return ""
    rest = _without(record, state, loudest, how)
    if rest is None:
        return ""
    left, place = rest
    here = _by_sensor(state, which)
    there = _by_sensor(left, place[which])
    if set(there) != set(others) or any(len(there[s]) != len(here[s]) for s in others):
        return ""
    numbers = [i for s in others for i in there[s]]
    seems = np.concatenate(state.theta)[[i for s in others for i in here[s]]]
    critical = float(chdtri(len(numbers), KEEP_ALPHA))
    if chndtr(critical, len(numbers), _square(left, numbers, seems)) > 1.0 - POWER:
        return ""
    return loudest if families(left).p_value(numbers) >= KEEP_ALPHA else ""


def _by_sensor(state: State, which: int) -> dict[str, list[int]]:
    """The numbers of a model's coefficients, sensor by sensor."""
    assert state.terms is not None
    own = slices(state)[which]
    found: dict[str, list[int]] = {}
    for i in range(own.start, own.stop):
        found.setdefault(state.terms.sensors[i], []).append(i)
    return found


def _stands_out(state: State, numbers: Sequence[int]) -> float:
    """The square of some coefficients in units of their covariance."""
    return _square(state, numbers, np.concatenate(state.theta)[list(numbers)])


def _square(state: State, numbers: Sequence[int], theta: Array) -> float:
    assert state.estimate is not None
    covariance = state.estimate.covariance[np.ix_(numbers, numbers)]
    return float(theta @ np.linalg.pinv(covariance, rcond=1e-9, hermitian=True) @ theta)


def _without(record: Record, state: State, sensor: str, how: Fitting) -> tuple[State, dict[int, int]] | None:
    """The fit to all other sensors, and where each model is in it that acts on others; None where there is no fit."""
    keep = [i for i, name in enumerate(record.sensors) if name != sensor]
    models: list[Adopted] = []
    theta: list[Array] = []
    place: dict[int, int] = {}
    for number, model in enumerate(state.adopted):
        sensors = tuple(s for s in model.sensors if s != sensor)
        if model.sensors and not sensors:
            continue
        place[number] = len(models)
        models.append(Adopted(model.component, model.settings, sensors, model.start))
        owners = _by_sensor(state, number)
        theta.append(np.concatenate(state.theta)[[i for s, own in owners.items() if s != sensor for i in own]])
    noise = None if how.noise is None else how.noise[keep]
    try:
        fitted = joint_state(_of_sensors(record, keep), models, replace(how, noise=noise), theta, keep=state.fit.keep)
    except (DataError, KeyError, ValueError):
        return None
    return fitted, place


def _of_sensors(record: Record, keep: Sequence[int]) -> Record:
    """Some of the sensors; of logs with several columns those that have one for each of them, and known vectors."""
    count = len(record.sensors)
    each = {n for n, v in record.logged.items() if v.ndim == 2 and v.shape[1] == count and n not in VECTORS}
    logged = {
        n: v[:, keep] if n in each else v for n, v in record.logged.items() if v.ndim == 1 or n in (*each, *VECTORS)
    }
    origins = {n: v[keep] if n in each and len(np.atleast_1d(v)) == count else v for n, v in record.origins.items()}
    return replace(
        record,
        raw=record.raw[:, keep],
        sensors=tuple(record.sensors[i] for i in keep),
        logged=logged,
        origins=origins,
        position=None if record.position is None else record.position[keep],
        courses={},
        readings=None if record.readings is None else record.readings[:, keep],
    )
