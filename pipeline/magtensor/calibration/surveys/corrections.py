"""The fit of several surveys as corrections, with the covariance of all parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibration.common_scale import nominal, nominal_scale
from magtensor.calibration.joint import diagnostics, widening
from magtensor.calibration.types import Array, ArrayCalibration

from .covariance import as_white, covariance_of, to_corrections, with_offset
from .fit import SurveysFit, frame_of

NOT_LINEAR = 0.5  # of the noise along the field: the change of |b| in second order that is worth a word


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
        return self._with(weights, 0.0)

    @property
    def scatter(self) -> float:
        """nT, of the offsets of a survey about those of all surveys (`scatter_of`); 0 where they share one."""
        size = 9 * len(self.common.matrix)
        count = len(self.offset)
        return scatter_of(self.offset.reshape(count, -1), self.covariance[size:, size:]) if count > 1 else 0.0

    def of_another(self) -> ArrayCalibration:
        """With the mean offset, as the best guess for a survey that was not in the fit; the scatter of the offsets
        between the surveys is then part of their covariance."""
        count = len(self.offset)
        weights = np.full(count, 1.0 / count)
        return self._with(weights, self.scatter * np.sqrt(1 + 1 / count))

    def nominal(self) -> SurveysCalibration:
        """The same with nominal mean sensitivity (`common_scale`), where no total field was measured."""
        common, _, _ = nominal_scale(self.common)
        size = 9 * len(common.matrix)
        jacobian = np.eye(len(self.covariance))
        jacobian[:size, :size] = nominal(self.common.matrix).jacobian
        return SurveysCalibration(common, self.offset, jacobian @ self.covariance @ jacobian.T)

    def _with(self, weights: Array, scatter: float) -> ArrayCalibration:
        sensors = len(self.common.matrix)
        pick = with_offset(sensors, weights)
        offset: Array = np.einsum("k,ksi->si", weights, self.offset)
        own = replace(self.common, offset=offset, covariance=pick @ self.covariance @ pick.T)
        return with_scatter(own, scatter)


def scatter_of(offset: Array, covariance: Array) -> float:
    """nT: standard deviation of any one offset between surveys, from those of K surveys.

    One variance for all 3 S offsets: K surveys tell no more than K - 1 directions of a covariance. With f = 3 S (K - 1)
    degrees of freedom the offset of a further survey has Student's distribution, whose variance is f / (f - 2) times
    the estimate. What the errors of the estimates explain is taken off.

    Parameters
    ----------
    offset: (K, 3 S) nT, K > 1; covariance: (3 S K, 3 S K) nT^2, of the errors of their estimates, survey after survey.
    """
    count, values = offset.shape
    freedom = values * (count - 1)
    away = offset - offset.mean(axis=0)
    centring = np.kron(np.eye(count) - 1.0 / count, np.eye(values))
    by_error = float(np.sum(centring * covariance))
    return float(np.sqrt(max(float(np.sum(away**2)) / (freedom - 2) - by_error / freedom, 0.0)))


def with_scatter(calibration: ArrayCalibration, scatter: float) -> ArrayCalibration:
    """A calibration whose offsets are uncertain by so many nT more, each by itself."""
    covariance = calibration.covariance.copy()
    at = np.arange(len(covariance)).reshape(-1, 12)[:, 9:].ravel()
    covariance[at, at] += scatter**2
    return replace(calibration, covariance=covariance)


def frame_words(fit: SurveysFit) -> tuple[str, tuple[str, ...], dict[str, float | str]]:
    """The frame of a fit, what it leaves unobservable, and what it says of an attitude."""
    if fit.attitude_std is None:
        free = ("one rotation of the whole array: the frame nearest to the raw axes was chosen",)
        return "array (nearest to the raw axes)", free, {}
    told: dict[str, float | str] = {
        "attitude_std_deg": float(np.degrees(fit.attitude_std)),
        "attitude_excess": fit.attitude_excess,
    }
    if words := _second_order(fit, fit.attitude_std):
        told["caution"] = words
    return "platform (by the attitude and the known field)", (), told


def _second_order(fit: SurveysFit, attitude_std: float) -> str:
    """Whether few directions of poor attitudes leave C so uncertain that its errors are not linear in theirs.

    With four parameters an axis C turns the field by some 2 attitude_std / sqrt(N), which shortens it by half the
    square of that: a change of |b| that the covariance knows nothing of.
    """
    count = int(fit.keep.sum())
    moved = 2.0 * float(np.mean(fit.found.sums.total_field)) * attitude_std**2 / count
    noise = float(np.sqrt(np.mean(fit.plane.noise**2) / len(fit.forward)))
    if moved < NOT_LINEAR * noise:
        return ""
    return (
        f"an attitude known to {np.degrees(attitude_std):.2g} deg in {count} samples leaves C so uncertain that |b| "
        f"changes by some {moved:.2g} nT in second order, beside {noise:.2g} nT of noise: errors are larger than the "
        "standard deviations say; take more attitudes"
    )


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
