"""Takes the adopted effects off raw outputs, on any survey."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magtensor.calibration.types import Array, ArrayCalibration
from magtensor.loop.model import Adopted, Record

MOST_STEPS = 8
SETTLED_NT = 1e-4


def corrected_raw(
    record: Record, calibration: ArrayCalibration, adopted: Sequence[Adopted], theta: Sequence[Array]
) -> Array:
    """Raw outputs (N, S, 3) nT without the instrument's effects.

    The effects depend on the field that is being sought: b is found from the outputs as they are, the effects from
    b, and so on until neither moves. Effects of the site belong to the calibration's place and are left alone here.

    Parameters
    ----------
    record: all samples of the survey, channels with the calibration's means taken off.
    calibration: C and o.
    adopted: the effects; theta: their coefficients.
    """
    own = [(a, t) for a, t in zip(adopted, theta, strict=True) if a.component.effect == "instrument"]
    raw = record.raw
    if not own:
        return raw
    forward = np.linalg.inv(calibration.matrix)
    for _ in range(MOST_STEPS):
        b = calibration.apply(raw)
        output = np.einsum("sij,nsj->nsi", forward, b) + calibration.offset
        x = record.excitation(_whole(output), _whole(b))
        after = record.raw
        for model, coefficients in own:
            after = after - model.terms(x).contribution(coefficients, raw.shape[1] * 3).reshape(raw.shape)
        moved = float(np.nanmax(np.abs(after - raw), initial=0.0))
        raw = after
        if moved < SETTLED_NT:
            break
    return raw


def corrected_reference(record: Record, adopted: Sequence[Adopted], theta: Sequence[Array]) -> Array | None:
    """The total field (N,) nT without the base station's adopted errors; None where there is none."""
    field = record.total_field
    if field is None:
        return None
    placeholder = np.zeros_like(record.raw)
    for model, coefficients in zip(adopted, theta, strict=True):
        if model.component.effect == "reference":
            terms = model.terms(record.excitation(placeholder, placeholder))
            field = field - terms.on_reference(coefficients)
    return field


def _whole(values: Array) -> Array:
    """Missing values filled from the neighbours, so that one lost sample does not spoil a filter."""
    flat = values.reshape(len(values), -1)
    bad = ~np.isfinite(flat)
    if not bad.any():
        return values
    flat = flat.copy()
    index = np.arange(len(flat))
    for j in np.flatnonzero(bad.any(axis=0)):
        good = ~bad[:, j]
        flat[:, j] = np.interp(index, index[good], flat[good, j]) if good.any() else 0.0
    return flat.reshape(values.shape)
