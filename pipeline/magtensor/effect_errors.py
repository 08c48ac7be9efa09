"""How well the coefficients of error models are known, together with C and o; and what that does to another survey.

C and o are the closed-form fit of the outputs less what the error models add, so they follow the coefficients: taking a
unit of a regressor off the outputs moves them by what an affine function of the field can make of it, across the plane
that the sensors share and along the field. The coefficients' covariance has C and o free, that of the fit has them
given; with the derivative K the joint covariance is [[Sigma + K Theta K', K Theta], [Theta K', Theta]].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibrated import MATRIX_ENTRIES, OFFSET_ENTRIES
from magtensor.calibration.joint import calibrated, nearest_frame
from magtensor.calibration.joint_covariance import frame_projection, to_corrections
from magtensor.calibration.types import Array, ArrayCalibration
from magtensor.loop.correction import TONE
from magtensor.loop.model import Adopted, State
from magtensor.loop.record import record_of
from magtensor.loop.terms import REFERENCE, joined
from magtensor.loop.waveform import NAME as HIDDEN
from magtensor.platform_frame import as_fitted
from magtensor.survey.model import Survey, Variable
from magtensor.tensor.uncertainty import TakenOff

COVARIANCE = "calibration/coefficient_covariance"


@dataclass(frozen=True)
class WithCoefficients:
    """A calibration whose covariance holds what the coefficients leave open.

    Attributes:
        calibration: with directions of the coefficients that no data show among what is unobservable.
        covariance: (12 S + P,) squared: its parameters, then the coefficients of all error models.
        names: (P,) of the coefficients; values: (P,), of least norm where directions are open.
        open: how many directions these are.
    """

    calibration: ArrayCalibration
    covariance: Array
    names: tuple[str, ...]
    values: Array
    open: int


def with_coefficients(state: State) -> WithCoefficients:
    """The calibration of a state with error models, and the joint covariance of its parameters and coefficients."""
    calibration, estimate, terms = calibrated(state.fit), state.estimate, state.terms
    assert estimate is not None and terms is not None
    slope = _slope(state)
    theta = estimate.covariance
    own = calibration.covariance + slope @ theta @ slope.T
    mixed = slope @ theta
    models = [a.name for a, t in zip(state.adopted, state.theta, strict=True) for _ in t]
    names = (":".join(p for p in parts if p) for parts in zip(models, terms.sensors, terms.names, strict=True))
    free, open_ = calibration.unobservable, terms.count - estimate.rank
    if open_:
        words = f"{open_} of {terms.count} directions of the coefficients of {', '.join(dict.fromkeys(models))}"
        free = (*free, f"{words}: no data show them, and they were left zero")
    return WithCoefficients(
        replace(calibration, covariance=own, unobservable=free),
        np.block([[own, mixed], [mixed.T, theta]]),
        tuple(names),
        np.concatenate(state.theta),
        open_,
    )


def _slope(state: State) -> Array:
    """K (12 S, P): derivative of the corrections and offsets with the coefficients."""
    fit, residual, terms = state.fit, state.residual, state.terms
    assert terms is not None
    q = nearest_frame(fit.forward)
    forward = fit.forward @ q
    sensors, size = len(forward), 3 * len(forward)
    # `affine` holds the field in units of its mean length, the moments hold it in nT
    squares = float(np.sum(residual.affine[:, :3] ** 2))
    unit = float(np.sqrt(np.trace(fit.scalar.scores.moments[:3, :3]) / squares))
    across, along = np.linalg.pinv(residual.affine), np.linalg.pinv(residual.inner, rcond=1e-9)
    moved = np.empty((12 * sensors, terms.count))
    for k, one in enumerate(np.eye(terms.count)):
        outputs = terms.contribution(one, size) / residual.noise
        change = -(across @ (outputs @ residual.projector)).T
        seen = np.einsum("no,no->n", residual.gain, outputs) + residual.reference_gain * terms.on_reference(one)
        change -= fit.plane.basis @ (along @ seen).reshape(3, 4)
        change *= residual.noise[:, None]
        response = change[:, :3].reshape(sensors, 3, 3) @ q / unit
        moved[:, k] = np.concatenate([response.reshape(sensors, 9), change[:, 3].reshape(sensors, 3)], axis=1).ravel()
    matrix = np.asarray(np.linalg.inv(forward), dtype=np.float64)
    out: Array = to_corrections(matrix) @ frame_projection(forward) @ moved
    return out


def coefficient_variables(found: WithCoefficients, sensors: Sequence[str]) -> dict[str, Variable]:
    """The joint covariance as a variable of the group `calibration`."""
    parameters = [f"{s}:{e}" for s in sensors for e in (*MATRIX_ENTRIES, *OFFSET_ENTRIES)]
    names = np.array([*parameters, *found.names])
    values = np.concatenate([np.full(len(parameters), np.nan), found.values])
    attributes = {"units": "products of the parameters' units", "frame": "that of the fit"}
    return {
        "calibration/joint_parameter": (("joint_parameter",), names, {"value_of_coefficients": values}),
        COVARIANCE: (("joint_parameter", "joint_parameter_"), found.covariance, attributes),
    }


def taken_off(
    calibration: Survey,
    fitted: ArrayCalibration,
    survey: Survey,
    clean: Survey,
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    means: Mapping[str, Array],
) -> TakenOff | None:
    """What the errors of the coefficients do to a survey that they were taken off; None where they are not known.

    Only the instrument's effects are taken off a survey. A tone and a source that nobody logged are found there anew,
    with errors of their own that are not in this.

    Args:
        calibration: the stored one; fitted: the same, restored.
        survey: as it was read; clean: with the effects taken off.
    """
    edges = np.cumsum([0, *(len(t) for t in theta)])
    applied = [
        (model, range(edges[i], edges[i + 1]))
        for i, model in enumerate(adopted)
        if model.component.effect == "instrument" and model.name not in (TONE, HIDDEN)
    ]
    if COVARIANCE not in calibration or not applied:
        return None
    sensors = len(fitted.matrix)
    record = record_of(survey, means=means, every=True)
    raw = np.asarray(clean.values("b_raw"), dtype=float)
    raw = np.where(np.isfinite(raw), raw, np.nanmean(raw, axis=0))  # a lost sample must not spoil its neighbours
    x = record.excitation(raw, as_fitted(calibration, fitted).apply(raw))
    terms = joined([model.terms(x) for model, _ in applied])
    response = np.zeros((terms.series.shape[1], 3 * sensors, terms.count))
    use = terms.part_output != REFERENCE
    np.add.at(response, (terms.part_series[use], terms.part_output[use], terms.part_term[use]), 1.0)
    size = 12 * sensors
    kept = [*range(size), *(size + k for _, own in applied for k in own)]
    covariance = np.asarray(calibration.values(COVARIANCE), dtype=float)[np.ix_(kept, kept)]
    if "calibration/common_rotation" in calibration:
        turn = np.kron(np.asarray(calibration.values("calibration/common_rotation"), dtype=float), np.eye(3))
        for s in range(sensors):
            own = slice(12 * s, 12 * s + 9)
            covariance[own, size:] = turn @ covariance[own, size:]
        covariance[size:, :size] = covariance[:size, size:].T
    covariance[:size, :size] = fitted.covariance  # which holds the error of the frame too
    return TakenOff(terms.series, response, covariance)
