"""Whether a series of rotated tensors can determine the invariants' polynomials, judged against its noise.

Noise alone makes every design matrix regular: with a degenerate source the small singular values are noise and the
fit looks determined. So each direction of coefficients is measured in units of what noise contributes to it: the
generalised eigenvalues of the Gram matrix of the monomials against that of their derivatives (which noise
multiplies) are the noise variance in a direction that the true tensors leave empty, and larger in one they fill.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import NotEnoughData
from magtensor.tensor.invariant_polynomials import (
    PAIRS,
    TRIPLES,
    cubic_derivatives,
    cubic_monomials,
    quadratic_derivatives,
    quadratic_monomials,
)

Array = NDArray[np.float64]

QUADRIC_COEFFICIENTS = len(PAIRS) + 5
CUBIC_COEFFICIENTS = len(TRIPLES)

_ROUNDING = 1e-14  # the least noise variance assumed, of tensors of order one
_FALSE_ALARM = 1e-4
_CLEARLY_VARYING = 10.0  # times the noise variance; a component below does not carry a quadric
_CLEARLY_STRONG = 20.0  # times the noise; of a weaker source a component may be small in every attitude
_STANDING_STILL = 1e-6  # of the largest variance of a component: tilts of less than a degree


@dataclass(frozen=True)
class Excitation:
    """How far the weakest direction of a polynomial's coefficients stands above noise.

    Attributes:
        noise_std: nT/m, of one component.
        still: how many combinations of components do not vary beyond noise.
        weakest: variance of the weakest direction relative to that of noise; near 1 it is empty.
        needed: what `weakest` must exceed for it not to be noise.
        empty: number of empty directions, the quadric that every series has not counted.
    """

    noise_std: float
    still: int
    weakest: float
    needed: float
    empty: int


def enough_rotations(count: int) -> None:
    """NotEnoughData when `count` rotations cannot determine the quadric or the cubic."""
    for polynomial, needed in (("quadric", QUADRIC_COEFFICIENTS), ("cubic", CUBIC_COEFFICIENTS)):
        if count <= needed:
            raise NotEnoughData(
                f"{count} rotations cannot determine the {needed} coefficients of the {polynomial}",
                where="tensor",
                hint=f"more than {CUBIC_COEFFICIENTS} rotations are needed, some hundreds are right",
            )


def quadric_excitation(measured: Array) -> Excitation:
    """Of the quadric, from (N, 5) components in nT/m; the noise is that of the one quadric they must lie on."""
    from scipy.special import fdtri

    count = len(measured)
    centred = measured - measured.mean(axis=0)
    scale = float(np.sqrt(np.mean(np.sum(centred**2, axis=1))))
    if scale <= 1e-12 * np.abs(measured).max():
        return Excitation(0.0, 5, 0.0, 1.0, QUADRIC_COEFFICIENTS - 1)
    t = centred / scale
    spread = np.linalg.eigvalsh(np.cov(t.T))
    still = int(np.sum(spread < _STANDING_STILL * spread[-1]))
    if still:
        return Excitation(float(np.sqrt(max(spread[0], 0.0))) * scale, still, 0.0, 1.0, QUADRIC_COEFFICIENTS - 1)
    monomials = np.hstack([quadratic_monomials(t), t])
    derivatives = np.concatenate([quadratic_derivatives(t), np.broadcast_to(np.eye(5), (count, 5, 5))], axis=1)
    free = count - QUADRIC_COEFFICIENTS
    values = _in_noise_units(monomials - monomials.mean(axis=0), derivatives) * count / free
    noise = max(float(values[0]), _ROUNDING)
    needed = float(fdtri(free, free, 1 - _FALSE_ALARM))
    return Excitation(
        float(np.sqrt(noise)) * scale,
        int(np.sum(spread < _CLEARLY_VARYING * noise)),
        float(values[1]) / noise,
        needed,
        int(np.sum(values[1:] < needed * noise)),
    )


def cubic_excitation(measured: Array, centre: Array, magnitude: float, quadric: Excitation) -> Excitation:
    """Of the cubic, from (N, 5) components in nT/m whose offset is `centre`; noise as of the quadric.

    Parameters
    ----------
    magnitude : C_T of the source in nT/m.
    """
    from scipy.special import fdtri

    count = len(measured)
    t = (measured - centre) / magnitude
    free = count - CUBIC_COEFFICIENTS
    values = _in_noise_units(cubic_monomials(t), cubic_derivatives(t)) * count / free
    noise = max((quadric.noise_std / magnitude) ** 2, _ROUNDING)
    needed = float(fdtri(free, count - QUADRIC_COEFFICIENTS, 1 - _FALSE_ALARM))
    empty = int(np.sum(values < needed * noise))
    return Excitation(quadric.noise_std, quadric.still, float(values[0]) / noise, needed, empty)


def _in_noise_units(monomials: Array, derivatives: Array) -> Array:
    """Ascending eigenvalues of the Gram matrix of (N, p) monomials against that of (N, p, 5) derivatives."""
    from scipy.linalg import eigh

    noise = np.einsum("npa,nqa->pq", derivatives, derivatives, optimize=True)
    noise += _ROUNDING * np.trace(noise) * np.eye(len(noise))
    out: Array = eigh(monomials.T @ monomials, noise, eigvals_only=True)
    return out


def require_moving(found: Excitation, magnitude: float) -> None:
    """NotEnoughData when the source is too weak, or when some combinations of components stay as they are.

    Parameters
    ----------
    magnitude : C_T of the source in nT/m.
    """
    if magnitude < 5 * found.noise_std:
        raise NotEnoughData(
            f"the tensor's magnitude, {magnitude:.3g} nT/m, is too small against a noise of {found.noise_std:.3g} nT/m",
            where="tensor",
            hint="rotate nearer to the source",
        )
    if found.still:
        weak = magnitude < _CLEARLY_STRONG * found.noise_std
        raise NotEnoughData(
            f"{found.still} of the 5 independent combinations of components do not change beyond noise"
            + (f": {found.noise_std:.3g} nT/m, where the tensor's magnitude is {magnitude:.3g} nT/m" if weak else ""),
            where="tensor",
            hint=("rotate nearer to the source, and about all three axes" if weak else "rotate about all three axes")
            + ": rotation about a single axis leaves one part of the tensor the same",
        )


def refuse_degenerate_quadric(found: Excitation, magnitude: float, triaxiality: float) -> None:
    """NotEnoughData, with the likely reason, when I1 does not determine its 20 coefficients.

    Parameters
    ----------
    magnitude : C_T of the source in nT/m.
    triaxiality : |normalised determinant| of the source.
    """
    require_moving(found, magnitude)
    if found.weakest >= found.needed:
        return
    if triaxiality > 0.9:
        raise NotEnoughData(
            "the source is axisymmetric to within the noise (eigenvalues as 2, -1, -1; normalised determinant "
            f"{triaxiality:.4f}): {found.empty} further quadrics fit as well as I1",
            where="tensor",
            hint="leave the axis of the dipole: 60 to 80 degrees from its moment is best; or go nearer",
        )
    raise NotEnoughData(
        f"{found.empty} further quadrics fit the rotated tensors as well as I1 does",
        where="tensor",
        hint="rotate to more orientations about all three axes, or nearer to the source",
    )


def refuse_degenerate_cubic(found: Excitation, triaxiality: float) -> None:
    """NotEnoughData, with the likely reason, when I2 does not determine its 35 coefficients."""
    if found.weakest >= found.needed:
        return
    if triaxiality < 0.5:
        raise NotEnoughData(
            f"det G vanishes to within the noise (normalised determinant {triaxiality:.2g}): the sign of H is "
            "undetermined, -H fits as well",
            where="tensor",
            hint="leave the broadside of the dipole: 60 to 80 degrees from its moment is best; or go nearer",
        )
    raise NotEnoughData(
        f"{found.empty} of the 35 coefficients of I2 are not determined beyond the noise",
        where="tensor",
        hint="rotate to more orientations about all three axes, or nearer to the source",
    )
