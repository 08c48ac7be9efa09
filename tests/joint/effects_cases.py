"""Surveys of one array whose outputs follow a temperature, and the fit of both together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from joint_cases import Array
from several_cases import Case, Truth, surveys, true_matrix

from magtensor.calibration.surveys.corrections import calibrated_surveys
from magtensor.calibration.surveys.samples import Samples
from magtensor.components import component_of
from magtensor.effect_errors import SurveysWithCoefficients, surveys_with_coefficients
from magtensor.loop.fitting.model import Adopted, Record
from magtensor.loop.fitting.several import SurveysState, Together, surveys_state
from magtensor_effects import temperature

Model = Callable[..., Any]
PER_DEGREE_NT, PER_DEGREE_PPM = 2.0, 40.0


@dataclass(frozen=True)
class Warmed:
    """Surveys with an effect.

    Attributes:
        truth: without it; samples: with it.
        degrees: (N,) about the mean of the first survey; theta: (S, 3) nT/degC, or ppm/degC of the output.
        model: that describes it.
    """

    truth: Truth
    samples: Samples
    degrees: Array
    theta: Array
    model: Model


def warmed(seed: int, case: Case, model: Model) -> Warmed:
    """Each survey three degrees warmer than the one before, rising by five and wandering."""
    truth = surveys(seed, case)
    rng = np.random.default_rng(seed + 90_000)
    courses = []
    for k, count in enumerate(case.samples):
        time = np.linspace(0.0, 1.0, count)
        courses.append(20.0 + 3.0 * k + 5.0 * time + np.sin(9.0 * time + rng.uniform(0, 6)))
    degrees = np.concatenate(courses) - courses[0].mean()
    theta = rng.standard_normal((case.sensors, 3))
    if model is temperature.temperature_offset:
        theta *= PER_DEGREE_NT
        effect = theta * degrees[:, None, None]
    else:
        theta *= PER_DEGREE_PPM
        clean = np.einsum("sij,nj->nsi", truth.forward, truth.field) + truth.offset[truth.centre]
        effect = 1e-6 * theta * degrees[:, None, None] * clean
    return Warmed(truth, replace(truth.samples, raw=truth.samples.raw + effect), degrees, theta, model)


def with_slow_noise(of: Warmed, seed: int, rms_nT: float) -> Warmed:
    """The surveys with noise whose power goes with 1 / f, down to half a turn in each survey."""
    rng, parts = np.random.default_rng(seed + 80_000), []
    for count in of.truth.case.samples:
        frequency = np.maximum(np.fft.rfftfreq(2 * count), 0.5 / count)
        size = (len(frequency), of.samples.raw[0].size)
        spectrum = (rng.standard_normal(size) + 1j * rng.standard_normal(size)) / np.sqrt(frequency)[:, None]
        noise = np.fft.irfft(spectrum, axis=0)[:count]
        parts.append(rms_nT * noise / noise.std(axis=0))
    raw = of.samples.raw + np.concatenate(parts).reshape(of.samples.raw.shape)
    return replace(of, samples=replace(of.samples, raw=raw))


def records(of: Warmed) -> list[Record]:
    """Of each survey, with its thermometer."""
    found = []
    for k in range(of.samples.surveys):
        own = of.samples.at(of.samples.survey == k)
        count, known = len(own.raw), own.total_field if own.level is None else None
        none = np.zeros(count, dtype=int)
        degrees, units = {"temperature": of.degrees[of.samples.survey == k]}, {"temperature": "degC"}
        names = tuple(f"S{s + 1}" for s in range(own.raw.shape[1]))
        one = Record(
            np.arange(count) * 1.0, 0.0, own.raw, known, known, names, degrees, {"temperature": np.array(0.0)}, units,
            none, none, None, None, np.arange(count),
        )  # fmt: skip
        found.append(one)
    return found


def fitted(of: Warmed, **options: Any) -> SurveysState:
    component = component_of(of.model)
    assert component is not None
    adopted = [Adopted(component, {})]
    options = {"common_offsets": not of.truth.case.apart_nT, "worst_error": 1.0} | options
    together = Together(of.samples, records(of), [adopted] * of.samples.surveys, options, bool(of.truth.case.levels))
    return surveys_state(together)


def calibrated(of: Warmed, state: SurveysState) -> SurveysWithCoefficients:
    found = surveys_with_coefficients(state, calibrated_surveys(state.fit))
    return found.nominal() if of.truth.case.levels else found


def joint_covariance(found: SurveysWithCoefficients) -> Array:
    """Of the matrices, the offsets of all surveys and the coefficients."""
    return np.block([[found.calibration.covariance, found.mixed], [found.mixed.T, found.theta]])


def parameters(found: SurveysWithCoefficients) -> Array:
    calibration = found.calibration
    return np.concatenate([calibration.common.matrix.ravel(), calibration.offset.ravel(), found.values])


def true_parameters(of: Warmed) -> Array:
    return np.concatenate([true_matrix(of.truth).ravel(), of.truth.offset.ravel(), of.theta.ravel()])


def square(error: Array, covariance: Array) -> tuple[float, int]:
    """Mahalanobis, by the directions that have a variance, and how many these are."""
    std = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    seen = values > 1e-10 * values[-1]
    return float(np.sum((vectors[:, seen].T @ (error / std)) ** 2 / values[seen])), int(seen.sum())
