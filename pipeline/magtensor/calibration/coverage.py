"""Do the attitudes determine the nine parameters of a scalar calibration? If not, which are missing?

Two questions are asked, because either alone can be fooled.

1. Is there one quadric only? Raw output lies on the sensor's ellipsoid. If a second quadric passes through the
   samples as well (a plane pair when the rotation was planar, a cone when it was about one axis), any mixture of
   the two fits, and a tiny residual says nothing. Taubin's distance, sqrt(v'Dv / v'Gv) with D the Gram matrix of
   the design and G that of its gradients, is the root-mean-square distance in nT of the samples to the quadric v,
   and pure noise of standard deviation s puts it at s. So the second smallest distance must exceed the smallest
   by a clear factor. Where two quadrics fit to within the noise, the two squared distances are the eigenvalues
   l1 <= l2 of a Wishart matrix with n = N - 8 degrees of freedom, and 2 sqrt(l1 l2)/(l1 + l2) <= w with
   probability w^(n-1) (the sphericity test in two dimensions). The factor required is the one that this null
   exceeds once in a thousand, and never below ten: at ten, noise makes up 1 % of the information in the weakest
   direction, and the attenuation it causes stays as small.
2. Are the predicted errors tolerable? The error of |b| in the worst direction of the whole sphere must stay
   below a stated fraction of F. It has two parts. The scatter follows from the covariance of the fit, at the
   95 % upper bound of the noise that the residual of N - 9 degrees of freedom allows. The bias is what an
   algebraic fit makes of noise in its regressors, the larger the less the attitudes determine; to first order in
   the noise all algebraic fits scatter alike and differ by their bias alone, so the difference from the nearest
   quadric (which has none in that order) shows it. This catches what is unique but weak: few samples, small
   tilts, and a fit that has turned noise into a scale factor and then finds its own attitudes perfect.

With many samples noise alone would pass the second question; with ten samples it may pass the first. The bounds are
not watertight for the fewest samples: over wobbling planar rotations, of the fits accepted with ten samples some
4 in 100, with eleven 1 in 100, and with twenty none in 600 erred by more than four times the prediction.

`WORST_ERROR` is a choice: 5 % of F is the size of a sensor's uncalibrated errors, and twelve postures within +-20
deg at 1 nT mostly stay below it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from magtensor.errors import MissingAttitudes, NotEnoughData

from .covariance import scalar_noise
from .factors import factor
from .postures import Further, attitude_design, further_postures, further_together, sphere
from .quadric import NotAnEllipsoid, ellipsoid_of, fit_ellipsoid, gradient_normalised, nearest_quadrics
from .types import Array

LEAST_ATTITUDES = 9
LEAST_SAMPLES = 10  # nine parameters and one sample to judge them by
FALSE_ALARM = 1e-3  # probability that noise alone passes for a second, distinct quadric
LEAST_RATIO = 10.0
RESOLUTION = 1e-6  # of F: below this no sensor follows a quadric, so a smaller distance is no evidence
WORST_ERROR = 0.05  # of F
UNSEEN = 45.0  # deg: a half axis with no sample nearer counts as never seen
SCATTERED = 0.5  # of the accepted error: samples so far from the surface are disturbed, whatever their attitudes
SAME_ATTITUDE = 1e-3  # of F
SAME_POSTURE = 0.1  # of the unit sphere's radius
FAR_FROM_NOMINAL = 3.0  # scale factors this far from nominal come from a fit that found a surface, not a sensor


@dataclass(frozen=True)
class Cone:
    """A cone of field directions, in the sensor's axes, that holds no sample."""

    axis: tuple[float, float, float]
    half_angle_deg: float

    def __str__(self) -> str:
        x, y, z = self.axis
        return f"{self.half_angle_deg:.0f} deg around ({x:+.2f}, {y:+.2f}, {z:+.2f})"


@dataclass(frozen=True, eq=False)
class Attitudes:
    """Where the samples of one sensor lie; what follows from it is found when it is asked for: a search fits thousands
    of times and asks for hardly any of it.

    Attributes:
        directions: (M, 3) of the field in the sensor's axes, thinned out.
        information: (9, 9), the sum of a a' over all samples, a the derivatives of `attitude_design`.
        samples: how many those are.
        held: how many a further posture would add.
        chosen: the postures that would help most, where they have been chosen for all sensors together.
    """

    directions: Array
    information: Array
    samples: int
    held: float
    chosen: Further | None = None

    @cached_property
    def empty_cones(self) -> tuple[Cone, ...]:
        return _empty_cones(self.directions)

    @cached_property
    def unseen(self) -> tuple[str, ...]:
        return _unseen(self.directions)

    @cached_property
    def further(self) -> Further:
        return self.chosen or further_postures(self.information, self.samples, self.held)


