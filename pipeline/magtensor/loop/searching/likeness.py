"""What a waveform that the sensors share is like: a logged channel, or an effect that is in the model already."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.waveform import NAME
from magtensor.loop.fitting.model import Record, State

LIKE_A_CHANNEL = 0.7  # correlation from which a logged channel is the suspect and no hidden source
MOST_LAG = 0.1  # of the survey, in which a channel is compared with the waveform
COMPARED = 400  # points at which it is
LIKE_AN_EFFECT = 0.9  # cosine; of two directions off the plane of four sensors one pair in a thousand is nearer
ONE_DIRECTION = 0.9  # of an effect's power
REMEMBERS = 0.3  # of its size, what other samples change of a regressor that remembers the field there


def followed(time: Array, values: Array, record: Record) -> tuple[str, float, int, float] | None:
    """The channel, lag, power and correlation that come nearest to a waveform, if they come near; of delays of its log
    either way the shortest that does."""
    points = np.linspace(time[0], time[-1], min(COMPARED, len(time)))
    step = points[1] - points[0]
    wave = _means(time, values, points)
    most = max(1, int(MOST_LAG * len(points)))
    best: tuple[str, float, int, float] | None = None
    for name, channel in record.logged.items():
        for column in channel.reshape(len(channel), -1).T:
            sampled = _means(record.time, column, points)
            for power in (1, 2, 3):
                series = sampled**power
                for shift in sorted(range(-most, most + 1), key=abs):
                    later, sooner = max(shift, 0), max(-shift, 0)
                    a, b = wave[later : len(wave) - sooner], series[sooner : len(series) - later]
                    if not a.std() > 0 or not b.std() > 0:
                        continue
                    c = float(np.corrcoef(a, b)[0, 1])
                    if best is None or abs(c) > abs(best[3]) + 0.01:
                        best = (name, shift * step, power, c)
    return best if best is not None and abs(best[3]) > LIKE_A_CHANNEL else None


def _means(time: Array, values: Array, points: Array) -> Array:
    """Means of a series about points in time, those between samples from their neighbours."""
    half = 0.5 * (points[1] - points[0])
    total = np.concatenate([[0.0], np.cumsum(values)])
    first, last = np.searchsorted(time, points - half), np.searchsorted(time, points + half)
    count = last - first
    mean = (total[last] - total[first]) / np.maximum(count, 1)
    out: Array = np.where(count > 0, mean, np.interp(points, time, values))
    return out


def effect_along(state: State, basis: Array, direction: Array) -> str:
    """The adopted error model whose own vector at the sensors is that of a waveform; "" where none is.

    What a strong effect leaves, because its channel was smoothed or lags otherwise than modelled, moves the sensors as
    the effect does, and looks like a source of its own.

    Parameters
    ----------
    basis: (3 S, m) orthonormal, of what lies off the plane that the sensors share, whitened.
    direction: (m,) of the waveform in it.
    """
    size = float(np.linalg.norm(direction))
    for model, theta in zip(state.adopted, state.theta, strict=True):
        terms = model.terms(state.excitation).at(state.residual.samples)
        moved = terms.contribution(theta, len(state.residual.noise)) / state.residual.noise @ basis
        moved = moved - moved.mean(axis=0)
        powers, vectors = np.linalg.eigh(moved.T @ moved)
        if powers[-1] > ONE_DIRECTION * powers.sum() > 0 and abs(vectors[:, -1] @ direction) > LIKE_AN_EFFECT * size:
            return model.name
    return ""


def of_an_unseen_path(state: State) -> list[int]:
    """The places of the adopted models that remember the field where it turns too far from one sample to the next for
    the path between them to be known: static postures. What a turn back and forth on the way does, no sample shows."""
    x = state.excitation
    if x.turns:
        return []
    some = np.arange(0, len(x.time), 2)
    places = []
    for place, model in enumerate(state.adopted):
        if model.name == NAME:
            continue
        whole, part = model.terms(x).series[some], model.terms(x.at(some)).series
        whole, part = whole - whole.mean(axis=0), part - part.mean(axis=0)
        if np.linalg.norm(whole - part) > REMEMBERS * np.linalg.norm(whole):
            places.append(place)
    return places
