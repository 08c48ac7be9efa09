"""The joint fit of several surveys whose C changes linearly with their dates, C(t) = C0 + (t - mean) C1.

All samples of all surveys in one likelihood (`said`), its maximum by scoring from the fit of one C. The noise, the
samples to believe and what the attitudes determine are found by `fit_surveys` from outputs whose change has been taken
off with the field that the fit finds; the two take turns until neither moves.

What no survey can see, a rotation that all its sensors share, is fixed at every date by one convention: the sum of all
C is symmetric, so the frame is the one nearest to the raw axes and the common rotation has the rate zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibration.by_sensor import by_sensor
from magtensor.calibration.coverage import WORST_ERROR, require_coverage
from magtensor.calibration.joint_together import LEAST_FOR_REJECTION
from magtensor.calibration.postures import attitude_design, sphere
from magtensor.calibration.types import Array
from magtensor.errors import DataError, NotEnoughData

from .about import about_line, own_deviation
from .colour import with_colour
from .covariance import covariance_of
from .design import Design, inverse_in, summed_up
from .fit import SurveysFit, fit_surveys, fitted, frame_of, require_usable
from .said import OneSurvey, Said, View, each_of, said, view
from .samples import Samples
from .sums import SYMMETRIC

LEAST_SPAN = 1.0 / 365.25  # years between the first and the last survey
_ROUNDS = 12
_SETTLED = 0.01  # of the noise
_MOST_STEPS = 60
_LEAST_SHARE = 1e-6  # of a step


@dataclass(frozen=True)
class ChangingFit:
    """The fit, in the frame nearest to the raw axes at every date, or the platform's where directions are known.

    Attributes:
        alike: of the same surveys, the change taken off: noise, samples kept, coverage.
        design: of the parameters; years: (K,) dates less their mean.
        parameters: (P,); said: of every survey, at these parameters.
    """

    alike: SurveysFit
    design: Design
    years: Array
    parameters: Array
    said: tuple[Said, ...]


def fit_changing(
    samples: Samples,
    years: Array,
    *,
    matrices: str = "linear",
    offsets: str = "own",
    reference_noise: float = 0.0,
    attitude: float | None = None,
    robust: bool = True,
    worst_error: float = WORST_ERROR,
) -> ChangingFit:
    """Fit C of all sensors and their offsets to several surveys, of which one at least changes with the date.

    Parameters
    ----------
    samples: finite, their total field known; years: (K,) date of each survey.
    matrices: "linear" in the date, or "common"; offsets: "own" of each survey, "common", or "linear".
    reference_noise, attitude, robust, worst_error: as in `fit_surveys`.

    Raises
    ------
    NotEnoughData: as in `fit_surveys`; or the surveys do not determine a change.
    DataError: the surveys have one date; and as in `fit_surveys`.
    """
    if np.ptp(years) < LEAST_SPAN:
        raise DataError("the surveys have one date, where a change of C with time takes two at least")
    if samples.level is not None:
        raise DataError("a total field that is unknown in each survey hides a change of all sensitivities")
    since = years - years.mean()
    require_usable(samples)
    shared = offsets != "own"
    every = np.ones(len(samples.raw), dtype=bool)
    alike = fitted(samples, every, None, shared, reference_noise, attitude, worst_error)  # nothing is judged by it
    design = _design(alike, since, matrices, offsets)
    parameters, judge = _start(alike, design), False
    for _ in range(_ROUNDS):
        parameters, found = _maximised(samples, alike, design, parameters)
        taken_off = _alike(samples, design, parameters, found, alike.chi2_along)
        before = alike
        alike = fit_surveys(
            taken_off,
            common_offsets=shared,
            reference_noise=reference_noise,
            attitude=attitude,
            robust=judge,
            worst_error=worst_error,
        )
        design = _design(alike, since, matrices, offsets)
        moved = np.abs(alike.plane.noise / before.plane.noise - 1.0).max()
        if moved < _SETTLED and np.array_equal(before.keep, alike.keep):
            if judge or not robust:
                break
            judge = True  # not before: until a survey's own change is known it may look like spikes
    parameters, _ = _maximised(samples, alike, design, parameters)
    seen = _seen(each_of(samples.at(alike.keep), alike.data), design, parameters)
    found = tuple(with_colour(one, said(one), len(seen)) for one in seen)
    fit = ChangingFit(alike, design, since, parameters, found)
    require_coverage(replace(alike.coverage, worst_error=predicted_error(fit)))
    return fit


def _design(alike: SurveysFit, since: Array, matrices: str, offsets: str) -> Design:
    line = np.column_stack([np.ones(len(since)), since])
    weights = {"own": np.eye(len(since)), "common": line[:, :1], "linear": line}[offsets]
    noise = alike.plane.noise
    count = len(alike.data.y)
    if count < LEAST_FOR_REJECTION and len(noise) > 3:  # found from the residual, which knew of no change
        lost = 3 + len(alike.offset)
        noise = noise * np.sqrt(
            (count - lost) / max(count - lost - 3 * (matrices == "linear") - (offsets == "linear"), 1)
        )
    return Design(line if matrices == "linear" else line[:, :1], weights, noise, alike.attitude_std is not None)


def _start(alike: SurveysFit, design: Design) -> Array:
    c = np.zeros((design.matrices.shape[1], *alike.forward.shape))
    c[0] = alike.forward @ frame_of(alike.forward, design.sighted)
    o = np.zeros((design.offsets.shape[1], *alike.offset.shape[1:]))
    o[: len(alike.offset)] = alike.offset
    return np.concatenate([c.ravel(), o.ravel()])


def _maximised(
    samples: Samples, alike: SurveysFit, design: Design, parameters: Array
) -> tuple[Array, tuple[Said, ...]]:
    """The parameters of least cost, by scoring, and what every survey says there."""
    surveys = each_of(samples.at(alike.keep), alike.data)
    jacobians, free = [design.whitened(k) for k in range(len(surveys))], design.free()

    def at(where: Array) -> tuple[Said, ...]:
        return tuple(said(one) for one in _seen(surveys, design, where))

    here = at(parameters)
    for _ in range(_MOST_STEPS):
        score = np.sum([j.T @ one.score for j, one in zip(jacobians, here, strict=True)], axis=0)
        step = inverse_in(free, summed_up(jacobians, [one.information for one in here])) @ score
        cost, promised = sum(one.cost for one in here), float(score @ step)
        freedom = max(sum(one.samples for one in here) * (len(design.noise) - 2) - len(parameters), 1)
        if promised < 1e-6 * cost / freedom:  # of 1e-3 standard deviations
            return parameters, here
        share = 1.0
        while share > _LEAST_SHARE:
            there = at(parameters + share * step)
            rise = sum(one.cost for one in there) - cost
            if rise <= 1e-12 * cost:
                break
            # along the step the cost is next to a parabola, which begins with the slope -2 promised
            best = share**2 * promised / (rise + 2.0 * share * promised)
            share = max(best, share / 10.0) if np.isfinite(rise) else share / 10.0
        else:
            break
        parameters, here = parameters + share * step, there
    raise NotEnoughData("the fit does not converge", hint="look for disturbed samples, or add attitudes")


def _seen(surveys: list[OneSurvey], design: Design, parameters: Array) -> list[View]:
    return [view(one, *design.forward(parameters, k), design.noise) for k, one in enumerate(surveys)]


def _alike(
    samples: Samples, design: Design, parameters: Array, surveys: tuple[Said, ...], chi2_along: float
) -> Samples:
    """The samples as the surveys would have given them with C0, and with the mean offset where offsets change too: what
    a survey's own C lies off the line is taken off as well, so that it passes neither for noise nor for spikes."""
    raw = samples.raw.copy()
    shared = not design.own_offsets
    _, variance = about_line(design, surveys, chi2_along)
    first = (np.eye(1, terms)[0] for terms in (design.matrices.shape[1], design.offsets.shape[1]))
    mean = design.at(*first) @ parameters
    c0, o0 = mean.reshape(-1, 12)[:, :9].reshape(-1, 3, 3), mean.reshape(-1, 12)[:, 9:]
    for k, one in enumerate(surveys):
        own = samples.survey == k
        c, o = design.forward(parameters, k)
        off_c, off_o = own_deviation(design, one, variance, not shared)
        seen = view(OneSurvey(samples.raw[own], samples.total_field[own]), c + off_c, o + off_o, design.noise)
        raw[own] += by_sensor(c0 - c - off_c, seen.field)
        raw[own] += o0 - o if shared else -off_o
    return replace(samples, raw=raw)


def predicted_error(fit: ChangingFit) -> float:
    """nT: the predicted error of |b|, of b where directions are known, in the worst direction at the worst date."""
    covariance = covariance_of(fit.design, fit.said, fit.alike.chi2_along)
    u = sphere()
    worst = 0.0
    for k, one in enumerate(fit.said):
        own = one.to_field @ fit.design.whitened(k)
        spread = own @ covariance @ own.T
        field = float(np.sqrt(np.trace(one.sums.moments[0, :3, :3]) / one.samples))
        if len(own) == SYMMETRIC + 3:
            length = attitude_design(u) * np.concatenate([np.full(SYMMETRIC, field), np.ones(3)])
            error = np.einsum("ni,ij,nj->n", length, spread, length)
        else:
            each = np.concatenate([field * u, np.ones((len(u), 1))], axis=1)
            error = np.zeros(len(u))
            for i in range(3):
                at = [3 * i, 3 * i + 1, 3 * i + 2, 9 + i]
                error += np.einsum("ni,ij,nj->n", each, spread[np.ix_(at, at)], each)
        worst = max(worst, float(np.sqrt(error.max())))
    return worst