@dataclass(frozen=True)
class Coverage:
    """What the attitudes of one sensor's samples can determine.

    Attributes:
        samples, distinct: number of samples, and of attitudes that differ by more than 0.1 % of F.
        condition_number: of the Jacobian of |b|/F with dimensionless parameters.
        distance: nT, root-mean-square distance of the samples to the quadric nearest to them.
        second_distance: nT, the same for the next quadric; the larger, the better the coverage.
        required_distance: nT, what `second_distance` has to exceed.
        worst_error: nT, predicted error of |b| in the worst direction of the sphere; infinite where it cannot be
            predicted, NaN where no fit was given.
        accepted_error: nT, what `worst_error` may reach.
        still: axes whose output never changed by more than 0.1 % of F.
        attitudes: where the samples lie.
        least_samples, least_attitudes: fewer are refused unseen.
    """

    samples: int
    distinct: int
    condition_number: float
    distance: float
    second_distance: float
    required_distance: float
    worst_error: float
    accepted_error: float
    still: tuple[str, ...]
    attitudes: Attitudes
    least_samples: int = LEAST_SAMPLES
    least_attitudes: int = LEAST_ATTITUDES

    @property
    def empty_cones(self) -> tuple[Cone, ...]:
        """The largest cones of directions without a sample, largest first."""
        return self.attitudes.empty_cones

    @property
    def unseen(self) -> tuple[str, ...]:
        """Half axes ("+x" ... "-z") that the field never came near."""
        return self.attitudes.unseen

    @property
    def further(self) -> Further:
        """The postures that would help most; none where the attitudes are spread well."""
        return self.attitudes.further

    @property
    def faults(self) -> tuple[str, ...]:
        """Why the nine parameters are not determined; empty where they are."""
        found = []
        if self.samples < self.least_samples or self.distinct < self.least_attitudes:
            found.append(
                f"{self.samples} samples in {self.distinct} distinct attitudes, "
                f"where {self.least_attitudes} attitudes and {self.least_samples} samples are the least"
            )
        elif self.second_distance <= self.required_distance:
            found.append(
                f"no ellipsoid comes nearer to the samples than {self.distance:.3g} nT rms"
                if self.scattered
                else "a second quadric surface, which stands for another calibration, passes within "
                f"{self.second_distance:.3g} nT of the samples (beyond {self.required_distance:.3g} nT they would tell "
                "the two apart)"
            )
        elif self.worst_error > self.accepted_error:
            found.append(
                f"the predicted error of |b| reaches {self.worst_error:.3g} nT "
                f"in some direction ({self.accepted_error:.3g} nT is accepted)"
            )
        return tuple(found)

    @property
    def scattered(self) -> bool:
        """Whether the samples lie so far from any ellipsoid that their attitudes cannot be judged."""
        return self.distance > SCATTERED * self.accepted_error

    @property
    def determined(self) -> bool:
        """Whether the attitudes determine the nine parameters."""
        return not self.faults

    @property
    def missing(self) -> str:
        """The attitudes that are missing, in words; empty where the directions are well spread."""
        words = []
        if self.still:
            words.append(f"the {' and '.join(self.still)} output never changed by 0.1 % of the field")
        if self.unseen:
            words.append(f"the field never came within {UNSEEN:.0f} deg of the sensor's {', '.join(self.unseen)}")
        if self.empty_cones:
            words.append(f"largest cone without a sample: {self.empty_cones[0]}")
        return "; ".join(words)


