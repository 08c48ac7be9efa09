"""The fit of several surveys as corrections, with the covariance of all parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibration.common_scale import nominal, nominal_scale
from magtensor.calibration.joint import diagnostics, widening
from magtensor.calibration.types import Array, ArrayCalibration

from .covariance import as_white, covariance_of, to_corrections, with_offset
from .fit import SurveysFit, frame_of


@dataclass(frozen=True)
class SurveysCalibration:
    """One correction matrix for each sensor and the offsets of every survey.

    Attributes:
        common: with the offset of the first survey.
        offset: (K, S, 3) nT; K is 1 where all surveys share one.
        covariance: (9 S + 3 S K,) squared: matrices sensor after sensor, then offsets survey after survey.
    """

    common: ArrayCalibration
    offset: Array
    covariance: Array

    def of_survey(self, number: int) -> ArrayCalibration:
        """With the offset of one survey."""
        weights = np.eye(len(self.offset))[number if len(self.offset) > 1 else 0]
        return self._with(weights, np.zeros((0, 0)))

    def of_another(self) -> ArrayCalibration:
        """With the mean offset, as the best guess for a survey that was not in the fit; the scatter of the offsets
        between the surveys is then part of their covariance."""
        count = len(self.offset)
        weights = np.full(count, 1.0 / count)
        return self._with(weights, scatter_of(self.offset.reshape(count, -1)) if count > 1 else np.zeros((0, 0)))

    def nominal(self) -> SurveysCalibration:
        """The same with nominal mean sensitivity (`common_scale`), where no total field was measured."""
        common, _, _ = nominal_scale(self.common)
        size = 9 * len(common.matrix)
        jacobian = np.eye(len(self.covariance))
        jacobian[:size, :size] = nominal(self.common.matrix).jacobian
        return SurveysCalibration(common, self.offset, jacobian @ self.covariance @ jacobian.T)

    def _with(self, weights: Array, scatter: Array) -> ArrayCalibration:
        sensors = len(self.common.matrix)
        pick = with_offset(sensors, weights)
        covariance = pick @ self.covariance @ pick.T
        if scatter.size:
            at = np.concatenate([12 * s + 9 + np.arange(3) for s in range(sensors)])
            covariance[np.ix_(at, at)] += scatter
        offset: Array = np.einsum("k,ksi->si", weights, self.offset)
        return replace(self.common, offset=offset, covariance=covariance)


def scatter_of(offset: Array) -> Array:
    """(3 S, 3 S) nT^2: by how much the offsets of a further survey scatter about the mean of K surveys' (K, 3 S)."""
    count = len(offset)
    away = offset - offset.mean(axis=0)
    out: Array = away.T @ away / (count - 1) * (1 + 1 / count)
    return out


def frame_words(fit: SurveysFit) -> tuple[str, tuple[str, ...], dict[str, float | str]]:
    """The frame of a fit, what it leaves unobservable, and what it says of an attitude."""
    if fit.attitude_std is None:
        free = ("one rotation of the whole array: the frame nearest to the raw axes was chosen",)
        return "array (nearest to the raw axes)", free, {}
    told: dict[str, float | str] = {
        "attitude_std_deg": float(np.degrees(fit.attitude_std)),
        "attitude_excess": fit.attitude_excess,
    }
    return "platform (by the attitude and the known field)", (), told


def calibrated_surveys(fit: SurveysFit) -> SurveysCalibration:
    """The fit in its frame: nearest to the raw axes, or the platform's where directions are known."""
    forward = fit.forward @ frame_of(fit.forward, fit.attitude_std is not None)
    matrix: Array = np.asarray(np.linalg.inv(forward), dtype=np.float64)
    chain = np.eye(fit.design.size)
    chain[: 9 * len(matrix), : 9 * len(matrix)] = to_corrections(matrix)
    covariance, white = (
        chain @ covariance_of(fit.design, surveys, fit.chi2_along) @ chain.T
        for surveys in (fit.said, as_white(fit.said))
    )
    told = diagnostics(fit.keep, fit.chi2_along, fit.plane, fit.coverage, matrix)
    frame, free, more = frame_words(fit)
    with_first = with_offset(len(matrix), np.eye(len(fit.offset))[0])
    own = with_first @ covariance @ with_first.T
    if any(one.coloured is not None for one in fit.said):
        more |= widening(own, with_first @ white @ with_first.T)
    common = ArrayCalibration(matrix, fit.offset[0], own, frame, free, told | more)
    return SurveysCalibration(common, fit.offset, covariance)
