"""Rotations between calibrated sensors, and the array calibration they make, covariance included.

b_1 = R b_i for calibrated outputs of two sensors in a uniform field (Chi 2017 eq. 16). What the covariance of R
needs of an estimator is one linear map: how a small disturbance d_j of b_1 - R b_i turns the estimate,
w = turn @ vec(sum_j d_j c_j^T) with c_j = R b_i, w the rotation vector in the reference's frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from magtensor.errors import DataError, NotEnoughData

from .agreement import require_agreement
from .axes import axis_faults, turned_words
from .by_sensor import by_sensor
from .covariance import Influence, scalar_influence
from .factors import CHOLESKY, POLAR
from .rotation import LI_SEQUENCE, cross_matrix, nearest_orthogonal, sequence, sequence_derivatives
from .types import PARAMETERS_PER_SENSOR, Array, ArrayCalibration, SensorCalibration

LEAST_SAMPLES = 4  # a rotation has three angles
COMMON_ROTATION = "one rotation common to all sensors: scalar data do not tie the frame to the platform"


@dataclass(frozen=True)
class Alignment:
    """A rotation that takes one sensor's frame to another's.

    Attributes:
        rotation: (3, 3), proper.
        turn: (3, 9), 1/nT^2; see the module.
    """

    rotation: Array
    turn: Array


Aligner = Callable[[Array, Array], Alignment]


def _axial() -> Array:
    """(3, 9): vec of a matrix X = sum d c^T (row by row) to sum c x d."""
    out = np.zeros((3, 9))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[k, 3 * j + i] += 1.0
        out[k, 3 * i + j] -= 1.0
    return out


def procrustes(target: Array, source: Array) -> Alignment:
    """The proper rotation that takes source to target best (Chi 2017 eq. 16, det = +1 imposed).

    Parameters
    ----------
    target, source: (N, 3) nT.
    """
    rotation = nearest_orthogonal(target.T @ source, 1)
    return Alignment(rotation, _least_squares_turn(source @ rotation.T))


def three_angles(target: Array, source: Array) -> Alignment:
    """The same least squares over three angles, by Gauss-Newton steps from no rotation (Pang 2013).

    The misalignment of sensors mounted by hand is small, and the paper starts there; a step that does not
    reduce the misfit is halved. The moments of the samples carry all that the cost depends on.

    Parameters
    ----------
    target, source: (N, 3) nT.

    Raises
    ------
    DataError: no convergence.
    """
    moments, gram = target.T @ source, source.T @ source
    total = float(np.sum(target**2) + np.trace(gram))

    def cost(at: Array) -> float:
        return total - 2 * float(np.sum(sequence(LI_SEQUENCE[::-1], at) * moments))

    angles = np.zeros(3)
    for _ in range(100):
        derivatives = sequence_derivatives(LI_SEQUENCE[::-1], angles)
        gradient = np.einsum("kij,ij->k", derivatives, moments)
        normal = np.einsum("kij,jl,mil->km", derivatives, gram, derivatives)
        step = np.linalg.lstsq(normal, gradient, rcond=None)[0]
        # near the minimum the cost is flat to rounding, and a step must not be halved for that
        while cost(angles + step) > cost(angles) + 1e-12 * total:
            step = step / 2
        angles = angles + step
        if np.linalg.norm(step) < 1e-12:
            rotation = sequence(LI_SEQUENCE[::-1], angles)
            return Alignment(rotation, _least_squares_turn(source @ rotation.T))
    raise DataError(
        "the three misalignment angles do not converge from a start at zero",
        hint="align by procrustes, which needs no start",
    )


def linear_elements(target: Array, source: Array) -> Alignment:
    """Nine free elements by linear least squares, three angles read from them (Yin 2014 after Li 2018).

    target = T source without a constraint; with T = A_gamma A_beta A_alpha (Li 2018 eq. 6) the angles are
    alpha = -atan(T_32 / T_33), beta = asin T_31, gamma = -asin(T_21 / cos beta). Which elements the authors read is
    not printed. Of some 860 readings tried on Zhang's output these were taken, and the cosine added, because they
    come nearest to the tensor errors of Li's Table 2 (0.3 %); that agreement is a choice, not a check.

    Parameters
    ----------
    target, source: (N, 3) nT.

    Raises
    ------
    DataError: the elements are no rotation's (asin of more than one).
    """
    inverse = np.linalg.pinv(source.T @ source)
    t = target.T @ source @ inverse
    s_beta = t[2, 0]
    c_beta = np.sqrt(max(1 - s_beta**2, 0.0))
    if abs(s_beta) >= 1 or abs(t[1, 0]) >= c_beta:
        raise DataError(
            "the linear alignment found no rotation between the sensors",
            hint="its angles must stay below 90 deg; align by procrustes",
        )
    s_gamma = -t[1, 0] / c_beta
    order = LI_SEQUENCE[::-1]
    alpha, beta, gamma = -np.arctan2(t[2, 1], t[2, 2]), np.arcsin(s_beta), np.arcsin(s_gamma)
    angles = np.array([gamma, beta, alpha])
    rotation = sequence(order, angles)
    read = np.zeros((3, 3, 3))  # derivative of (gamma, beta, alpha) with respect to the elements of T
    read[1, 2, 0] = 1 / c_beta
    c_gamma = np.sqrt(1 - s_gamma**2)
    read[0, 1, 0] = -1 / (c_beta * c_gamma)
    read[0, 2, 0] = s_gamma * s_beta / (c_beta**2 * c_gamma)
    length = t[2, 1] ** 2 + t[2, 2] ** 2
    read[2, 2, 1], read[2, 2, 2] = -t[2, 2] / length, t[2, 1] / length
    turns = np.array([_vector_of(d @ rotation.T) for d in sequence_derivatives(order, angles)])
    # dT = X rotation (sum c c^T)^-1 rotation^T rotation, X = sum d c^T
    spread = rotation @ inverse
    turn = np.einsum("aw,aij,kj->wik", turns, read, spread).reshape(3, 9)
    return Alignment(rotation, turn)


def _vector_of(antisymmetric: Array) -> Array:
    return np.array([antisymmetric[2, 1], antisymmetric[0, 2], antisymmetric[1, 0]])


def _least_squares_turn(turned: Array) -> Array:
    """`turn` of the least squares rotation for turned samples c (N, 3); minimum norm where one angle is free."""
    gram = turned.T @ turned
    out: Array = np.linalg.pinv(np.trace(gram) * np.eye(3) - gram, rcond=1e-12) @ _axial()
    return out


@dataclass(frozen=True)
class Handedness:
    """Does a proper rotation or a mirror take one sensor's output to the other's?

    Attributes:
        mirrored: only the mirror fits.
        undetermined: the field stayed in a plane, so both fit (Chi 2017 demands M_1 M_i^T nonsingular).
        mirror: (3, 3), the best orthogonal map of determinant -1.
        proper_rms, mirror_rms: nT, per component, of what either map leaves.
    """

    mirrored: bool
    undetermined: bool
    mirror: Array
    proper_rms: float
    mirror_rms: float


def handedness(target: Array, source: Array) -> Handedness:
    """Compare the best proper rotation with the best mirror (METHODS A4.5).

    The two squared misfits differ by four times the smallest singular value of M_1 M_i^T. It means nothing while
    the field's smallest principal component stays within five times the noise that the better map leaves.

    Parameters
    ----------
    target, source: (N, 3) nT.
    """
    maps = {d: nearest_orthogonal(target.T @ source, d) for d in (1, -1)}
    rms = {d: float(np.sqrt(np.mean((target - source @ m.T) ** 2))) for d, m in maps.items()}
    better = min(rms.values())
    thinnest = min(float(np.sqrt(max(np.linalg.eigvalsh(x.T @ x)[0], 0.0) / len(x))) for x in (target, source))
    size = float(np.sqrt(np.mean(target**2)))
    undetermined = thinnest < max(5 * better, 1e-6 * size)
    return Handedness(not undetermined and rms[-1] < rms[1] / 2, undetermined, maps[-1], rms[1], rms[-1])


def align(b: Array, calibrations: Sequence[SensorCalibration], reference: int, aligner: Aligner) -> ArrayCalibration:
    """Turn every sensor into the frame of the reference sensor.

    Parameters
    ----------
    b: (N, S, 3) nT, the output calibrated by `calibrations`, in a field uniform over the array.
    calibrations: (S,).
    reference: index of the sensor whose frame becomes the common one.
    aligner: `procrustes`, `three_angles` or `linear_elements`.

    Returns
    -------
    The covariance holds the noise of these samples and that of the scalar step, with their correlation under
    the premise that the scalar step was fitted to these same samples.

    Raises
    ------
    NotEnoughData: fewer than four samples in which all sensors may be used.
    DataError: a sensor has an inverted axis or two swapped ones, or sees another field; the message says which.
    """
    b = np.asarray(b, dtype=float)
    sensors = b.shape[1]
    if len(b) < LEAST_SAMPLES:
        raise NotEnoughData(
            f"{len(b)} samples in which every sensor may be used cannot align them",
            hint=f"at least {LEAST_SAMPLES} are needed that are flagged in no sensor and have a total field",
        )
    if len(calibrations) != sensors or not 0 <= reference < sensors:
        raise ValueError(f"{sensors} sensors, {len(calibrations)} calibrations, reference {reference}")
    if not np.isfinite(b).all():
        raise DataError("the calibrated samples are not all finite", hint="mask the gaps before aligning")
    hands = [handedness(b[:, reference], b[:, s]) for s in range(sensors)]
    _refuse_mirrors(hands, reference)
    found = [
        Alignment(np.eye(3), np.zeros((3, 9))) if s == reference else aligner(b[:, reference], b[:, s])
        for s in range(sensors)
    ]
    rotation = np.array([a.rotation for a in found])
    offset = np.array([c.offset for c in calibrations])
    matrix = rotation @ np.array([c.matrix for c in calibrations])
    require_agreement(by_sensor(rotation, b), np.linalg.norm(b[:, reference], axis=1))
    planar = [s for s in range(sensors) if hands[s].undetermined and s != reference]
    unobservable = [COMMON_ROTATION]
    if planar:
        unobservable.append(
            f"the handedness of sensor{'s' if len(planar) > 1 else ''} "
            f"{', '.join(str(s + 1) for s in planar)}: the field stayed in a plane, right-handed axes assumed"
        )
    contrast = b[:, [reference]] - by_sensor(rotation, b)
    diagnostics: dict[str, float | str] = {
        f"contrast_rms_{s + 1}_nT": float(np.sqrt(np.mean(contrast[:, s] ** 2)))
        for s in range(sensors)
        if s != reference
    }
    diagnostics["axes"] = "; ".join(turned_words(matrix))
    return ArrayCalibration(
        matrix,
        offset,
        _covariance(b, calibrations, reference, found, contrast),
        f"sensor {reference + 1}",
        tuple(unobservable),
        diagnostics,
    )


def _refuse_mirrors(hands: Sequence[Handedness], reference: int) -> None:
    if not any(h.mirrored for h in hands):
        return
    names = [f"sensor {s + 1}" for s in range(len(hands))]
    maps = np.array([h.mirror if h.mirrored else np.eye(3) for h in hands])
    worst = max(h.proper_rms for h in hands if h.mirrored)
    best = max(h.mirror_rms for h in hands if h.mirrored)
    words = axis_faults(maps, reference, names)
    raise DataError(
        f"{'; '.join(words)} (a mirrored map fits to {best:.3g} nT, the best rotation only to {worst:.3g} nT)",
        hint="correct the sign or the order of the named axes when loading the survey",
    )


def _covariance(
    b: Array,
    calibrations: Sequence[SensorCalibration],
    reference: int,
    found: Sequence[Alignment],
    contrast: Array,
) -> Array:
    """Covariance (12 S, 12 S) of the aligned corrections.

    Everything is linear in the raw noise e_sj of sensor s in sample j. Each sensor contributes the twelve
    parameters of its scalar step and, for each alignment it takes part in, the rotation its noise in these samples
    causes directly; both are sums over j, so their joint covariance is a sum of products.
    """
    sensors, p = b.shape[1], PARAMETERS_PER_SENSOR
    total = np.zeros((p * sensors, p * sensors))
    samples = [s for s in range(sensors) if s != reference]
    own, noise = _noise(calibrations, contrast, samples)
    turned = {s: b[:, s] @ found[s].rotation.T for s in samples}
    for source in range(sensors):
        calibration = calibrations[source]
        if not np.isfinite(calibration.covariance).all():
            return np.full_like(total, np.nan)
        raw = np.linalg.solve(calibration.matrix, b[:, source].T).T + calibration.offset
        scalar = _scalar_step(calibration, raw, b[:, source])
        involved = samples if source == reference else [source]
        # elementary quantities: the scalar step's parameters, then a rotation vector for each alignment
        size = p + 3 * len(involved)
        joint = np.zeros((size, size))
        joint[:p, :p] = calibration.covariance
        outer = np.zeros((p * sensors, size))
        sign = 1.0 if source == reference else -1.0
        kernels = {}
        for k, s in enumerate(involved):
            to_reference = np.eye(3) if source == reference else found[s].rotation
            turn = found[s].turn.reshape(3, 3, 3)
            kernels[s] = sign * np.einsum("wai,ae->wei", turn, to_reference @ calibration.matrix)
            at = slice(p + 3 * k, p + 3 * k + 3)
            # direct effect of the noise, correlated with the scalar step through the same samples
            moment = np.einsum("pj,je,ji->pei", scalar.gain, scalar.direction, turned[s], optimize=True)
            joint[:p, at] = own[source] * noise[source] * np.einsum("pei,wei->pw", moment, kernels[s])
            joint[at, :p] = joint[:p, at].T
            # effect of the scalar step's error on the rotation
            centred = raw - calibration.offset
            first = centred.T @ turned[s]
            response = np.zeros((3, 3, p))
            for a in range(3):
                response[a, :, 3 * a : 3 * a + 3] = first.T
            response[:, :, 9:] = -calibration.matrix[:, None, :] * turned[s].sum(axis=0)[None, :, None]
            through = sign * np.einsum("wai,ac,cip->wp", turn, to_reference, response)
            tilt = _tilt(found[s].rotation @ calibrations[s].matrix)
            outer[p * s : p * s + p, :p] += tilt @ through
            outer[p * s : p * s + p, at] = tilt
        for k, s in enumerate(involved):
            for m, t in enumerate(involved):
                products = turned[s].T @ turned[t]
                joint[p + 3 * k : p + 3 * k + 3, p + 3 * m : p + 3 * m + 3] = noise[source] ** 2 * np.einsum(
                    "wei,il,vel->wv", kernels[s], products, kernels[t]
                )
        carried = np.eye(p)
        carried[:9, :9] = np.kron(found[source].rotation, np.eye(3))
        outer[p * source : p * source + p, :p] += carried
        total += outer @ joint @ outer.T
    return (total + total.T) / 2


def _tilt(matrix: Array) -> Array:
    """Derivative (12, 3) of matrix and offset with respect to a rotation vector applied on the left."""
    out = np.zeros((PARAMETERS_PER_SENSOR, 3))
    for k in range(3):
        out[:9, k] = (cross_matrix(np.eye(3)[k]) @ matrix).ravel()
    return out


def _scalar_step(calibration: SensorCalibration, raw: Array, b: Array) -> Influence:
    """Influence of the noise through the scalar step; none where the calibration came from elsewhere."""
    if calibration.frame not in (CHOLESKY, POLAR):
        return Influence(np.zeros((PARAMETERS_PER_SENSOR, len(raw))), np.zeros((len(raw), 3)))
    field = np.linalg.norm(b, axis=1)
    return scalar_influence(calibration.matrix, calibration.offset, raw, field, calibration.frame)


def _noise(
    calibrations: Sequence[SensorCalibration], contrast: Array, samples: Sequence[int]
) -> tuple[list[float], list[float]]:
    """Raw noise per axis and sensor, nT: the scalar step's, and that raised where the contrasts ask for more."""
    own = [float(c.diagnostics.get("noise_nT", c.residual_rms)) for c in calibrations]
    power = [n**2 * float(np.sum(c.matrix**2)) for n, c in zip(own, calibrations, strict=True)]
    reference = next(s for s in range(len(own)) if s not in samples)
    expected = sum(power[reference] + power[s] for s in samples) * len(contrast)
    seen = float(np.sum(contrast**2)) * len(contrast) / max(len(contrast) - 1, 1)
    excess = np.sqrt(max(seen / expected, 1.0)) if expected > 0 else 1.0
    return own, [float(n * excess) for n in own]
