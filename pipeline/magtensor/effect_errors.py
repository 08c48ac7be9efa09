"""How well the coefficients of error models are known, together with C and o; and what that does to another survey.

C and o are the closed-form fit of the outputs less what the error models add, so they follow the coefficients: taking a
unit of a regressor off the outputs moves them by what an affine function of the field can make of it, across the plane
that the sensors share and along the field (and across known directions). The coefficients' covariance has C and o free,
that of the fit has them given; with the derivative K the joint covariance is
[[Sigma + K Theta K', K Theta], [Theta K', Theta]]. Of several surveys o is that of each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibrated import MATRIX_ENTRIES, OFFSET_ENTRIES
from magtensor.calibration.by_sensor import by_sensor
from magtensor.calibration.common_field import CommonField
from magtensor.calibration.common_scale import nominal
from magtensor.calibration.joint import calibrated, nearest_frame
from magtensor.calibration.joint_covariance import frame_projection
from magtensor.calibration.surveys.corrections import SurveysCalibration
from magtensor.calibration.surveys.covariance import to_corrections, with_offset
from magtensor.calibration.surveys.fit import frame_of
from magtensor.calibration.types import Array, ArrayCalibration
from magtensor.error_models.terms import REFERENCE, Terms, joined
from magtensor.error_models.waveform import NAME as HIDDEN
from magtensor.loop.correcting.another_survey import TONE
from magtensor.loop.correcting.filled import filled
from magtensor.loop.evidence.columns import across_directions, along_the_field
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.fitting.model import Adopted, State
from magtensor.loop.fitting.record import record_of
from magtensor.loop.fitting.several import SurveysState
from magtensor.platform_frame import as_fitted
from magtensor.survey.model import Survey, Variable
from magtensor.tensor.uncertainty import TakenOff

COVARIANCE = "calibration/coefficient_covariance"
_INNER_RANK = 1e-9


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
    q = nearest_frame(state.fit.forward)
    slope = _slope(state.residual, terms, state.fit.plane, state.fit.forward, q, tied=False)
    slope = with_offset(len(calibration.matrix), np.ones(1)) @ slope
    theta = estimate.covariance
    own = calibration.covariance + slope @ theta @ slope.T
    mixed = slope @ theta
    names, words = _names(state, terms), _open_words(state, terms)
    return WithCoefficients(
        replace(calibration, covariance=own, unobservable=(*calibration.unobservable, *words)),
        np.block([[own, mixed], [mixed.T, theta]]),
        names,
        np.concatenate(state.theta),
        terms.count - estimate.rank,
    )


@dataclass(frozen=True)
class SurveysWithCoefficients:
    """The calibration of several surveys whose covariance holds what the coefficients leave open.

    Attributes:
        calibration: as in `WithCoefficients`.
        mixed: (9 S + 3 S K, P) covariance of its parameters with the coefficients; theta: (P, P) of these alone.
        names, values, open: as in `WithCoefficients`.
    """

    calibration: SurveysCalibration
    mixed: Array
    theta: Array
    names: tuple[str, ...]
    values: Array
    open: int

    def nominal(self) -> SurveysWithCoefficients:
        """The same with nominal mean sensitivity, as `SurveysCalibration.nominal`."""
        mixed, matrix = self.mixed.copy(), self.calibration.common.matrix
        size = 9 * len(matrix)
        mixed[:size] = nominal(matrix).jacobian @ mixed[:size]
        return replace(self, calibration=self.calibration.nominal(), mixed=mixed)

    def beside(self, calibration: ArrayCalibration, mean: bool) -> WithCoefficients:
        """One survey's calibration with the joint covariance: that of the first, or of another with the mean offset."""
        count = len(self.calibration.offset)
        weights = np.full(count, 1.0 / count) if mean else np.eye(count)[0]
        mixed = with_offset(len(calibration.matrix), weights) @ self.mixed
        joint = np.block([[calibration.covariance, mixed], [mixed.T, self.theta]])
        return WithCoefficients(calibration, joint, self.names, self.values, self.open)


