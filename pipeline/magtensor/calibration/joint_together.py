"""The joint fit of samples that are all at hand, with the noise of every output and the samples to believe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError, NotEnoughData

from .by_sensor import by_sensor
from .common_field import CommonField, common_field, output_noise
from .coverage import coverage_alone, require_coverage
from .maximum_likelihood import CHUNK, ScalarFit, along, fit_scalar
from .noise import shares_of_two
from .scalar import checked_samples
from .types import Array, Mask
from .whole_record import Limits

FALSE_REJECTION = 0.01  # probability that one clean sample of the whole survey is rejected
LEAST_FOR_REJECTION = 50  # with fewer samples the fit bends to an outlier, and no residual can tell which it was
ABOUT = 25  # samples that a sample lies among
MOSTLY = 2 / 3  # of them
_TOLD_APART = 2  # rounds after which the noise of two sensors no longer moves


@dataclass(frozen=True)
class Together:
    """Samples: raw (N, S, 3) nT, total_field (N,) nT, and the run (N,) of consecutive ones that each belongs to."""

    raw: Array
    total_field: Array
    run: NDArray[np.int_]


@dataclass(frozen=True)
class Found:
    """Their fit: the plane, the calibration in it, and the samples (N,) that were believed."""

    plane: CommonField
    scalar: ScalarFit
    keep: Mask


def fit_together(
    part: Together, *, noise: Array | None, reference_noise: float, judge: bool, complete: bool = True
) -> Found:
    """The joint fit of samples; the parameters are those of `joint.fit_recording`.

    Raises
    ------
    NotEnoughData, DataError: as there.
    """
    raw, total_field = part.raw, part.total_field
    for sensor in range(raw.shape[1]):
        checked_samples(raw[:, sensor], total_field)
    sensors, enough = raw.shape[1], len(raw) >= LEAST_FOR_REJECTION
    judge = judge and enough
    keep = np.ones(len(raw), dtype=bool)
    own_noise = noise is None and sensors > 1 and enough
    given = output_noise(raw, keep, part.run) if own_noise else noise
    two = sensors == 2 and noise is None and given is not None
    for round_ in range(20):
        plane = common_field(raw, given, keep)
        scalar = _scalar(plane, part, keep, reference_noise, complete)
        if sensors == 1 and noise is None:
            # one sensor has no neighbour to find its noise by: the residual along the field is all there is
            plane, scalar = _by_own_residual(plane, scalar, part, keep, reference_noise, complete)
        if two and given is not None and round_ < _TOLD_APART:
            given = told_apart(given, unfolded(plane, scalar), raw, total_field)
            continue
        if not judge:
            break
        squares = _squared_residuals(plane, scalar, part, reference_noise)
        limits = limits_from(squares, len(plane.noise) - 3, len(raw))
        again = ~among_their_like((squares[0] > limits.along) | (squares[1] > limits.across))
        if np.array_equal(again, keep):
            break
        if again.sum() < 0.5 * len(raw):
            raise NotEnoughData(
                "more than half of the samples disagree with any one calibration",
                hint="look for a moving magnetic object, a dead axis or wrong units",
            )
        keep = again
        if own_noise:
            given = output_noise(raw, keep, part.run)  # a spike passes for noise until it is left out
            if two:
                given = told_apart(given, unfolded(plane, scalar), raw, total_field)
    return Found(plane, scalar, keep)


def among_their_like(doubted: Mask) -> Mask:
    """(N,) doubted samples, and others that two thirds of those about them are: a sensor that is wrong for a while
    comes near what is right now and then, and what is then believed of it spoils the fit."""
    from scipy.ndimage import uniform_filter1d

    if np.count_nonzero(doubted) < MOSTLY * ABOUT:
        return doubted
    return doubted | (uniform_filter1d(doubted.astype(float), ABOUT, mode="nearest") > MOSTLY)


def unfolded(plane: CommonField, scalar: ScalarFit) -> tuple[Array, Array]:
    """C (S, 3, 3) and o (S, 3) nT of every sensor from the plane and the calibration in it."""
    c = plane.basis @ np.linalg.inv(scalar.matrix)
    off_plane = plane.mean - plane.basis @ (plane.basis.T @ plane.mean)
    o = plane.basis @ scalar.offset + off_plane
    return (c * plane.noise[:, None]).reshape(-1, 3, 3), (o * plane.noise).reshape(-1, 3)


def limits_of(found: Found, part: Together, reference_noise: float, samples: int) -> Limits:
    """What squared whitened residuals noise explains, at `FALSE_REJECTION` for a survey of so many samples."""
    squares = _squared_residuals(found.plane, found.scalar, part, reference_noise)
    return limits_from(squares, len(found.plane.noise) - 3, samples)


def limits_from(squares: tuple[Array, Array], freedom: int, samples: int) -> Limits:
    """Scaled by the median, so that outliers cannot hide each other."""
    from scipy.special import chdtri

    level = FALSE_REJECTION / (samples * (2 if freedom else 1))
    most = [
        float(chdtri(f, level)) * max(float(np.median(values)) / float(chdtri(f, 0.5)), 1e-300) if f else np.inf
        for values, f in zip(squares, (1, freedom), strict=True)
    ]
    return Limits(*most)


def _scalar(plane: CommonField, part: Together, keep: Mask, reference_noise: float, complete: bool) -> ScalarFit:
    y = plane.coordinates(part.raw)
    try:
        return fit_scalar(y[keep], part.total_field[keep], reference_noise, complete)
    except DataError:
        require_coverage(coverage_alone(part.raw[keep, 0], part.total_field[keep])[0])
        raise


def _by_own_residual(
    plane: CommonField, scalar: ScalarFit, part: Together, keep: Mask, reference_noise: float, complete: bool
) -> tuple[CommonField, ScalarFit]:
    """Plane and fit of a single sensor whose noise is the one that its residual shows."""
    factor = float(np.sqrt(scalar.chi2))
    plane = common_field(part.raw, np.full((1, 3), float(plane.noise[0]) * factor), keep)
    if reference_noise > 0:
        return plane, _scalar(plane, part, keep, reference_noise, complete)
    return plane, scalar.with_noise(factor)


def told_apart(noise: Array, found: tuple[Array, Array], raw: Array, total_field: Array) -> Array:
    """(2, 3) nT: the noise that two sensors' contrast shows, given to each as the total field tells them apart."""
    forward, offset = found
    b = by_sensor(np.linalg.pinv(forward, rcond=1e-9), raw - offset)
    out: Array = np.sqrt(np.sum(noise**2, axis=0) * shares_of_two(b, total_field)[:, None])
    return out


def _squared_residuals(
    plane: CommonField, scalar: ScalarFit, part: Together, reference_noise: float
) -> tuple[Array, Array]:
    """Squared whitened residuals (N,) along the field, and summed across the plane."""
    along_, across = np.empty(len(part.raw)), np.zeros(len(part.raw))
    for start in range(0, len(part.raw), CHUNK):
        some = slice(start, start + CHUNK)
        y = plane.coordinates(part.raw[some]).T
        seen = along(scalar.matrix, scalar.offset, y, part.total_field[some], reference_noise)
        along_[some] = seen.residual**2
        if len(plane.noise) > 3:
            across[some] = np.sum(plane.residual(part.raw[some]) ** 2, axis=1)
    return along_, across
