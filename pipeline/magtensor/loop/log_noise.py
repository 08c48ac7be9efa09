"""The noise of a logged channel, and what it leaves behind once an effect that follows the channel is adopted.

A log is not what it logs. An effect of theta times the true channel is corrected with theta times the log, which adds
theta times the log's noise to the data. Other functions of the same log have that noise with other weights (the cube
of a current that is on or off has none while it is off), so one of them predicts what the first brought in, on
held-out data too, and is yet no effect.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.noise import MAD_TO_SIGMA
from magtensor.calibration.types import Array
from magtensor.loop.excitation import Excitation
from magtensor.loop.model import Adopted, State
from magtensor.loop.settings import AnyChannel, profiled
from magtensor.loop.statistics import Estimate
from magtensor.loop.terms import Terms

OUTSIDE = 0.01  # of what coefficients explain, that vectors which are the same may miss: a tenth of their size
CHANCE = 1e-3  # that noise makes them miss more


def white_noise(values: Array, run: NDArray[np.int_]) -> Array:
    """White noise of a channel (N,) or (N, K), one figure for each column.

    From second differences within runs, by their median, so that jumps count as signal; at least the noise of the
    resolution where the values are rounded.
    """
    columns = values.reshape(len(values), -1)
    out = np.zeros(columns.shape[1])
    if len(columns) < 8:
        return out
    within = run[2:] == run[:-2]
    if within.any():
        second = np.abs(np.diff(columns, n=2, axis=0)[within]) / np.sqrt(6.0)
        out = MAD_TO_SIGMA * np.median(second, axis=0)
    for j, column in enumerate(columns.T):
        steps = np.abs(np.diff(column))
        steps = steps[steps > 1e-9 * max(float(np.ptp(column)), 1e-300)]
        if out[j] == 0 and len(steps):
            out[j] = steps.min() / np.sqrt(12.0)
    return out


def channels_of(model: Adopted, x: Excitation) -> set[str]:
    """The logged channels that a model follows."""
    marks = profiled(model.component).items()
    return {mark.pick(x, str(model.settings.get(name, ""))) for name, mark in marks if isinstance(mark, AnyChannel)}


def brought_in(state: State, channels: Collection[str]) -> float:
    """Sum of squares that the noise of the logs of some channels puts into the whitened residual through what is
    adopted."""
    rng = np.random.default_rng(2017)
    return sum(
        _of_a_log(state, model, theta, name, rng)
        for model, theta in zip(state.adopted, state.theta, strict=True)
        for name in sorted(set(channels) & {v for v in model.settings.values() if isinstance(v, str)})
        if name in state.excitation.logged
    )


def would_bring_in(state: State, model: Adopted, theta: Array) -> float:
    """The same through a model that is not adopted, with coefficients (P,)."""
    rng = np.random.default_rng(2017)
    return sum(_of_a_log(state, model, theta, name, rng) for name in sorted(channels_of(model, state.excitation)))


def _of_a_log(state: State, model: Adopted, theta: Array, name: str, rng: np.random.Generator) -> float:
    x, residual = state.excitation, state.residual
    values = x.logged[name]
    noise = rng.standard_normal(values.shape) * white_noise(values, x.run).reshape(values.shape[1:])
    noisy = replace(x, logged={**x.logged, name: values + noise}, courses={})
    added = model.terms(noisy).contribution(theta, len(residual.noise))
    added = (added - model.terms(x).contribution(theta, len(residual.noise)))[residual.samples] / residual.noise
    total = 0.0
    if residual.across is not None:
        total += float(np.sum((added @ residual.projector) ** 2))
    if residual.along is not None:
        total += float(np.sum(np.einsum("no,no->n", residual.gain, added) ** 2))
    return total


def of_another_log(state: State, model: Adopted, terms: Terms, estimate: Estimate) -> float:
    """What the noise of the logs of adopted models lets a model gain that follows another log of the same causes; 0 for
    one that does not.

    Two currents are logged, and the voltage that sags under both: where an effect of the currents is corrected with
    their noisy logs, the voltage knows something of that noise. What it explains of it lies along the currents' own
    vectors, all of it, and a further effect has vectors of its own.

    Parameters
    ----------
    estimate: of the adopted terms and then the model's.
    """
    x = state.excitation
    if state.terms is None or not channels_of(model, x):
        return 0.0
    alike = [i for i, a in enumerate(state.adopted) if channels_of(a, x) and _vector(state, i, terms).any()]
    if not alike:
        return 0.0
    patterns = np.column_stack([_vector(state, i, terms) for i in alike])
    first = state.terms.count
    if not along_the_same(estimate.theta[first:], own_of(estimate, first), patterns):
        return 0.0
    return brought_in(state, set().union(*(channels_of(state.adopted[i], x) for i in alike)))


def own_of(estimate: Estimate, first: int) -> Array:
    """The information on the coefficients from a number on, those before it free."""
    n = estimate.normal
    mixed = n[first:, :first]
    return np.asarray(n[first:, first:] - mixed @ np.linalg.pinv(n[:first, :first], hermitian=True) @ mixed.T)


def along_the_same(theta: Array, information: Array, patterns: Array) -> bool:
    """Whether coefficients (P,) are a combination of patterns (P, M) but for noise and a tenth of their size."""
    from scipy.special import chdtri

    size = np.linalg.norm(patterns, axis=0)
    basis = patterns / np.where(size > 0, size, 1.0)
    within = basis @ np.linalg.lstsq(basis.T @ information @ basis, basis.T @ information @ theta, rcond=1e-9)[0]
    outside, whole = theta - within, float(theta @ information @ theta)
    free = len(theta) - basis.shape[1]
    return free > 0 and float(outside @ information @ outside) <= OUTSIDE * whole + float(chdtri(free, CHANCE))


def vector_of(own: Terms, theta: Array, like: Terms) -> Array:
    """The coefficients of a model in the places of another's that act on the same axes in the same way, 0 elsewhere."""
    place = {label: float(value) for label, value in zip(_labels(own), theta, strict=True)}
    return np.array([place.get(label, 0.0) for label in _labels(like)])


def _vector(state: State, which: int, like: Terms) -> Array:
    assert state.terms is not None
    first = sum(len(t) for t in state.theta[:which])
    own = state.terms.only(range(first, first + len(state.theta[which])))
    return vector_of(own, state.theta[which], like)


def _labels(terms: Terms) -> list[tuple[str, str, str]]:
    """Sensor, axis, and what the coefficients are of: nT or ppm."""
    units = (unit.split("/")[0] for unit in terms.units)
    return list(zip(terms.sensors, terms.names, units, strict=True))
