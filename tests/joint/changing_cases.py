"""Surveys of an array whose C changes linearly with the date, and the bound that noise sets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from joint_cases import FIELD_NT, Array, array, directions
from several_cases import Errors, turned

from magtensor.calibration.joint import nearest_frame
from magtensor.calibration.surveys.changing import ChangingFit, fit_changing
from magtensor.calibration.surveys.covariance import covariance_of
from magtensor.calibration.surveys.dated import dated
from magtensor.calibration.surveys.samples import Samples, joined
from magtensor.calibration.surveys.straight import straight


@dataclass(frozen=True)
class Case:
    """What is drawn: samples and date (years) of each survey, and the size of what changes.

    Attributes:
        rate: per year, of every element of C1; offset_rate: nT per year, where offsets are "linear".
        offsets: "own", "common" or "linear"; apart_nT: scatter of own ones.
        attitude_deg: standard deviation of the attitude; None without one.
        scatter: of every element of C about the line, between surveys.
    """

    samples: tuple[int, ...] = (150, 100, 100, 50)
    years: tuple[float, ...] = (0.0, 0.4, 1.1, 2.5)
    sensors: int = 4
    tilt_deg: float | None = None
    rate: float = 2e-4
    offsets: str = "own"
    apart_nT: float = 30.0
    offset_rate: float = 10.0
    attitude_deg: float | None = None
    scatter: float = 0.0
    noise_nT: float = 1.0


@dataclass(frozen=True)
class Truth:
    """forward (2, S, 3, 3), C at the mean date and its change per year; offset (J, S, 3) nT and, per year, its change;
    of_survey (K, S, 3, 3), fields (K arrays (n, 3) nT) and the samples with noise."""

    case: Case
    forward: Array
    offset: Array
    of_survey: Array
    fields: list[Array]
    samples: Samples

    @property
    def since(self) -> Array:
        years = np.array(self.case.years)
        return years - years.mean()

    @property
    def parameters(self) -> Array:
        return np.concatenate([self.forward.ravel(), self.offset.ravel()])

    def weights(self, k: int) -> tuple[Array, Array]:
        """Of C0 and C1, and of the offsets, in survey k."""
        line = np.array([1.0, self.since[k]])
        own = np.eye(len(self.fields))[k]
        return line, {"own": own, "common": line[:1], "linear": line}[self.case.offsets]


def without_common_rotation(change: Array) -> Array:
    """(S, 3, 3) whose sum is symmetric."""
    skew = (change.mean(axis=0) - change.mean(axis=0).T) / 2
    return change - skew


def surveys(seed: int, case: Case) -> Truth:
    """Drawn so that the sum of all C is symmetric at every date, or, with an attitude, anyhow."""
    rng = np.random.default_rng(seed)
    c0, first = array(rng, case.sensors)
    shape = (len(case.samples), *c0.shape)
    c1, off = case.rate * rng.standard_normal(c0.shape), case.scatter * rng.standard_normal(shape)
    if case.attitude_deg is None:
        c0, c1 = c0 @ nearest_frame(c0), without_common_rotation(c1)
        off = np.stack([without_common_rotation(o) for o in off])
    offset = {
        "own": first + case.apart_nT * rng.standard_normal((len(case.samples), *first.shape)),
        "common": first[None],
        "linear": np.stack([first, case.offset_rate * rng.standard_normal(first.shape)]),
    }[case.offsets]
    since = np.array(case.years) - np.mean(case.years)
    of_survey = c0 + since[:, None, None, None] * c1 + off
    begun = Truth(case, np.stack([c0, c1]), offset, of_survey, [np.empty(0)] * len(since), Samples(*[np.empty(0)] * 4))
    parts, fields = [], []
    for k, count in enumerate(case.samples):
        total = FIELD_NT + 20.0 * np.sin(np.linspace(0, 5, count))
        field = directions(rng, count, case.tilt_deg) * total[:, None]
        raw = np.einsum("sij,nj->nsi", of_survey[k], field) + np.tensordot(begun.weights(k)[1], offset, axes=1)
        raw = raw + case.noise_nT * rng.standard_normal(raw.shape)
        known = None
        if case.attitude_deg is not None:
            known = turned(rng, field / total[:, None], np.radians(case.attitude_deg))
        none = np.zeros(count, dtype=int)
        parts.append(Samples(raw, total, none, none, None, known))
        fields.append(field)
    return Truth(case, begun.forward, offset, of_survey, fields, joined(parts))


def fitted(truth: Truth, **options: object) -> ChangingFit:
    years, offsets = np.array(truth.case.years), truth.case.offsets
    return fit_changing(truth.samples, years, offsets=offsets, worst_error=1.0, **options)  # type: ignore[arg-type]


def information_of(forward: Array, field: Array, noise: float, prior: float) -> Array:
    """Fisher's information (12 S, 12 S) of C (row by row) and o of each sensor from samples of one survey: the field's
    direction projected off, as far as a known one (prior, its information in 1/nT^2) does not tell it."""
    sensors = len(forward)
    total = np.zeros((12 * sensors, 12 * sensors))
    for b in field:
        u = b / np.linalg.norm(b)
        across = np.linalg.svd(u[None])[2][1:].T
        jacobian = np.kron(np.eye(sensors), np.hstack([np.kron(np.eye(3), b), np.eye(3)])) / noise
        seen = (forward @ across).reshape(3 * sensors, 2) / noise
        weight = np.eye(3 * sensors) - seen @ np.linalg.solve(seen.T @ seen + prior * np.eye(2), seen.T)
        total += jacobian.T @ weight @ jacobian
    return total


def bound_information(truth: Truth) -> Array:
    """Fisher's information of C0, C1 (sensor by sensor, row by row), then the offsets."""
    sensors, case = truth.case.sensors, truth.case
    total = np.zeros((len(truth.parameters),) * 2)
    prior = 0.0 if case.attitude_deg is None else (np.radians(case.attitude_deg) * FIELD_NT) ** -2
    of_c = np.concatenate([12 * s + np.arange(9) for s in range(sensors)])
    of_o = np.concatenate([12 * s + 9 + np.arange(3) for s in range(sensors)])
    for k, field in enumerate(truth.fields):
        own = information_of(truth.of_survey[k], field, case.noise_nT, prior)
        matrices, offsets = truth.weights(k)
        jacobian = np.zeros((12 * sensors, len(truth.parameters)))
        jacobian[of_c, : 18 * sensors] = np.kron(matrices, np.eye(9 * sensors))
        jacobian[of_o, 18 * sensors :] = np.kron(offsets, np.eye(3 * sensors))
        total += jacobian.T @ own @ jacobian
    return total


