"""The error before and after, with parameters that never saw the samples they are judged on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.accuracy import error_block
from magtensor.calibration.joint import nearest_frame
from magtensor.calibration.types import Array
from magtensor.errors import DataError, NotEnoughData
from magtensor.loop.model import Adopted, Fitting, Record, excitation_of, joint_state, without
from magtensor.sharing import shared_out
from magtensor.tensor.assembly import least_squares_assembly

FOLDS = 5


def held_out_error(
    record: Record, adopted: Sequence[Adopted], how: Fitting, start: Sequence[Array], keep: NDArray[np.bool_]
) -> dict[str, Any] | None:
    """Error figures over contiguous folds, each calibrated with the samples of the others.

    Parameters
    ----------
    record: the samples.
    adopted: the error models, with their settings; their coefficients are fitted anew for every fold.
    start: coefficients to begin with; what they converge to does not depend on them.
    keep: (N,) samples that a fit may believe.

    Returns
    -------
    The error block of `magtensor.accuracy.error_block`; None where the other folds do not determine a calibration.
    """
    n, sensors = len(record.time), len(record.sensors)
    edges = np.linspace(0, n, FOLDS + 1).round().astype(int)

    def calibrated_fold(k: int) -> tuple[Array, Array | None] | None:
        test = slice(edges[k], edges[k + 1])
        train = np.array(keep)
        train[test] = False
        try:
            # the whole record makes the regressors: a lag remembers what went on while the test samples were taken
            state = joint_state(record, adopted, how, start, keep=train)
        except DataError:
            return None
        x = excitation_of(record, state.fit)
        raw, field = without(record, [a.terms(x) for a in adopted], state.theta)
        matrix = np.linalg.inv(state.fit.forward @ nearest_frame(state.fit.forward))
        return np.einsum("sij,nsj->nsi", matrix, raw[test] - state.fit.offset), None if field is None else field[test]

    folds = shared_out(calibrated_fold, range(FOLDS))
    b, reference = [], []
    for fold in folds:
        if fold is None:
            return None
        b.append(fold[0])
        if fold[1] is not None:
            reference.append(fold[1])
    field = np.concatenate(b)
    return error_block(
        field,
        np.concatenate(reference) if reference else None,
        tensor_of(field, record.position),
        np.repeat(keep[:, None], sensors, axis=1),
        list(record.sensors),
    )


def tensor_of(b: Array, position: Array | None) -> Array | None:
    """(N, 3, 3) nT/m by least squares; None where the array cannot measure it."""
    if position is None:
        return None
    try:
        return least_squares_assembly(position).apply(b)
    except NotEnoughData:
        return None
