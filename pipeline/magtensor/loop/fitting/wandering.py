"""Sensors that wander far more than the others: a search without them, and a fit that weighs them by it.

The joint fit weighs outputs by their white noise, which no effect that a model lacks can pass for. A sensor that
wanders by ten times its white noise then puts its share of that into the field that all of them see, and so into what
is left of every other one; and the colour of the noise, one for all, is that sensor's. A slow effect of a quiet sensor
stands in noise that is not its own. Where nothing more is found, the quiet sensors are looked at by themselves, as an
array of their own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.excitation import VECTORS
from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import reweighed

UNEQUAL = 3.0  # all of a sensor's noise over its white noise, beside the same of the sensor that wanders least
LEAST_SENSORS = 3  # two have one contrast, which does not tell whose effect it is


def quieter(state: State) -> Iterator[tuple[str, ...]]:
    """Names of the sensors without the one that wanders most; without those that stand out most from the rest; without
    all that wander far more than the quietest: with many sensors, a search after each in turn would take far too long.
    """
    names = state.excitation.sensors
    every, white = all_noise(state), state.residual.noise.reshape(-1, 3)
    more = np.sqrt(np.mean(every**2, axis=1) / np.mean(white**2, axis=1))
    order = np.argsort(-more)
    most = min(int(np.sum(more > UNEQUAL * more.min())), len(names) - LEAST_SENSORS)
    if most < 1:
        return
    falls = more[order[:most]] / more[order[1 : most + 1]]
    for count in sorted({1, int(np.argmax(falls)) + 1, most}):
        yield tuple(name for i, name in enumerate(names) if i not in order[:count])


def all_noise(state: State) -> Array:
    """(S, 3) nT, rms of each output's noise as the residual shows it, the slow noise with the white."""
    slow = OwnNoise(state.residual, None).slow_std()
    return np.asarray(np.hypot(state.residual.noise, slow).reshape(-1, 3))


def of_sensors(record: Record, names: Sequence[str]) -> Record:
    """The record of some of its sensors, as of an array of their own."""
    keep = [record.sensors.index(name) for name in names]
    count = len(record.sensors)

    def own(name: str, values: Array) -> Array | None:
        if values.ndim == 1 or name in VECTORS:
            return values
        if values.shape[1] == count:
            return values[:, keep]
        return None if len(keep) == values.shape[1] else values  # a vector would pass for one value a sensor

    logged = {name: seen for name, values in record.logged.items() if (seen := own(name, values)) is not None}
    return replace(
        record,
        raw=record.raw[:, keep],
        sensors=tuple(names),
        logged=logged,
        position=None if record.position is None else record.position[keep],
        courses={},
    )


def narrowed_to(
    adopted: Sequence[Adopted], theta: Sequence[Array], state: State, names: Sequence[str]
) -> tuple[list[Adopted], list[Array]]:
    """Adopted models on some of the sensors, and their coefficients; without those that act on none of them."""
    models, values = [], []
    for model, own in zip(adopted, theta, strict=True):
        sensors = model.terms(state.excitation).sensors
        keep = [i for i, s in enumerate(sensors) if s in names or s == ""]
        if keep:
            on = tuple(s for s in names if s in sensors)
            models.append(replace(model, sensors=on))
            values.append(own[keep])
    return models, values


def unweighed(record: Record, state: State, how: Fitting) -> State | None:
    """A state fitted with weights of all noise, its coefficients kept, by the white noise again; None where it is by
    that."""
    return None if how.noise is None else reweighed(record, state, replace(how, noise=None, searching=False))