def errors(truth: Truth) -> Errors:
    """Of C0, C1 and all offsets."""
    fit = fitted(truth)
    error = fit.parameters - truth.parameters
    covariance = covariance_of(fit.design, fit.said, fit.alike.chi2_along)
    rank = len(error) - (0 if truth.case.attitude_deg is not None else 6)
    std = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    seen = slice(len(values) - rank, None)
    z = error / std
    square = float(np.sum((vectors[:, seen].T @ z) ** 2 / values[seen])) / rank
    return Errors(z, square, float(error @ bound_information(truth) @ error) / rank)


def at_another_date(truth: Truth, years: float, seed: int) -> tuple[Array, Array]:
    """Errors over their standard deviations, so many years after the first survey: (S, 12) of C^-1 and o of a survey
    that was not in the fit, its C off the line by as much as those of the others; and (S, 9) of the rate."""
    fit, case = fitted(truth), truth.case
    later = dated(fit, straight(fit), 0).after(years)
    t = truth.since[0] + years
    rng = np.random.default_rng([seed, 1])
    line = truth.forward[0] + t * truth.forward[1]
    own = line + without_common_rotation(case.scatter * rng.standard_normal(line.shape))
    offset = truth.offset[0] + (t * truth.offset[1] if case.offsets == "linear" else 0.0)
    off = later.calibration.matrix - np.linalg.inv(own)
    error = np.concatenate([off.reshape(-1, 9), later.calibration.offset - offset], axis=1)
    std = np.sqrt(np.diag(later.calibration.covariance)).reshape(-1, 12)
    rate = later.change.rate - truth.forward[1] @ np.linalg.inv(line)
    of_rate = np.sqrt(np.diag(later.change.covariance).reshape(2, -1, 12)[1, :, :9])
    return error / std, rate.reshape(-1, 9) / of_rate