def surveys_with_coefficients(state: SurveysState, found: SurveysCalibration) -> SurveysWithCoefficients:
    """The calibration of surveys with error models, and what its parameters have in common with the coefficients.

    Args:
        found: of the state's fit, the coefficients given.
    """
    fit, theta = state.fit, state.estimate.covariance
    tied = fit.attitude_std is not None
    slope = _slope(state.residual, state.terms, fit.plane, fit.forward, frame_of(fit.forward, tied), tied=tied)
    grown = slope @ theta @ slope.T
    first = with_offset(len(fit.forward), np.eye(len(fit.offset))[0])
    common = replace(
        found.common,
        covariance=found.common.covariance + first @ grown @ first.T,
        unobservable=(*found.common.unobservable, *_open_words(state, state.terms)),
    )
    return SurveysWithCoefficients(
        SurveysCalibration(common, found.offset, found.covariance + grown),
        slope @ theta,
        theta,
        _names(state, state.terms),
        np.concatenate(state.theta),
        state.terms.count - state.estimate.rank,
    )


def _names(state: State | SurveysState, terms: Terms) -> tuple[str, ...]:
    """Of all coefficients."""
    models = [a.name for a, t in zip(state.adopted, state.theta, strict=True) for _ in t]
    return tuple(":".join(p for p in parts if p) for parts in zip(models, terms.sensors, terms.names, strict=True))


def _open_words(state: State | SurveysState, terms: Terms) -> tuple[str, ...]:
    """What to say of directions of the coefficients that no data show."""
    assert state.estimate is not None
    open_ = terms.count - state.estimate.rank
    words = f"{open_} of {terms.count} directions of the coefficients of {', '.join(a.name for a in state.adopted)}"
    return (f"{words}: no data show them, and they were left zero",) if open_ else ()


def _slope(residual: Residual, terms: Terms, plane: CommonField, forward: Array, q: Array, *, tied: bool) -> Array:
    """K (9 S + 3 S K, P): derivative of the corrections, and of the offsets of K surveys, with the coefficients.

    Args:
        forward: (S, 3, 3) C of the fit; q: (3, 3) brings it to the frame of the calibration; tied: known directions do.
    """
    turned = forward @ q
    sensors, size = len(forward), 3 * len(forward)
    across, inner = np.linalg.pinv(residual.affine), residual.inner
    seen = along_the_field(residual, [terms]).made
    if residual.sighted is not None:
        inner = np.concatenate([inner, residual.sighted.inner])
        seen = np.concatenate([seen, across_directions(residual, [terms]).made])
    inside = np.linalg.lstsq(inner, seen, rcond=_INNER_RANK)[0]
    at = with_offset(sensors, np.ones(1))[:, : 9 * sensors]
    to_frame = np.eye(9 * sensors) if tied else at.T @ frame_projection(turned) @ at
    to_frame = to_corrections(np.asarray(np.linalg.inv(turned), dtype=np.float64)) @ to_frame
    moved = []
    for one, along in zip(np.eye(terms.count), inside.T, strict=True):
        outputs = terms.contribution(one, size) / residual.noise
        change = -(across @ (outputs @ residual.projector)).T - plane.basis @ along.reshape(3, -1)
        change *= residual.noise[:, None]
        response = change[:, :3].reshape(sensors, 3, 3) @ q / residual.unit
        moved.append(np.concatenate([to_frame @ response.ravel(), change[:, 3:].T.ravel()]))
    return np.stack(moved, axis=1)


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
    origins: Mapping[str, Array],
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
    record = record_of(survey, origins=origins, every=True)
    linear = as_fitted(calibration, fitted)
    b = linear.apply(np.asarray(clean.values("b_raw"), dtype=float))
    b = filled(record.believed(b), clean.readings)
    raw = by_sensor(np.asarray(np.linalg.inv(linear.matrix), dtype=float), b) + linear.offset
    x = record.excitation(raw, b)
    terms = joined([model.terms(x) for model, _ in applied])
    response = np.zeros((terms.series.shape[1], 3 * sensors, terms.count))
    use = terms.part_output != REFERENCE
    np.add.at(response, (terms.part_series[use], terms.part_output[use], terms.part_term[use]), terms.part_weight[use])
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
