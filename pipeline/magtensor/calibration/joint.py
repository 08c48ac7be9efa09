"""All sensors and the reference in one fit.

The likelihood of C and o of every sensor, the unknown field of every sample eliminated, splits in two: the plane
that the outputs share (`common_field`) holds 3 S - 3 values a sample that no total field can add to, and the
position in that plane is one three-axis sensor, better than any single one, which the total field calibrates
(`maximum_likelihood`). The two parts meet only in products of noise with noise over F, so solving one after the
other is the joint maximum-likelihood estimate; two-step methods lose because they calibrate each sensor against
the total field before they use what the sensors have in common (METHODS A4.8).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.errors import DataError, NotEnoughData

from .agreement import require_agreement
from .axes import mirrored_words, turned_words
from .common_field import CommonField, common_field, output_noise
from .coverage import WORST_ERROR, coverage, require_coverage
from .maximum_likelihood import ScalarFit, fit_scalar
from .noise import noise_std, shares_of_two
from .scalar import checked_samples
from .types import Array, ArrayCalibration, Mask

FALSE_REJECTION = 0.01  # probability that one clean sample of the whole survey is rejected
LEAST_FOR_REJECTION = 50  # with fewer samples the fit bends to an outlier, and no residual can tell which it was
_TOLD_APART = 2  # rounds after which the noise of two sensors no longer moves
_CHUNK = 65536


@dataclass(frozen=True)
class JointFit:
    """The joint estimate before it is put into a frame.

    Attributes:
        forward: (S, 3, 3), C of m = C b + o; offset: (S, 3) nT.
        plane: the common field; scalar: the calibration within its plane.
        keep: (N,) samples that were used.
    """

    forward: Array
    offset: Array
    plane: CommonField
    scalar: ScalarFit
    keep: Mask


def fit_joint(
    raw: Array,
    total_field: Array,
    *,
    noise: Array | None = None,
    reference_noise: float = 0.0,
    robust: bool = True,
    worst_error: float = WORST_ERROR,
    keep: Mask | None = None,
    complete: bool = True,
) -> JointFit:
    """Fit C and o of all sensors to their outputs and the total field.

    Parameters
    ----------
    raw: (N, S, 3) nT, finite.
    total_field: (N,) nT, positive.
    noise: (S, 3) nT of the raw outputs; when None that of second differences, with few samples of the residual.
    reference_noise: nT, white, of the total field.
    robust: leave out samples that no noise explains.
    worst_error: see `coverage.coverage`.
    keep: (N,) the samples to believe; judged here when None.
    complete: the model is believed to hold all there is, so that a misfit is noise. Where it is not, an effect that no
        one has added yet must not pass for a lack of attitudes.

    Raises
    ------
    NotEnoughData: the attitudes do not determine the parameters; the message says which are missing.
    DataError: a mirrored sensor, or one that does not see the field of the others.
    """
    checked_samples(raw[:, 0], total_field)
    judge = keep is None and robust and len(raw) >= LEAST_FOR_REJECTION
    keep = np.ones(len(raw), dtype=bool) if keep is None else keep
    sensors = raw.shape[1]
    own_noise = noise is None and sensors > 1 and len(raw) >= LEAST_FOR_REJECTION
    given = output_noise(raw, keep) if own_noise else noise
    two = sensors == 2 and noise is None and given is not None
    for round_ in range(20):
        plane = common_field(raw, given, keep)
        y = plane.coordinates(raw)
        try:
            scalar = fit_scalar(y[keep], total_field[keep], reference_noise)
        except DataError:
            require_coverage(coverage(raw[keep, 0], total_field[keep]))
            raise
        if sensors == 1 and noise is None:
            # one sensor has no neighbour to find its noise by: the residual along the field is all there is
            given = np.full((1, 3), float(plane.noise[0]) * np.sqrt(scalar.chi2))
            plane = common_field(raw, given, keep)
            y = plane.coordinates(raw)
            scalar = fit_scalar(y[keep], total_field[keep], reference_noise)
        if two and given is not None and round_ < _TOLD_APART:
            given = _told_apart(given, _unfold(plane, scalar, sensors), raw, total_field)
            continue
        if not judge:
            break
        again = _believable(plane, scalar, raw, total_field, reference_noise, keep)
        if np.array_equal(again, keep):
            break
        if again.sum() < 0.5 * len(raw):
            raise NotEnoughData(
                "more than half of the samples disagree with any one calibration",
                hint="look for a moving magnetic object, a dead axis or wrong units",
            )
        keep = again
        if own_noise:
            given = output_noise(raw, keep)  # a spike passes for noise until it is left out
            if two:
                given = _told_apart(given, _unfold(plane, scalar, sensors), raw, total_field)
        elif sensors == 1 and noise is None:
            given = None
    forward, offset = _unfold(plane, scalar, sensors)
    # judged on the calibrated field, whose axes are nearest to those of the sensors
    field = (y[keep] - scalar.offset) @ scalar.matrix.T @ nearest_frame(forward)
    reference = total_field[keep]
    level = None if complete else float(noise_std(field[:, None], reference)[0, 0])
    require_coverage(
        coverage(field, reference, matrix=np.eye(3), offset=np.zeros(3), worst_error=worst_error, noise=level)
    )
    _refuse_sensors(forward, offset, raw[keep], total_field[keep])
    return JointFit(forward, offset, plane, scalar, keep)


def _told_apart(noise: Array, found: tuple[Array, Array], raw: Array, total_field: Array) -> Array:
    """(2, 3) nT: the noise that two sensors' contrast shows, given to each as the total field tells them apart."""
    forward, offset = found
    b = np.einsum("sij,nsj->nsi", np.linalg.pinv(forward, rcond=1e-9), raw - offset)
    out: Array = np.sqrt(np.sum(noise**2, axis=0) * shares_of_two(b, total_field)[:, None])
    return out


