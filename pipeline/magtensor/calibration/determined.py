"""What a sensor that hardly turns still tells about itself: the determined combinations, and no others.

An observatory's variometer stands still; a drone in level flight turns about one axis. Nine parameters are then not
to be had, and a fit that returns nine has made most of them up. Yet |m| - F does determine a few combinations: first
of all the error along the field. The right singular vectors of the linearised problem are the combinations in order
of how strongly the survey excites them. As many are estimated as predict contiguous blocks that the fit has not
seen; the other directions stay at the sensor's nominal values, and the result says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.errors import NotEnoughData

from .scalar import checked_samples
from .types import Array, SensorCalibration

PARAMETERS = 9
FOLDS = 10
LEAST_PER_FOLD = 5
ASTRAY = 10.0  # of the field: a sensor is nominal within a part of it
_ROUNDS = 5  # Newton steps; the problem is linear but for the square of the error over F
_SYMMETRIC = np.array([(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)])


@dataclass(frozen=True)
class Determined:
    """The combinations of nine parameters that a survey determines.

    Attributes:
        count: how many.
        basis: (9, 9) nT, combinations as columns, the most excited first; rows are F times the symmetric change of the
            matrix (xx, yy, zz, yz, xz, xy) and the offset (x, y, z).
        excitation: (9,) rms of |b| that a combination of 1 nT makes.
        held_out_rms: (10,) nT, rms of |b| - F on blocks not fitted, with 0 to 9 combinations.
        theta: (9,) nT.
        covariance: (9, 9) nT^2, over the determined combinations alone, from leaving out one block after the other.
    """

    count: int
    basis: Array
    excitation: Array
    held_out_rms: Array
    theta: Array
    covariance: Array


def design(raw: Array, field: float) -> Array:
    """(N, 9): change of |b| with the parameters of `Determined.basis`, for raw output (N, 3) nT near the field."""
    length = np.linalg.norm(raw, axis=1)
    u = raw / length[:, None]
    products = u[:, _SYMMETRIC[:, 0]] * u[:, _SYMMETRIC[:, 1]] * np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
    return np.column_stack([products * (length / field)[:, None], -u])


def correction(theta: Array, field: float) -> tuple[Array, Array]:
    """Matrix (3, 3) and offset (3,) nT of parameters (9,) nT."""
    change = np.zeros((3, 3))
    change[_SYMMETRIC[:, 0], _SYMMETRIC[:, 1]] = theta[:6] / field
    change[_SYMMETRIC[:, 1], _SYMMETRIC[:, 0]] = theta[:6] / field
    return np.eye(3) + change, theta[6:].copy()


def determined(raw: Array, total_field: Array) -> Determined:
    """Estimate as many combinations as blocks that were not fitted want.

    Parameters
    ----------
    raw: (N, 3) nT; total_field: (N,) nT.

    Raises
    ------
    NotEnoughData: too few samples for ten blocks, or not even one combination predicts them.
    """
    raw, total_field = checked_samples(raw, total_field)
    if len(raw) < FOLDS * LEAST_PER_FOLD:
        raise NotEnoughData(
            f"{len(raw)} samples are too few for {FOLDS} blocks", hint=f"{FOLDS * LEAST_PER_FOLD} are the least"
        )
    field = float(np.mean(total_field))
    jacobian = design(raw, field)
    fold = np.minimum(np.arange(len(raw)) * FOLDS // len(raw), FOLDS - 1)
    squares = np.empty((PARAMETERS + 1, FOLDS))
    estimates = np.empty((PARAMETERS + 1, FOLDS, PARAMETERS))
    for k in range(FOLDS):
        test = fold == k
        basis = _basis(jacobian[~test])[0]
        for count in range(PARAMETERS + 1):
            theta = _fit(raw[~test], total_field[~test], jacobian[~test], basis[:, :count], field)
            squares[count, k] = np.mean(_residual(theta, raw[test], total_field[test], field) ** 2)
            estimates[count, k] = theta
    best = int(np.argmin(squares.mean(axis=1)))
    # the fewest that do as well as the best: the difference, block by block, within one standard error of none
    worse = squares - squares[best]
    error = worse.std(axis=1, ddof=1) / np.sqrt(FOLDS)
    count = int(np.argmax(worse.mean(axis=1) <= error))
    if count == 0:
        raise NotEnoughData(
            "no combination of scale factors, angles and offsets predicts |b| better than the nominal values do",
            hint="the sensor is as good as the reference can tell, or something else moves the two apart",
        )
    basis, excitation = _basis(jacobian)
    theta = _fit(raw, total_field, jacobian, basis[:, :count], field)
    # a fold's own basis turns a little; only what lies in the whole survey's counts
    own = basis[:, :count] @ basis[:, :count].T
    spread = (estimates[count] - estimates[count].mean(axis=0)) @ own
    covariance = (FOLDS - 1) / FOLDS * spread.T @ spread
    return Determined(count, basis, excitation, np.sqrt(squares.mean(axis=1)), theta, covariance)


def calibrate_determined(raw: Array, total_field: Array) -> SensorCalibration:
    """The determined combinations as a correction; the others nominal.

    Parameters and errors as in `determined`.
    """
    found = determined(raw, total_field)
    field = float(np.mean(total_field))
    matrix, offset = correction(found.theta, field)
    to_parameters = np.zeros((12, PARAMETERS))
    for k, (i, j) in enumerate(_SYMMETRIC):
        to_parameters[3 * i + j, k] = to_parameters[3 * j + i, k] = 1.0 / field
    to_parameters[9:, 6:] = np.eye(3)
    residual = np.linalg.norm((raw - offset) @ matrix.T, axis=1) - total_field
    return SensorCalibration(
        matrix,
        offset,
        to_parameters @ found.covariance @ to_parameters.T,
        "polar",
        float(np.sqrt(np.mean(residual**2))),
        {
            "determined_combinations": float(found.count),
            "held_out_nominal_rms_nT": float(found.held_out_rms[0]),
            "held_out_rms_nT": float(found.held_out_rms[found.count]),
        },
        (_words(found),) if found.count < PARAMETERS else (),
    )


def _words(found: Determined) -> str:
    before, after = found.held_out_rms[0], found.held_out_rms[found.count]
    return (
        f"{PARAMETERS - found.count} of 9 combinations of scale factors, angles and offsets, left nominal; the others "
        f"bring |b| - F on blocks not fitted from {before:.3g} to {after:.3g} nT rms"
    )


def _basis(jacobian: Array) -> tuple[Array, Array]:
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian / len(jacobian))
    return vectors[:, ::-1], np.sqrt(np.maximum(values[::-1], 0.0))


def _residual(theta: Array, raw: Array, total_field: Array, field: float) -> Array:
    matrix, offset = correction(theta, field)
    out: Array = total_field - np.linalg.norm((raw - offset) @ matrix.T, axis=1)
    return out


def _fit(raw: Array, total_field: Array, jacobian: Array, basis: Array, field: float) -> Array:
    """Newton steps within the combinations (9, K) of `basis`."""
    theta = np.zeros(PARAMETERS)
    if not basis.shape[1]:
        return theta
    q, r = np.linalg.qr(jacobian @ basis)
    for _ in range(_ROUNDS):
        step = basis @ np.linalg.lstsq(r, q.T @ _residual(theta, raw, total_field, field), rcond=None)[0]
        theta = theta + step
        if np.max(np.abs(step)) < 1e-9 * field or np.max(np.abs(theta)) > ASTRAY * field:
            break  # a combination that nothing determines may run away: it predicts nothing, wherever it is stopped
    return theta
