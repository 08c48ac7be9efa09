"""The covariance of one C and the offsets of several surveys, in the frame of the calibration."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.joint_covariance import SYMMETRIC as _PLACES
from magtensor.calibration.joint_covariance import frame_projection
from magtensor.calibration.types import Array

from .fit import SurveysFit
from .sums import SYMMETRIC


def forward_covariance(fit: SurveysFit, forward: Array, q: Array) -> Array:
    """Covariance of C Q (9 S, sensor after sensor, row by row), then of the offsets (3 S K, survey after survey).

    As `joint_covariance.forward_covariance`, with z = (b, 1 at the sample's own survey). Without known directions the
    frame is that of `nearest_frame`; with them it is the one that they are in, Q the identity.

    Parameters
    ----------
    forward: (S, 3, 3) C Q; q: (3, 3) Q.
    """
    found, plane, data = fit.found, fit.plane, fit.data
    sensors, size, centres = len(forward), 3 * len(forward), data.centres
    width = 3 + centres
    moments = np.zeros((width, width))
    for k, own in enumerate(found.sums.moments):
        moments[:3, :3] += q.T @ own[:3, :3] @ q
        moments[:3, 3 + k] = moments[3 + k, :3] = own[3, :3] @ q
        moments[3 + k, 3 + k] = own[3, 3]
    free = data.free
    to_field = np.zeros((free + 3 * centres, 3, width))
    if free == SYMMETRIC:
        for k, (i, j) in enumerate(_PLACES):
            to_field[k, :, :3] = (np.outer(found.matrix[i], q[j]) + np.outer(found.matrix[j], q[i])) / 2
    else:
        for k in range(free):
            to_field[k, :, :3] = np.outer(found.matrix[k // 3], q[k % 3])
    for k in range(centres):
        to_field[free + 3 * k : free + 3 * k + 3, :, 3 + k] = found.matrix
    rows = to_field.reshape(free + 3 * centres, 3 * width)
    normal = found.sums.along_normal / max(fit.chi2_along, 1.0) + found.sums.across_normal
    inner = rows.T @ normal @ rows
    scale = 1.0 / np.sqrt(np.maximum(np.diag(inner), 1e-300))
    values, vectors = np.linalg.eigh(inner * np.outer(scale, scale))
    gauge = 3 if free == SYMMETRIC else 0
    root = (vectors[:, gauge:] / np.sqrt(values[gauge:])) * scale[:, None]
    v = plane.basis
    spread_in = np.kron(v, np.eye(width))
    whitened = np.kron(np.eye(size) - v @ v.T, np.linalg.inv(moments)) + (spread_in @ root) @ (spread_in @ root).T
    sd = np.repeat(plane.noise, width)
    covariance = whitened * np.outer(sd, sd)
    pick = [width * i + j for i in range(size) for j in range(3)]
    pick += [width * i + 3 + k for k in range(centres) for i in range(size)]
    covariance = covariance[np.ix_(pick, pick)]
    if not gauge:
        return covariance
    of_c = [12 * s + j for s in range(sensors) for j in range(9)]
    fixing = np.eye(len(covariance))
    fixing[: 9 * sensors, : 9 * sensors] = frame_projection(forward)[np.ix_(of_c, of_c)]
    out: Array = fixing @ covariance @ fixing.T
    return out


def to_corrections(matrix: Array, centres: int) -> Array:
    """Derivative of the corrections' elements, and of the same offsets, with C and offsets in the order above."""
    sensors = len(matrix)
    out = np.eye(9 * sensors + 3 * sensors * centres)
    for s, m in enumerate(matrix):
        block = slice(9 * s, 9 * s + 9)
        out[block, block] = -np.kron(m, m.T)
    return out


def with_offset(sensors: int, weights: Array) -> Array:
    """(12 S, 9 S + 3 S K): the parameters of an ArrayCalibration whose offset is a weighted mean of the surveys'.

    Parameters
    ----------
    weights: (K,).
    """
    out = np.zeros((12 * sensors, 9 * sensors + 3 * sensors * len(weights)))
    for s in range(sensors):
        out[12 * s : 12 * s + 9, 9 * s : 9 * s + 9] = np.eye(9)
        for k, weight in enumerate(weights):
            at = 9 * sensors + 3 * sensors * k + 3 * s
            out[12 * s + 9 : 12 * s + 12, at : at + 3] = weight * np.eye(3)
    return out