def coverage(
    raw: Array,
    total_field: Array,
    *,
    matrix: Array | None = None,
    offset: Array | None = None,
    worst_error: float = WORST_ERROR,
    noise: float | None = None,
    stands_for: int | None = None,
) -> Coverage:
    """Judge the attitudes of one sensor, with the fit where there is one.

    Parameters
    ----------
    raw: (N, 3) nT, finite.
    total_field: (N,) nT, positive.
    matrix, offset: the fitted correction b = matrix @ (m - offset); without them only the quadrics are judged.
    worst_error: accepted error of |b| in the worst direction, as a fraction of F.
    noise: nT, of the samples, where it is known otherwise than by their distance to the surface: a misfit that the
        model has yet to explain is then not taken for it.
    stands_for: of how many samples these are an even selection; all of them entered the fit.
    """
    count = len(raw) if stands_for is None else stands_for
    field = float(np.mean(total_field))
    centre = np.zeros(3) if offset is None else offset
    points = (centre + (raw - centre) * (field / total_field)[:, None]) / field
    nearest = nearest_quadrics(points)
    first, second = (float(d) for d in nearest.distance[:2])
    found = first * np.sqrt(len(raw) / max(len(raw) - 9, 1))
    level = max(found if noise is None else min(found, noise / field), RESOLUTION)
    believable = _believable(raw, total_field, centre)
    directions = seen_directions(raw, total_field, centre)
    worst = float("nan")
    attitude = attitude_design(directions)
    condition = _condition(attitude)
    if matrix is not None:
        b = (raw - centre) @ matrix.T
        fitted = attitude_design(b / np.linalg.norm(b, axis=1, keepdims=True))
        if believable:
            attitude, condition = fitted, _condition(fitted)
        scatter = _scatter(fitted, matrix, centre, raw, total_field) * np.sqrt(len(raw) / count)
        worst = float(np.hypot(scatter, _bias(matrix, centre / field, nearest.coefficients) * field))
    thinned = directions[_distinct(directions, 0.02)]
    distinct = len(_distinct(points, SAME_ATTITUDE))
    return Coverage(
        samples=count,
        distinct=distinct,
        condition_number=condition,
        distance=first * field,
        second_distance=second * field,
        required_distance=required_ratio(len(raw)) * level * field,
        worst_error=worst,
        accepted_error=worst_error * field,
        still=tuple(a for a, spread in zip("xyz", np.ptp(points, axis=0), strict=True) if spread < SAME_ATTITUDE),
        attitudes=Attitudes(thinned, attitude.T @ attitude, len(raw), _held(directions)),
    )


def seen_directions(raw: Array, total_field: Array, offset: Array) -> Array:
    """Directions (N, 3) of the field in the sensor's axes, from raw (N, 3), total_field (N,) and offset (3,) nT.

    From the centre of a surface that lies within a cluster of samples, they would seem to lie all round: an offset
    that leaves lengths far from the total field is not taken off.
    """
    out = raw - offset if _believable(raw, total_field, offset) else raw
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return np.divide(out, length, out=np.zeros_like(out), where=length > 0)


def _believable(raw: Array, total_field: Array, offset: Array) -> bool:
    reach = float(np.median(np.linalg.norm(raw - offset, axis=1)) / np.mean(total_field))
    return 1 / FAR_FROM_NOMINAL < reach < FAR_FROM_NOMINAL


def same_postures(found: Sequence[Coverage], unit: Sequence[Array], turn: Array) -> list[Coverage]:
    """The coverage of the sensors of one array with further postures that are the same for all.

    Parameters
    ----------
    found: of each sensor alone; unit: its directions (N, 3).
    turn: (S, 3, 3) from common axes to those of each sensor.
    """
    designs = [attitude_design(u) for u in unit]
    together = further_together(
        np.array([a.T @ a for a in designs]), turn, [len(a) for a in designs], [_held(u) for u in unit]
    )
    return [
        replace(own, attitudes=replace(own.attitudes, chosen=further))
        for own, further in zip(found, together, strict=True)
    ]


def coverage_alone(raw: Array, total_field: Array) -> tuple[Coverage, Array]:
    """What the samples of one sensor determine, raw (N, 3) and total_field (N,) in nT, judged with the ellipsoid that
    is nearest to them where there is one; and its centre (3,) nT, else zero."""
    try:
        nearest = fit_ellipsoid(raw, total_field, gradient_normalised)
    except NotAnEllipsoid:
        return replace(coverage(raw, total_field), worst_error=float("inf")), np.zeros(3)
    matrix = factor(nearest.shape, "polar")
    return coverage(raw, total_field, matrix=matrix, offset=nearest.offset), nearest.offset


def require_coverage(found: Coverage) -> None:
    """Refuse a fit whose attitudes do not determine it.

    Raises
    ------
    MissingAttitudes: with the condition number and the directions that were never seen.
    NotEnoughData: the samples are disturbed, so that nothing can be said of their attitudes.
    """
    if found.determined:
        return
    if found.scattered and found.distinct >= found.least_attitudes:
        raise NotEnoughData(
            f"{'; '.join(found.faults)}, so they determine no scale factors, angles and offsets",
            hint="look for spikes, stuck or saturated values, the wrong reference, or a moving magnetic object",
        )
    missing = f": {found.missing}" if found.missing else ""
    help_most = f"; what would help most is {found.further}" if str(found.further) else ""
    raise MissingAttitudes(
        f"the attitudes do not determine scale factors, angles and offsets: {'; '.join(found.faults)}; "
        f"condition number {found.condition_number:.2g}{missing}",
        hint="turn the sensor so that the field passes through these directions too, about more than one axis"
        f"{help_most}",
    )


