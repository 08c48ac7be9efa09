"""The error before and after, with parameters that never saw the samples they are judged on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.accuracy import error_block
from magtensor.calibration.by_sensor import by_sensor
from magtensor.calibration.joint import nearest_frame
from magtensor.calibration.types import Array
from magtensor.error_models.terms import Terms
from magtensor.errors import DataError, NotEnoughData
from magtensor.loop.evidence.folds import NEARLY_ALL, NOTHING, known_until
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state, without
from magtensor.sharing import shared_out
from magtensor.tensor.assembly import least_squares_assembly

FOLDS = 5


def folds_for(state: State) -> NDArray[np.int_]:
    """Where the folds begin and end that the models of a fit can be judged on: a number of samples each.

    Folds of equal length. Where two neighbours hold nearly all that can be known of a model, they are divided into as
    many that know equally much: one part of a vehicle's passing is predicted by its other parts, and by nothing else.
    So is one without which hardly anything is known of a model that follows no channel, as the beginning of a warming
    up that is soon over. A channel's course is seen elsewhere too, if less; but of a pump that ran once the other folds
    know nothing.
    What is known follows from the regressors; their settings, as everywhere in these folds, were found on all samples.
    """
    n = len(state.excitation.time)
    edges = np.linspace(0, n, FOLDS + 1).round().astype(int)
    divided = set(edges.tolist())
    for model in state.adopted:
        terms = model.terms(state.excitation)
        known = known_until(terms)
        held = known[edges[2:]] - known[edges[:-2]]
        left = _known_without_each(terms, edges)
        if held.max() > NEARLY_ALL:
            first, last = edges[held.argmax()], edges[held.argmax() + 2]
        elif left.min() < (NOTHING if model.channels(state.excitation) else 1.0 - NEARLY_ALL):
            first, last = edges[left.argmin()], edges[left.argmin() + 1]
        else:
            continue
        inner = known[first] + (known[last] - known[first]) * np.arange(1, FOLDS) / FOLDS
        divided.update(np.searchsorted(known, inner).tolist())
    return np.array(sorted(divided))


def _known_without_each(terms: Terms, edges: NDArray[np.int_]) -> Array:
    """(folds,) part of what is known of a model's coefficients that the other folds know, constants left out."""

    def known(sums: Array, squares: Array, count: Array) -> Array:
        return squares - sums**2 / np.maximum(count, 1)[:, None]

    count = np.diff(edges)
    sums = np.add.reduceat(terms.series, edges[:-1])
    squares = np.add.reduceat((terms.series - terms.series.mean(axis=0)) ** 2, edges[:-1])
    sums = sums - count[:, None] * terms.series.mean(axis=0)
    every = np.maximum(squares.sum(axis=0), 1e-300)
    others = known(sums.sum(axis=0) - sums, squares.sum(axis=0) - squares, count.sum() - count)
    return np.asarray((others / every)[:, terms.part_series].mean(axis=1))


def held_out_error(
    record: Record, found: tuple[Array, Array | None] | None, keep: NDArray[np.bool_]
) -> dict[str, Any] | None:
    """The error block of `magtensor.accuracy.error_block` over the samples (N,) in use of what `held_out` found; None
    of None."""
    if found is None:
        return None
    b, reference = found
    use = np.repeat(keep[:, None], len(record.sensors), axis=1)
    return error_block(b, reference, tensor_of(b, record.position), use, list(record.sensors))


def held_out(
    record: Record,
    adopted: Sequence[Adopted],
    how: Fitting,
    start: Sequence[Array],
    keep: NDArray[np.bool_],
    edges: NDArray[np.int_],
) -> tuple[Array, Array | None] | None:
    """Contiguous folds, each calibrated with the samples of the others.

    Parameters
    ----------
    record: the samples.
    adopted: the error models, with their settings; their coefficients are fitted anew for every fold.
    start: coefficients to begin with; what they converge to does not depend on them.
    keep: (N,) samples that a fit may believe.
    edges: (folds + 1,) where the folds begin and end (`folds_for`); errors are comparable over the same ones.

    Returns
    -------
    Calibrated fields (N, S, 3) nT and total field (N,) nT, what is adopted taken off both; None where the other folds
    do not determine a calibration.
    """

    def calibrated_fold(k: int) -> tuple[Array, Array | None] | None:
        test = slice(edges[k], edges[k + 1])
        train = np.array(keep)
        train[test] = False
        try:
            # the whole record makes the regressors: a lag remembers what went on while the test samples were taken
            state = joint_state(record, adopted, how, start, keep=train, seen=np.asarray(keep))
        except DataError:
            return None
        return calibrated_fields(record, state, test)

    b, reference = [], []
    for fold in shared_out(calibrated_fold, range(len(edges) - 1)):
        if fold is None:
            return None
        b.append(fold[0])
        if fold[1] is not None:
            reference.append(fold[1])
    return np.concatenate(b), np.concatenate(reference) if reference else None


def calibrated_fields(record: Record, state: State, rows: slice) -> tuple[Array, Array | None]:
    """Calibrated fields (n, S, 3) nT and total field (n,) nT of some samples, what is adopted taken off both."""
    raw, field = without(record, [a.terms(state.excitation) for a in state.adopted], state.theta)
    matrix = np.linalg.inv(state.fit.forward @ nearest_frame(state.fit.forward))
    return by_sensor(matrix, raw[rows] - state.fit.offset), None if field is None else field[rows]


def tensor_of(b: Array, position: Array | None) -> Array | None:
    """(N, 3, 3) nT/m by least squares; None where the array cannot measure it."""
    if position is None:
        return None
    try:
        return least_squares_assembly(position).apply(b)
    except NotEnoughData:
        return None
