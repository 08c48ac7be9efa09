"""Thirty coefficients of the tensor by maximum likelihood on the orbit, the true invariants known or only constant."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magtensor import DataError, NotEnoughData, UsageError, method
from magtensor.calibration.types import Array
from magtensor.tensor.elements import METRIC, full, rotation_of_five
from magtensor.tensor.excitation import quadric_excitation, require_moving
from magtensor.tensor.invariants import invariants
from magtensor.tensor.orbit import shape_angle
from magtensor.tensor.orbit_fit import (
    LEAST_ROTATIONS,
    Determination,
    Likelihood,
    corrected,
    covariance,
    determination,
    explicable,
    near,
    search,
    shape_offset,
)
from magtensor.tensor.refinement import (
    LEAST_SIMILARITY,
    UNIDENTIFIED,
    TensorCalibration,
    checked_components,
    checked_invariants,
    checked_prior,
    gauge_directions,
    gauge_projection,
    nearest_in_gauge,
    other_invariants,
    scale_verdict,
    similarity,
)
from magtensor_methods.tensor_options import Prior

SCALE_UNIDENTIFIED = (
    "the scale of the corrected tensor is unidentified: only that its invariants are constant was used; given is the "
    "factor that makes det H that of the prior, and the standard deviations do not hold its error"
)
SIGN_OF_THE_PRIOR = "det G vanishes to within the noise: no data tell H from -H; given is the sign of the prior"
SIGNIFICANT = 4.0  # standard deviations
NOISE_TWICE = 2.0  # with the fewest rotations allowed the quadric's own noise is uncertain by a quarter
WORST_MISFIT = 0.03  # of C_T, beyond noise: a source known to a few per cent does no more


@method("refine_invariants", source="maximum likelihood with the unknown rotation of each sample eliminated")
def orbit_likelihood(
    tensor: Array,
    invariant_1: float | None,
    invariant_2: float | None,
    noise_covariance: Array | None = None,
    *,
    prior: Prior = None,
    robust: Annotated[bool, Field(description="leave out samples that no noise explains")] = True,
) -> TensorCalibration:
    """H and D of G5 = H T5 + D by maximum likelihood: every true tensor is Q G0 Q' for some rotation Q.

    The model is that of Sui 2017 (eqs. 8, 9), the criterion the distance of the readings from the orbit, weighed by
    the noise; so it is unbiased where the paper's polynomials of noisy readings are not. Both invariants given: 27 of
    30 coefficients, a common rotation stays open. Without I2 the shape of the source is estimated too. Without both,
    their constancy alone is used and the scale of H stays open as well; what is left is determined all the same,
    the shape of the source (its normalised determinant) included.

    Parameters
    ----------
    tensor : (N, 3, 3) nT/m, measured while the array rotated about its centre in one place near a source; of a
        tensor that is not symmetric and traceless the part that is so is taken.
    invariant_1, invariant_2 : I1 = -1/2 sum G^2 in (nT/m)^2 and I2 = det G in (nT/m)^3 of the true tensor there;
        None where they are not known.
    noise_covariance : (5, 5) of xx, xy, xz, yy, yz in (nT/m)^2; its size is estimated from the fit. Equal and
        independent noise where not given.

    Raises
    ------
    NotEnoughData : too few rotations, rotation about one axis, an axisymmetric source or too weak a one: the
        information in some direction of the coefficients is no more than noise makes.
    DataError : tensors or invariants that are impossible, or no H near the prior fits them.
    UsageError : I2 without I1.
    """
    measured, start = checked_components(tensor), checked_prior(prior)
    if invariant_1 is None and invariant_2 is not None:
        raise UsageError("invariant_2 is given without invariant_1; give both, I1 alone, or neither")
    _refuse_few(len(measured))
    magnitude, angle = _source(invariant_1, invariant_2)
    unit = magnitude or float(np.sqrt(np.mean(np.var(measured, axis=0) @ np.diag(METRIC)))) or 1.0
    spread = np.eye(5) if noise_covariance is None else noise_covariance / np.mean(np.diag(noise_covariance))
    whiten = np.linalg.inv(np.linalg.cholesky(spread))
    readings, mixing_prior = measured @ whiten.T / unit, whiten @ np.linalg.inv(start)
    first = near(readings) if robust else np.ones(len(readings), dtype=bool)
    quadric_noise = _noise_of_moving(measured[first], magnitude)
    found, judged, kept = _fit(readings, mixing_prior, angle, first, robust)

    offset = unit * np.linalg.inv(whiten) @ found.surface.offset
    solved = np.asarray(np.linalg.inv(found.surface.mixing) @ whiten)
    scale = 1.0 if magnitude else float(abs(np.linalg.det(start) / np.linalg.det(solved)) ** 0.2)
    rotation, turned = nearest_in_gauge(scale * solved, start)
    matrix = scale * rotation_of_five(rotation) @ solved
    if similarity(matrix, start) < LEAST_SIMILARITY:
        if magnitude:
            raise other_invariants("the H that fits resembles the prior in no orientation")
        raise DataError(
            "the H that keeps the invariants constant resembles the prior in no orientation",
            where="tensor",
            hint="check the order, signs and units of the components, and the prior",
        )
    gauge = gauge_directions(matrix, -matrix @ offset)
    if not magnitude:
        gauge = np.vstack([gauge, np.concatenate([matrix.ravel(), -matrix @ offset])])
    noise = float(np.sqrt(found.variance)) * unit
    shape, shape_step, shape_std = found.surface.angle, *shape_offset(found)
    verdict = [UNIDENTIFIED]
    if magnitude:
        verdict += scale_verdict((measured[kept] - offset) / magnitude, magnitude)
    else:
        verdict.append(SCALE_UNIDENTIFIED)
    if abs(np.pi / 6 - shape) < SIGNIFICANT * shape_std:
        verdict.append(SIGN_OF_THE_PRIOR)
    if angle is not None and abs(shape_step) > SIGNIFICANT * shape_std:
        _refuse_other_shape(readings[kept], mixing_prior, found)
        verdict.append(
            f"the tensors ask for a normalised determinant of {np.cos(3 * (angle + shape_step)):.4f}, the invariants "
            f"give {np.cos(3 * angle):.4f}, {abs(shape_step) / shape_std:.1f} standard deviations apart: check them"
        )
    if noise > NOISE_TWICE * quadric_noise:
        verdict.append(
            f"the orbit leaves {noise:.3g} nT/m, the quadric through the readings {quadric_noise:.3g} nT/m: the source "
            "changed, the given invariants are not its own, or there is a better maximum that was not found"
        )
    if not kept.all():
        verdict.append(f"{np.sum(~kept)} of {len(kept)} rotations left out: no noise explains them")
    corrected_ones = invariants(full((measured[kept] - offset) @ matrix.T))
    size, determinant = scale * unit, float(np.cos(3 * shape))
    residual = [corrected_ones.i1 / size**2 + 0.5, corrected_ones.i2 / size**3 - determinant / (3 * np.sqrt(6))]
    return TensorCalibration(
        matrix=matrix,
        offset=-matrix @ offset,
        covariance=_covariance(found, whiten, matrix, offset, unit, start, scale_free=not magnitude),
        rank=30 - len(gauge),
        nullity=len(gauge),
        gauge=gauge,
        gauge_angle=turned,
        triaxiality=abs(determinant),
        noise_std=noise,
        residual_rms=(float(np.sqrt(np.mean(residual[0] ** 2))), float(np.sqrt(np.mean(residual[1] ** 2)))),
        verdict=tuple(verdict),
        diagnostics={
            "rotations": float(len(measured)),
            "left_out": float(np.sum(~kept)),
            "information_above_noise": judged.weakest,
            "information_needed": judged.needed,
            "narrowest_radius_in_noise": judged.narrowest,
            "normalised_determinant": determinant,
            "normalised_determinant_std": float(3 * abs(np.sin(3 * shape)) * shape_std),
        },
    )


def _fit(
    readings: Array, prior: Array, angle: float | None, first: NDArray[np.bool_], robust: bool
) -> tuple[Likelihood, Determination, NDArray[np.bool_]]:
    """The maximum, its determination, and the readings kept."""
    surface = search(readings[first], prior, angle)
    kept = explicable(readings, surface) if robust else first
    if (kept != first).any():
        _refuse_few(int(kept.sum()))
        surface = search(readings[kept], prior, angle)
        kept = explicable(readings, surface)
        _refuse_few(int(kept.sum()))
    found = Likelihood.at(readings[kept], surface, angle is not None)
    judged = determination(found)
    if judged.weakest < judged.needed:
        if angle is not None:
            _refuse_other_shape(readings[kept], prior, found)
        raise _undetermined(judged, found)
    return corrected(readings[kept], surface, angle is not None), judged, kept


def _refuse_few(count: int) -> None:
    if count < LEAST_ROTATIONS:
        raise NotEnoughData(
            f"{count} rotations cannot determine 27 coefficients: each gives two equations",
            where="tensor",
            hint=f"at least {LEAST_ROTATIONS} rotations are needed, a hundred are right",
        )


def _source(invariant_1: float | None, invariant_2: float | None) -> tuple[float | None, float | None]:
    """C_T in nT/m and the angle of the shape, None where not known."""
    if invariant_1 is None:
        return None, None
    magnitude, determinant = checked_invariants(invariant_1, 0.0 if invariant_2 is None else invariant_2)
    return magnitude, None if invariant_2 is None else shape_angle(determinant)


def _refuse_other_shape(readings: Array, prior: Array, found: Likelihood) -> None:
    """DataError when a source of another shape fits, and by much better than noise or a slip of a few per cent."""
    free = Likelihood.at(readings, search(readings, prior, None), shape_known=False)
    judged = determination(free)
    if judged.weakest < judged.needed or found.variance < 2 * free.variance + WORST_MISFIT**2:
        return
    raise other_invariants(
        f"their normalised determinant would be {np.cos(3 * found.surface.angle):.3g}, the tensors ask for "
        f"{np.cos(3 * free.surface.angle):.3g}"
    )


def _undetermined(judged: Determination, found: Likelihood) -> NotEnoughData:
    """The refusal, with the likely reason, when some coefficients are not determined beyond the noise."""
    if judged.narrowest < 4:
        what = (
            "the source is axisymmetric to within the noise (eigenvalues as 2, -1, -1; normalised determinant "
            f"{np.cos(3 * found.surface.angle):.4f})"
        )
        hint = "leave the axis of the dipole: 60 to 80 degrees from its moment is best; or go nearer"
    else:
        what = "the rotations do not determine the coefficients"
        hint = "rotate to more orientations about all three axes, or nearer to the source"
    if judged.empty:
        what += f": {judged.empty} directions of them, besides the common rotation, hold no more than noise"
    return NotEnoughData(what, where="tensor", hint=hint)


def _noise_of_moving(measured: Array, magnitude: float | None) -> float:
    """Noise in nT/m from the quadric that the readings lie on.

    NotEnoughData when some combinations of the components stay the same, whatever the instrument.
    """
    found = quadric_excitation(measured)
    size = magnitude or float(np.sqrt(np.mean(np.var(measured, axis=0) @ np.diag(METRIC))))
    require_moving(found, size)
    return found.noise_std


def _covariance(
    found: Likelihood, whiten: Array, matrix: Array, offset: Array, unit: float, prior: Array, scale_free: bool
) -> Array:
    """(30, 30) of H row by row and D in the fixed gauge, from that of the mixing and the offset."""
    back = np.linalg.inv(whiten)
    # T = mixing G + offset with mixing = back @ surface.mixing and H its inverse but for the fixed rotation and scale
    turn = matrix @ back @ found.surface.mixing
    by_mixing = -np.kron(matrix @ back, np.linalg.solve(turn, matrix).T)
    project = gauge_projection(matrix, prior)
    if scale_free:
        project = project - np.outer(matrix.ravel(), np.linalg.inv(matrix).T.ravel()) @ project / 5
    to = np.zeros((30, 31))
    to[:25, :25] = project @ by_mixing
    to[25:, :25] = -np.kron(np.eye(5), offset) @ to[:25, :25]
    to[25:, 25:30] = -unit * matrix @ back
    out: Array = to @ covariance(found) @ to.T
    return out
