"""Several surveys of one array, with or without a scalar reference or an attitude, and the bound that noise sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from joint_cases import FIELD_NT, Array, array, directions

from magtensor.calibration.common_scale import nominal_scale
from magtensor.calibration.joint import nearest_frame
from magtensor.calibration.surveys.corrections import SurveysCalibration, calibrated_surveys
from magtensor.calibration.surveys.fit import fit_surveys
from magtensor.calibration.surveys.samples import Samples, joined
from magtensor.calibration.types import ArrayCalibration


@dataclass(frozen=True)
class Case:
    """What is drawn: samples of each survey, and what is known of the field.

    Attributes:
        levels: unknown constants of the total field in each survey; 0 where it is known.
        attitude_deg: standard deviation of the attitude; None without one.
        apart_nT: scatter of the offsets between surveys; 0 where all share one.
    """

    samples: tuple[int, ...] = (400,)
    sensors: int = 4
    tilt_deg: float | None = None
    levels: int = 0
    attitude_deg: float | None = None
    apart_nT: float = 30.0
    noise_nT: float = 1.0


@dataclass(frozen=True)
class Truth:
    """forward (S, 3, 3), offset (K, S, 3) nT, field (N, 3) nT in the platform frame, and the samples with noise."""

    case: Case
    forward: Array
    offset: Array
    field: Array
    samples: Samples

    @property
    def centre(self) -> np.ndarray:
        """(N,) number of the offset of each sample."""
        return self.samples.survey if self.case.apart_nT else np.zeros(len(self.field), dtype=int)


def turned(rng: np.random.Generator, unit: Array, std: float) -> Array:
    """Unit vectors (N, 3) turned by small random angles about every axis, rad."""
    vector = std * rng.standard_normal(unit.shape)
    angle = np.linalg.norm(vector, axis=1, keepdims=True) + 1e-300
    axis = vector / angle
    along = np.sum(axis * unit, axis=1, keepdims=True)
    return unit * np.cos(angle) + np.cross(axis, unit) * np.sin(angle) + axis * along * (1 - np.cos(angle))


def surveys(seed: int, case: Case) -> Truth:
    rng = np.random.default_rng(seed)
    forward, first = array(rng, case.sensors)
    offset = first + case.apart_nT * rng.standard_normal((len(case.samples), *first.shape))
    offset = offset if case.apart_nT else offset[:1]
    parts, fields = [], []
    for k, count in enumerate(case.samples):
        total = FIELD_NT + 20.0 * np.sin(np.linspace(0, 5, count))
        level = None
        if case.levels:
            level = np.arange(count) * case.levels // count
            total = (FIELD_NT + 200.0 * rng.standard_normal(case.levels))[level]
        field = directions(rng, count, case.tilt_deg) * total[:, None]
        raw = np.einsum("sij,nj->nsi", forward, field) + offset[k if case.apart_nT else 0]
        raw = raw + case.noise_nT * rng.standard_normal(raw.shape)
        known = None
        if case.attitude_deg is not None:
            known = turned(rng, field / total[:, None], np.radians(case.attitude_deg))
        none = np.zeros(count, dtype=int)
        parts.append(Samples(raw, total if level is None else np.full(count, 48_000.0), none, none, level, known))
        fields.append(field)
    return Truth(case, forward, offset, np.concatenate(fields), joined(parts))


def fitted(truth: Truth) -> SurveysCalibration:
    found = fit_surveys(truth.samples, common_offsets=not truth.case.apart_nT, worst_error=1.0)
    return calibrated_surveys(found)


def true_matrix(truth: Truth) -> Array:
    """(S, 3, 3) in the frame, and with the scale, that the fit chooses where the data leave them open."""
    case, forward = truth.case, truth.forward
    matrix = np.linalg.inv(forward if case.attitude_deg is not None else forward @ nearest_frame(forward))
    return matrix * np.exp(-np.mean(np.linalg.slogdet(matrix)[1]) / 3) if case.levels else matrix


def in_scale(truth: Truth, found: ArrayCalibration) -> ArrayCalibration:
    return nominal_scale(found)[0] if truth.case.levels else found


@dataclass(frozen=True)
class Errors:
    """Of all surveys' parameters.

    Attributes:
        standardised: errors over their own standard deviations.
        square: Mahalanobis, by the stated covariance, over its rank.
        by_bound: squared error measured by the Cramer-Rao information, over its rank: 1 on average at the bound.
    """

    standardised: Array
    square: float
    by_bound: float


def errors(truth: Truth) -> Errors:
    found = fitted(truth)
    found = found.nominal() if truth.case.levels else found
    matrix, sensors = true_matrix(truth), truth.case.sensors
    error = np.concatenate([(found.common.matrix - matrix).ravel(), (found.offset - truth.offset).ravel()])
    std = np.sqrt(np.diag(found.covariance))
    values, vectors = np.linalg.eigh(found.covariance / np.outer(std, std))
    seen = values > 1e-10 * values[-1]
    z = error / std
    square = float(np.sum((vectors[:, seen].T @ z) ** 2 / values[seen])) / int(seen.sum())
    information = bound_information(truth)
    true_forward = np.linalg.inv(matrix)
    moved = np.concatenate(
        [(np.linalg.inv(found.common.matrix) - true_forward).ravel(), (found.offset - truth.offset).ravel()]
    )
    open_ = (0 if truth.case.attitude_deg is not None else 3) + bool(truth.case.levels)
    rank = 9 * sensors + 3 * sensors * len(truth.offset) - open_
    return Errors(z, square, float(moved @ information @ moved) / rank)


def require_as_stated(found: Sequence[Errors]) -> None:
    """Errors of many draws are as large as their standard deviations say."""
    pooled = np.array([f.standardised for f in found])
    assert np.mean(pooled**2) == pytest.approx(1.0, abs=0.25)
    assert 0.91 < np.mean(np.abs(pooled) < 1.96) < 0.985


def require_at_bound(found: Sequence[Errors], parameters: int) -> None:
    """Errors of many draws are those that noise allows, within four standard deviations of so many parameters."""
    uncertainty = 1 / np.sqrt(2 * len(found) * parameters)
    assert np.sqrt(np.mean([f.by_bound for f in found])) == pytest.approx(1.0, abs=4 * uncertainty)


def bound_information(truth: Truth) -> Array:
    """Fisher's information of C (row by row, sensor by sensor) and the offsets, in the frame and the scale of
    `true_matrix`, sample by sample: the field's direction projected off, its size too where it is an unknown constant.
    """
    case, sensors, count = truth.case, truth.case.sensors, len(truth.field)
    forward = np.linalg.inv(true_matrix(truth))
    to_frame = np.linalg.inv(truth.forward[0]) @ forward[0]  # a rotation and, without a reference, a scale
    field = np.linalg.solve(to_frame, truth.field.T).T
    size = 9 * sensors + 3 * sensors * len(truth.offset)
    length = np.linalg.norm(field, axis=1)
    unit = field / length[:, None]
    some = np.where(np.abs(unit[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(unit, some)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    prior = 0.0 if case.attitude_deg is None else (np.radians(case.attitude_deg) * length.mean()) ** -2
    levels = 0 if truth.samples.level is None else truth.samples.levels
    total, mixed, own = np.zeros((size, size)), np.zeros((size, levels)), np.zeros(levels)
    for n in range(count):
        jacobian = np.zeros((3 * sensors, size))
        for s in range(sensors):
            for i in range(3):
                jacobian[3 * s + i, 9 * s + 3 * i : 9 * s + 3 * i + 3] = field[n]
                jacobian[3 * s + i, 9 * sensors + 3 * sensors * truth.centre[n] + 3 * s + i] = 1.0
        tangents = np.stack([first[n], np.cross(unit[n], first[n])], axis=1)
        seen = (forward @ tangents).reshape(3 * sensors, 2) / case.noise_nT
        jacobian /= case.noise_nT
        weight = np.eye(3 * sensors) - seen @ np.linalg.solve(seen.T @ seen + prior * np.eye(2), seen.T)
        total += jacobian.T @ weight @ jacobian
        if levels:
            along = (forward @ unit[n]).ravel() / case.noise_nT
            level = truth.samples.level[n]
            mixed[:, level] += jacobian.T @ weight @ along
            own[level] += along @ weight @ along
    return total - (mixed / np.where(own > 0, own, 1.0)) @ mixed.T
