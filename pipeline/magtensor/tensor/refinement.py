"""What a refinement of the tensor by its invariants is, and its gauge.

The correction of five measured components T5 is G5 = H T5 + D (Sui 2017 eq. 9). The invariants do not change
when all corrected tensors turn together, so H and D are known only up to a common rotation Q: S(Q) H and S(Q) D
fit exactly as well, S(Q) being the 5x5 representation of Q.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError, UsageError
from magtensor.tensor.elements import GENERATORS, METRIC, NINE_OF_FIVE, five, full, rotation_of_five

Array = NDArray[np.float64]

LEAST_SIMILARITY = 0.8  # of H to the prior; errors of 20 degrees and 30 % leave 0.93

UNIDENTIFIED = (
    "the orientation of the corrected tensor is unidentified: rotating all of it changes no invariant; given is "
    "the representative nearest to the prior"
)


@dataclass(frozen=True)
class TensorCalibration:
    """The correction G5 = matrix @ T5 + offset of the components xx, xy, xz, yy, yz.

    Attributes:
        matrix: (5, 5) dimensionless, H of Sui 2017 eq. 9.
        offset: (5,) nT/m, D of eq. 9.
        covariance: (30, 30) of H row by row, then D; zero along the gauge, whose choice is a convention.
        rank, nullity: how many of the 30 coefficients the data determine, and how many they leave open.
        gauge: (nullity, 30) the changes of the coefficients that no data determine: a small rotation about x, y, z;
            and a common factor where the source's magnitude was not given.
        gauge_angle: rad, by which the solver's result was turned to the representative nearest to the prior.
        triaxiality: |det G| scaled to 1 for an axisymmetric source (eigenvalues 2, -1, -1), where 15 coefficients
            are lost, and 0 where one eigenvalue vanishes and the sign of H is lost.
        noise_std: nT/m, of one component, estimated from the fit.
        residual_rms: of I1 and I2 after the correction, relative to (C_T)^2 and (C_T)^3.
        verdict: what a user has to know, in words.
        diagnostics: further figures.
    """

    matrix: Array
    offset: Array
    covariance: Array
    rank: int
    nullity: int
    gauge: Array
    gauge_angle: float
    triaxiality: float
    noise_std: float
    residual_rms: tuple[float, float]
    verdict: tuple[str, ...]
    diagnostics: Mapping[str, float] = field(default_factory=dict)

    def apply(self, tensor: Array) -> Array:
        """Corrected tensors (..., 3, 3) nT/m, symmetric and traceless, from measured ones."""
        return full(five(tensor) @ self.matrix.T + self.offset)


def checked_components(tensor: Array) -> Array:
    """(N, 5) components of rotated tensors (N, 3, 3) nT/m.

    Raises
    ------
    DataError : of another shape, or not finite.
    """
    t = np.asarray(tensor, dtype=float)
    if t.ndim != 3 or t.shape[1:] != (3, 3):
        raise DataError(f"the tensor has shape {t.shape}", where="tensor", hint="(time, 3, 3) is right")
    missing = int(np.sum(~np.isfinite(t).all(axis=(1, 2))))
    if missing:
        raise DataError(
            f"{missing} of {len(t)} tensors are not finite", where="tensor", hint="leave flagged samples out"
        )
    return five(t)


def checked_invariants(invariant_1: float, invariant_2: float) -> tuple[float, float]:
    """C_T in nT/m and the normalised determinant of a tensor with these invariants.

    Raises
    ------
    DataError : no gradient tensor has them.
    """
    if not (np.isfinite(invariant_1) and np.isfinite(invariant_2) and invariant_1 < 0):
        raise DataError(
            f"I1 = {invariant_1} and I2 = {invariant_2} are no invariants of a gradient tensor",
            where="invariant_1, invariant_2",
            hint="I1 = -1/2 sum G^2 is negative, in (nT/m)^2; I2 = det G is in (nT/m)^3",
        )
    determinant = normalised_determinant(invariant_1, invariant_2)
    if abs(determinant) > 1 + 1e-6:
        raise DataError(
            f"no traceless tensor has I1 = {invariant_1:.6g} (nT/m)^2 and I2 = {invariant_2:.6g} (nT/m)^3: its "
            f"determinant would be {abs(determinant):.4g} times the largest possible",
            where="invariant_1, invariant_2",
            hint="the two must be of the same tensor, in nT/m",
        )
    return float(np.sqrt(-2 * invariant_1)), determinant


def checked_prior(prior: list[list[float]] | None) -> Array:
    """H (5, 5) to start from; the identity when not given."""
    start = np.asarray(np.eye(5) if prior is None else prior, dtype=np.float64)
    if start.shape != (5, 5) or not np.isfinite(start).all() or abs(np.linalg.det(start)) < 1e-6:
        raise UsageError("prior must be an invertible matrix of 5 rows of 5 numbers, in the order xx, xy, xz, yy, yz")
    return start


def other_invariants(what: str) -> DataError:
    """The error for tensors that do not belong to the given invariants."""
    return DataError(
        f"the rotated tensors do not belong to these invariants: {what}",
        where="invariant_1, invariant_2",
        hint="check the sign and the units of I1, (nT/m)^2, and of I2, (nT/m)^3, and the prior",
    )


def scale_verdict(offset_free: Array, magnitude: float) -> tuple[str, ...]:
    """A word of warning when the measured tensors (N, 5), divided by C_T, are far from unit magnitude."""
    seen = float(np.sqrt(np.mean(np.einsum("na,ab,nb->n", offset_free, METRIC, offset_free))))
    if 0.8 < seen < 1.25:
        return ()
    return (
        f"the tensors vary as if C_T were {seen * magnitude:.4g} nT/m, the invariants say {magnitude:.4g} nT/m: "
        "H makes up for it; check the units",
    )


def normalised_determinant(invariant_1: float, invariant_2: float) -> float:
    """det G as a fraction of the largest that a tensor of this magnitude can have; between -1 and 1."""
    return float(3 * np.sqrt(6) * invariant_2 / (-2 * invariant_1) ** 1.5)


def invariant_jacobian(measured: Array, matrix: Array, offset: Array) -> Array:
    """d(I1, I2)/d(H row by row, D) at all samples, (2 N, 30).

    Parameters
    ----------
    measured : (N, 5) in units in which the tensors are of order one.
    """
    g = measured @ matrix.T + offset
    whole = full(g)
    cofactors = np.stack([np.cross(whole[:, (i + 1) % 3], whole[:, (i + 2) % 3]) for i in range(3)], axis=1)
    slopes = (-g @ METRIC, cofactors.reshape(-1, 9) @ NINE_OF_FIVE)
    by_matrix = [np.einsum("na,nb->nab", slope, measured).reshape(-1, 25) for slope in slopes]
    return np.vstack([np.hstack([m, slope]) for m, slope in zip(by_matrix, slopes, strict=True)])


def coefficient_rank(measured: Array, matrix: Array, offset: Array) -> int:
    """How many of the 30 coefficients the two invariants at all samples determine; 27 at most.

    Parameters as in `invariant_jacobian`. Noise fills directions that the true tensors leave empty:
    `magtensor.tensor.excitation` tells those apart.
    """
    jacobian = invariant_jacobian(measured, matrix, offset)
    singular = np.linalg.svd(jacobian, compute_uv=False)
    return int(np.sum(singular > 1e-9 * singular[0]))


def gauge_directions(matrix: Array, offset: Array) -> Array:
    """(3, 30): the change of H row by row and of D for a small rotation of the corrected tensors about x, y, z."""
    return np.stack([np.concatenate([(k @ matrix).ravel(), k @ offset]) for k in GENERATORS])


def nearest_in_gauge(matrix: Array, target: Array) -> tuple[Array, float]:
    """The rotation Q (3, 3) that brings S(Q) `matrix` nearest to `target`, and its angle in rad.

    Near in the norm tr(X' METRIC X METRIC^-1), which itself does not depend on the orientation of the axes.
    Gauss-Newton steps from the nearest of the rotations of a cube and an icosahedron: a far target does no harm.
    """
    from scipy.spatial.transform import Rotation

    left = np.asarray(np.linalg.cholesky(METRIC).T, dtype=np.float64)
    right = np.asarray(np.linalg.inv(left), dtype=np.float64)
    goal = left @ target @ right
    starts = np.concatenate([Rotation.create_group(group).as_matrix() for group in "OI"])
    distance = np.linalg.norm(left @ rotation_of_five(starts) @ matrix @ right - goal, axis=(1, 2))
    rotation = starts[int(np.argmin(distance))]
    for _ in range(50):
        turned = left @ rotation_of_five(rotation) @ matrix @ right
        slope = np.stack([(left @ k @ right @ turned).ravel() for k in GENERATORS], axis=1)
        step = np.linalg.lstsq(slope, (goal - turned).ravel(), rcond=None)[0]
        rotation = Rotation.from_rotvec(step).as_matrix() @ rotation
        if np.linalg.norm(step) < 1e-13:
            break
    return rotation, float(Rotation.from_matrix(rotation).magnitude())


def similarity(matrix: Array, target: Array) -> float:
    """Cosine of the angle between two corrections in the norm of `nearest_in_gauge`: 1 if alike but for scale."""
    weigh = lambda a, b: float(np.sum((METRIC @ a @ np.linalg.inv(METRIC)) * b))  # noqa: E731
    return weigh(matrix, target) / float(np.sqrt(weigh(matrix, matrix) * weigh(target, target)))


def gauge_projection(matrix: Array, target: Array) -> Array:
    """(25, 25): how errors of H change when the gauge is fixed again by `nearest_in_gauge`.

    At the nearest representative <K_k H, target> = 0 for the three generators K; an error dH is followed by the
    small rotation that restores it.
    """
    weigh = METRIC @ target @ np.linalg.inv(METRIC)
    moved = np.stack([(k @ matrix).ravel() for k in GENERATORS], axis=1)
    condition = np.stack([(k.T @ weigh).ravel() for k in GENERATORS])
    out: Array = np.eye(25) - moved @ np.linalg.solve(condition @ moved, condition)
    return out