def required_ratio(samples: int) -> float:
    """How much farther the second quadric must lie than the first (question 1 of the module)."""
    freedom = samples - 8
    if freedom < 2:
        return float("inf")
    w = FALSE_ALARM ** (1.0 / (freedom - 1))
    return max(LEAST_RATIO, float((1 + np.sqrt(1 - w**2)) / w))


def _condition(attitude: Array) -> float:
    values = np.linalg.eigvalsh(attitude.T @ attitude)
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 0 else float("inf")


def _scatter(attitude: Array, matrix: Array, offset: Array, raw: Array, total_field: Array) -> float:
    """Predicted standard deviation of |b|, nT, in the worst direction of the sphere."""
    from scipy.special import chdtri

    noise = scalar_noise(matrix, offset, raw, total_field)
    values, vectors = np.linalg.eigh(attitude.T @ attitude)
    if not np.isfinite(noise) or values[0] <= values[-1] * 1e-15:
        return float("inf")
    freedom = len(raw) - 9
    bound = noise * np.sqrt(freedom / chdtri(freedom, 0.95))
    b = (raw - offset) @ matrix.T
    gain = np.mean(np.sum(((b / np.linalg.norm(b, axis=1, keepdims=True)) @ matrix) ** 2, axis=1))
    everywhere = attitude_design(sphere()) @ vectors
    return float(bound * np.sqrt(gain * np.max(np.sum(everywhere**2 / values, axis=1))))


def _bias(matrix: Array, offset: Array, nearest: Array) -> float:
    """Largest difference of |b|/F over the sphere between a fit and the nearest quadric's ellipsoid."""
    try:
        other = ellipsoid_of(nearest)
    except NotAnEllipsoid:
        return float("inf")
    points = np.linalg.solve(matrix, sphere().T).T + offset - other.offset
    squared = np.einsum("ni,ij,nj->n", points, other.shape, points)
    return float(np.max(np.abs(np.sqrt(squared) - 1.0)))


def _held(directions: Array) -> float:
    """How many samples a typical one has about it, itself included, within some 6 deg: a further posture is taken to
    be held as long."""
    counts = np.unique(_cells(directions, SAME_POSTURE), return_counts=True)[1].astype(float)
    return float(np.sum(counts**2) / np.sum(counts))


def _distinct(points: Array, cell: float) -> np.ndarray:
    """Indices of one point in each occupied cell of a grid, for points (N, 3) of order one."""
    return np.unique(_cells(points, cell), return_index=True)[1]


def _cells(points: Array, cell: float) -> np.ndarray:
    """(N,) the numbers of the cells of a grid that points (N, 3) of order one lie in."""
    index = np.round((points - points.min(axis=0)) / cell).astype(np.int64)
    size = index.max(axis=0) + 1
    numbers: np.ndarray = (index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2]
    return numbers


def _gap_angles(directions: Array, where: Array) -> Array:
    """Angle in deg from each direction of `where` (M, 3) to the nearest sample."""
    from scipy.spatial import cKDTree

    chord = cKDTree(directions).query(where)[0]
    out: Array = np.degrees(2 * np.arcsin(np.clip(chord / 2, 0, 1)))
    return out


def _empty_cones(directions: Array, most: int = 3) -> tuple[Cone, ...]:
    grid = sphere()
    gap = _gap_angles(directions, grid)
    found: list[Cone] = []
    while len(found) < most and len(grid) and gap.max() > 30.0:
        k = int(np.argmax(gap))
        axis, half = grid[k], float(gap[k])
        found.append(Cone((float(axis[0]), float(axis[1]), float(axis[2])), half))
        outside = grid @ axis < np.cos(np.radians(half))
        grid, gap = grid[outside], gap[outside]
    return tuple(found)


def _unseen(directions: Array) -> tuple[str, ...]:
    half_axes = np.vstack([np.eye(3), -np.eye(3)])
    names = ("+x", "+y", "+z", "-x", "-y", "-z")
    gap = _gap_angles(directions, half_axes)
    return tuple(n for n, g in zip(names, gap, strict=True) if g > UNSEEN)
