"""Sui 2017: thirty coefficients of the tensor from its invariants while the array rotates near a source.

The steps of the paper are separate functions: offset from the quadric (eqs. 12-14), coefficients of I1 (eq. 16)
and of I2 (eq. 19), H from both. What judges the data and fixes the gauge is shared with other estimators.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magtensor import UsageError, method
from magtensor.tensor.elements import full, rotation_of_five
from magtensor.tensor.excitation import (
    cubic_excitation,
    enough_rotations,
    quadric_excitation,
    refuse_degenerate_cubic,
    refuse_degenerate_quadric,
)
from magtensor.tensor.invariant_polynomials import (
    PAIRS,
    cubic_derivatives,
    cubic_monomials,
    i1_coefficients,
    i2_coefficients,
    quadratic_monomials,
    symmetric_matrix,
)
from magtensor.tensor.invariants import invariants
from magtensor.tensor.refinement import (
    LEAST_SIMILARITY,
    UNIDENTIFIED,
    TensorCalibration,
    checked_components,
    checked_invariants,
    checked_prior,
    coefficient_rank,
    gauge_directions,
    gauge_projection,
    nearest_in_gauge,
    other_invariants,
    scale_verdict,
    similarity,
)
from magtensor_methods.tensor_options import Prior

Array = NDArray[np.float64]

WORST_MISFIT = 0.3  # of the 50 equations, relative; 0.05 is what noise makes of a barely sufficient series


@method("refine_invariants", source="Sui et al. 2017, eqs. 9-19")
def sui2017(
    tensor: Array,
    invariant_1: float | None,
    invariant_2: float | None,
    noise_covariance: Array | None = None,
    *,
    normalise_about: Annotated[
        Literal["mean", "zero"],
        Field(description="where the quadric of eq. 12 is 0 instead of 1: at the mean tensor, or at zero as printed"),
    ] = "mean",
    prior: Prior = None,
) -> TensorCalibration:
    """H and D of G5 = H T5 + D from I1 and I2, modulo the common rotation that no invariant shows.

    The paper writes the quadric as F(T) = 1 with F(0) = 0. Offsets larger than the signal put zero far outside the
    quadric, where that form weighs the noise badly; about the mean it does not.

    Parameters
    ----------
    tensor : (N, 3, 3) nT/m, measured while the array rotated about its centre in one place near a source; of a
        tensor that is not symmetric and traceless the part that is so is taken.
    invariant_1, invariant_2 : I1 = -1/2 sum G^2 in (nT/m)^2 and I2 = det G in (nT/m)^3 of the true tensor there.
    noise_covariance : not used; the paper weighs all alike.

    Raises
    ------
    NotEnoughData : too few rotations, rotation about one axis, an axisymmetric source, det G = 0, or too weak a
        source; judged against the noise in the data.
    DataError : tensors or invariants that are impossible, or no H near the prior fits them.
    """
    if invariant_1 is None or invariant_2 is None:
        raise UsageError(
            "sui2017 needs invariant_1 and invariant_2; where the source is not known, orbit_likelihood does with "
            "their being constant"
        )
    measured, start = checked_components(tensor), checked_prior(prior)
    magnitude, determinant = checked_invariants(invariant_1, invariant_2)
    enough_rotations(len(measured))
    quadric = quadric_excitation(measured)
    refuse_degenerate_quadric(quadric, magnitude, abs(determinant))

    origin = measured.mean(axis=0) if normalise_about == "mean" else np.zeros(5)
    equations = fit_polynomials((measured - origin) / magnitude, invariant_2 / magnitude**3)
    offset = origin + magnitude * equations.offset
    cubic = cubic_excitation(measured, offset, magnitude, quadric)
    refuse_degenerate_cubic(cubic, abs(determinant))

    solved = solve_coefficients(equations.y, equations.z, start)
    rotation, angle = nearest_in_gauge(solved, start)
    matrix = rotation_of_five(rotation) @ solved
    if similarity(matrix, start) < LEAST_SIMILARITY:
        raise other_invariants("the H that fits resembles the prior in no orientation")
    covariance = _covariance(equations, matrix, start, offset, magnitude)
    found = invariants(full(equations.t @ matrix.T))
    residual = np.sqrt(np.mean(np.square([found.i1 + 0.5, found.i2 - equations.i2]), axis=1))
    rank = coefficient_rank(measured / magnitude, matrix, -matrix @ offset / magnitude)
    return TensorCalibration(
        matrix=matrix,
        offset=-matrix @ offset,
        covariance=covariance,
        rank=rank,
        nullity=30 - rank,
        gauge=gauge_directions(matrix, -matrix @ offset),
        gauge_angle=angle,
        triaxiality=abs(determinant),
        noise_std=quadric.noise_std,
        residual_rms=(float(residual[0]), float(residual[1])),
        verdict=(UNIDENTIFIED, *scale_verdict(equations.t, magnitude)),
        diagnostics={
            "rotations": float(len(measured)),
            "quadric_condition": float(np.linalg.cond(np.hstack([quadratic_monomials(equations.t), 2 * equations.t]))),
            "cubic_condition": float(np.linalg.cond(cubic_monomials(equations.t))),
            "quadric_above_noise": quadric.weakest,
            "quadric_needed": quadric.needed,
            "cubic_above_noise": cubic.weakest,
            "cubic_needed": cubic.needed,
        },
    )


@dataclass(frozen=True)
class Equations:
    """The polynomials fitted to the rotated tensors, all in units of the tensor's magnitude.

    Attributes:
        u: (N, 5) components about the origin of the quadric; t: about the offset.
        x: (20,) of eq. 12; y: (15,) of eq. 16; z: (35,) of eq. 19.
        offset: (5,) O of eq. 14, from the origin of u.
        i2: det G.
    """

    u: Array
    t: Array
    x: Array
    y: Array
    z: Array
    offset: Array
    i2: float


def fit_polynomials(u: Array, i2: float) -> Equations:
    """Offset and polynomial coefficients by three least-squares fits (eqs. 12-14, 16, 19).

    Parameters
    ----------
    u : (N, 5) components about some origin, divided by the magnitude of the tensor, so that I1 is -1/2.
    i2 : det G divided by the magnitude cubed.
    """
    x = _least_squares(np.hstack([quadratic_monomials(u), 2 * u]), 1.0)
    offset = np.asarray(-np.linalg.solve(symmetric_matrix(x[:15]), x[15:]), dtype=np.float64)
    t = u - offset
    y = _least_squares(quadratic_monomials(t), -0.5)
    z = _least_squares(cubic_monomials(t), i2)
    return Equations(u, t, x, y, z, offset, i2)


def _least_squares(design: Array, value: float) -> Array:
    out: Array = np.linalg.lstsq(design, np.full(len(design), value), rcond=None)[0]
    return out


def solve_coefficients(y: Array, z: Array, start: Array) -> Array:
    """H (5, 5) from the 15 + 35 equations of eqs. 16 and 19: Levenberg-Marquardt from `start`, all weighted alike.

    Raises
    ------
    DataError : the equations stay unsolved, so that I1 and I2 do not belong to these tensors.
    """
    from scipy.optimize import least_squares

    target = np.concatenate([y, z])

    def residual(h: Array) -> Array:
        matrix = h.reshape(5, 5)
        return np.concatenate([i1_coefficients(matrix)[0], i2_coefficients(matrix)[0]]) - target

    def jacobian(h: Array) -> Array:
        matrix = h.reshape(5, 5)
        return np.vstack([i1_coefficients(matrix)[1], i2_coefficients(matrix)[1]])

    found = least_squares(residual, start.ravel(), jacobian, method="lm", xtol=1e-12, ftol=1e-12, max_nfev=500)
    misfit = float(np.linalg.norm(found.fun) / np.linalg.norm(target))
    if misfit > WORST_MISFIT:
        raise other_invariants(f"the 50 equations for H stay {misfit:.0%} off")
    out: Array = found.x.reshape(5, 5)
    return out


def _covariance(equations: Equations, matrix: Array, start: Array, offset: Array, magnitude: float) -> Array:
    """(30, 30) of H row by row and D, in the fixed gauge.

    The three fits are one system of estimating equations, each sample's influence on x, y and z follows from the
    derivatives, and the sum of squared influences is the covariance whatever the distribution of the noise
    (first order in it). H then follows from y and z through the pseudo-inverse of the 50 equations.
    """
    e = equations
    quadric = np.hstack([quadratic_monomials(e.u), 2 * e.u])
    forms, cubes = quadratic_monomials(e.t), cubic_monomials(e.t)
    on_x = -_influence(quadric, quadric @ e.x - 1)
    turned = np.einsum("ncd,d->nc", _symmetric_matrices(on_x[:, :15]), e.offset)
    on_offset: Array = -(on_x[:, 15:] + turned) @ np.linalg.inv(symmetric_matrix(e.x[:15]))
    slope_y = -2 * e.t @ symmetric_matrix(e.y)
    slope_z = -np.einsum("npc,p->nc", cubic_derivatives(e.t), e.z)
    on_y = -_influence(forms, forms @ e.y + 0.5) - on_offset @ np.linalg.lstsq(forms, slope_y, rcond=None)[0].T
    on_z = -_influence(cubes, cubes @ e.z - e.i2) - on_offset @ np.linalg.lstsq(cubes, slope_z, rcond=None)[0].T
    equations_jacobian = np.vstack([i1_coefficients(matrix)[1], i2_coefficients(matrix)[1]])
    to_matrix = gauge_projection(matrix, start) @ np.linalg.pinv(equations_jacobian, rcond=1e-8)
    on_matrix = np.hstack([on_y, on_z]) @ to_matrix.T
    on_d = -on_matrix.reshape(-1, 5, 5) @ offset - magnitude * on_offset @ matrix.T
    influence = np.hstack([on_matrix, on_d])
    out: Array = influence.T @ influence
    return out


def _influence(design: Array, residual: Array) -> Array:
    """(N, p): what each sample's residual (fitted less given) takes off the coefficients of a least-squares fit."""
    out: Array = (design * residual[:, None]) @ np.linalg.inv(design.T @ design)
    return out


def _symmetric_matrices(coefficients: Array) -> Array:
    out = np.zeros((len(coefficients), 5, 5))
    i, j = PAIRS.T
    out[:, i, j] = out[:, j, i] = coefficients
    return out