def _refuse_sensors(forward: Array, offset: Array, raw: Array, total_field: Array) -> None:
    """Mirrored sensors, and those that have nothing in common with the others, whose C is next to singular."""
    some = slice(None, None, max(1, len(raw) // 20_000))
    correction = np.asarray(np.linalg.pinv(forward, rcond=1e-9), dtype=np.float64)
    require_agreement(np.einsum("sij,nsj->nsi", correction, raw[some] - offset), total_field[some])
    words = mirrored_words(correction)
    if words:
        raise DataError(
            "; ".join(words), hint="correct the sign or the order of the named axes when loading the survey"
        )


def _unfold(plane: CommonField, scalar: ScalarFit, sensors: int) -> tuple[Array, Array]:
    """C (S, 3, 3) and o (S, 3) nT of every sensor from the plane and the calibration in it."""
    c = plane.basis @ np.linalg.inv(scalar.matrix)
    off_plane = plane.mean - plane.basis @ (plane.basis.T @ plane.mean)
    o = plane.basis @ scalar.offset + off_plane
    return (c * plane.noise[:, None]).reshape(sensors, 3, 3), (o * plane.noise).reshape(sensors, 3)


def _believable(
    plane: CommonField, scalar: ScalarFit, raw: Array, total_field: Array, reference_noise: float, keep: Mask
) -> Mask:
    """(N,) samples whose squared whitened residual noise explains, at `FALSE_REJECTION` for the whole survey.

    Scaled by the median, so that outliers cannot hide each other.
    """
    from scipy.stats import chi2

    n, size = len(raw), raw.shape[1] * 3
    groups = []
    along = np.empty(n)
    across = np.zeros(n)
    for start in range(0, n, _CHUNK):
        part = slice(start, start + _CHUNK)
        b = (plane.coordinates(raw[part]) - scalar.offset) @ scalar.matrix.T
        length = np.linalg.norm(b, axis=1)
        g = (b / length[:, None]) @ scalar.matrix
        variance = np.einsum("ni,ni->n", g, g) + reference_noise**2
        along[part] = (length - total_field[part]) ** 2 / variance
        if size > 3:
            across[part] = np.sum(plane.residual(raw[part]) ** 2, axis=1)
    groups.append((along, 1))
    if size > 3:
        groups.append((across, size - 3))
    good = np.ones(n, dtype=bool)
    for values, freedom in groups:
        scale = np.median(values) / chi2.median(freedom)
        limit = chi2.isf(FALSE_REJECTION / (n * len(groups)), freedom)
        good &= values <= limit * max(scale, 1e-300)
    return good


def nearest_frame(forward: Array) -> Array:
    """The rotation Q (3, 3) that brings all C_s Q together as near to the identity as they get.

    The frame nearest to the raw axes of the whole array: of all frames that scalar data allow, the one that leaves
    the corrections smallest. It is the platform's frame only as far as the sensors are mounted along it.
    """
    u, _, vt = np.linalg.svd(forward.sum(axis=0))
    q: Array = vt.T @ np.diag([1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    return q


def calibrated(fit: JointFit, total_field: Array, raw: Array, reference_noise: float = 0.0) -> ArrayCalibration:
    """The fit as corrections in the frame nearest to the raw axes, with the covariance of all 12 S parameters."""
    q = nearest_frame(fit.forward)
    forward = fit.forward @ q
    covariance = _forward_covariance(fit, q, raw, total_field, reference_noise)
    matrix = np.asarray(np.linalg.inv(forward), dtype=np.float64)
    size = 12 * len(forward)
    to_matrix = np.zeros((size, size))
    for s, m in enumerate(matrix):
        block = slice(12 * s, 12 * s + 9)
        to_matrix[block, block] = -np.kron(m, m.T)
        to_matrix[12 * s + 9 : 12 * s + 12, 12 * s + 9 : 12 * s + 12] = np.eye(3)
    return ArrayCalibration(
        matrix,
        fit.offset,
        to_matrix @ covariance @ to_matrix.T,
        "array (nearest to the raw axes)",
        ("one rotation of the whole array: the frame nearest to the raw axes was chosen",),
        {
            "samples": float(fit.keep.sum()),
            "rejected": float((~fit.keep).sum()),
            "chi2_total_field": fit.scalar.chi2,
            "chi2_contrasts": fit.plane.chi2,
            "noise_nT": float(np.sqrt(np.mean(fit.plane.noise**2))),
            "axes": "; ".join(turned_words(matrix)),
        },
        fit.keep,
    )


def _forward_covariance(fit: JointFit, q: Array, raw: Array, total_field: Array, reference_noise: float) -> Array:
    """Covariance (12 S, 12 S) of C Q (row by row) and o of each sensor, in the frame of `nearest_frame`.

    In whitened outputs a change W (3 S, 4) of [C | o] moves a sample by W z, z = (b, 1). Perpendicular to the
    plane its information is sum(z z') for every direction; within the plane only u' U V' W z / spread is seen,
    which the rotation of b leaves unchanged: the three directions of the gauge have no information and are then
    fixed by the frame's own condition.
    """
    plane, scalar = fit.plane, fit.scalar
    sensors, size = len(fit.forward), 3 * len(fit.forward)
    moments, inner = np.zeros((4, 4)), np.zeros((12, 12))
    used, field = raw[fit.keep], total_field[fit.keep]
    for start in range(0, len(used), _CHUNK):
        part = slice(start, start + _CHUNK)
        b = (plane.coordinates(used[part]) - scalar.offset) @ scalar.matrix.T
        length = np.linalg.norm(b, axis=1, keepdims=True)
        u = b / length
        g = u @ scalar.matrix
        spread = np.sqrt(np.einsum("ni,ni->n", g, g) + reference_noise**2)
        z = np.column_stack([u * field[part, None] @ q, np.ones(len(b))])
        moments += z.T @ z
        rows = np.einsum("ni,nj->nij", g / spread[:, None], z).reshape(len(z), 12)
        inner += rows.T @ rows
    # within the plane: parameters A = V' W (3, 4), row by row
    inverse_moments = np.linalg.inv(moments)
    values, vectors = np.linalg.eigh(_scaled(inner))
    seen = values > values[-1] * 1e-12
    scale = 1.0 / np.sqrt(np.maximum(np.diag(inner), 1e-300))
    root = (vectors[:, seen] / np.sqrt(values[seen])) * scale[:, None]
    inside = root @ root.T * max(scalar.chi2, 1.0)
    v = plane.basis
    outside = np.eye(size) - v @ v.T
    spread_in = np.kron(v, np.eye(4))
    whitened = np.kron(outside, inverse_moments) + spread_in @ inside @ spread_in.T
    d = np.kron(np.diag(plane.noise), np.eye(4))
    covariance = d @ whitened @ d  # rows of W: output after output, [C | o] along them
    order = [3 * s + i for s in range(sensors) for i in range(3)]
    pick = []
    for s in range(sensors):
        pick += [4 * order[3 * s + i] + j for i in range(3) for j in range(3)]
        pick += [4 * order[3 * s + i] + 3 for i in range(3)]
    covariance = covariance[np.ix_(pick, pick)]
    fixing = _frame_projection(fit.forward @ q)
    out: Array = fixing @ covariance @ fixing.T
    return out


def _scaled(normal: Array) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    out: Array = normal * np.outer(scale, scale)
    return out


def _frame_projection(forward: Array) -> Array:
    """(12 S, 12 S): adds to a change of C the rotation that keeps sum(C_s) symmetric, the condition of the frame."""
    sensors = len(forward)
    generators = np.zeros((3, 3, 3))
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        generators[k, i, j], generators[k, j, i] = -1.0, 1.0
    total = forward.sum(axis=0)

    def skew(a: Array) -> Array:
        return np.array([a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1]])

    response = np.column_stack([skew(total @ g) for g in generators])
    read = np.zeros((3, 12 * sensors))
    move = np.zeros((12 * sensors, 3))
    for s in range(sensors):
        for i in range(3):
            for j in range(3):
                unit = np.zeros((3, 3))
                unit[i, j] = 1.0
                read[:, 12 * s + 3 * i + j] = skew(unit)
        for k in range(3):
            move[12 * s : 12 * s + 9, k] = (forward[s] @ generators[k]).ravel()
    out: Array = np.eye(12 * sensors) - move @ np.linalg.solve(response, read)
    return out
