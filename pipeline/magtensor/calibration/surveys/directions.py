"""The part of the likelihood that a known direction of the field adds: b across the line of sight of an attitude.

An attitude that errs by small angles, independent about every axis and of standard deviation s_a, puts the known
direction v off the true one by as much, F s_a in nT. What the sensors say of it is the direction of b, with noise U
U'. The residual |b| (u - v) is taken across b, u the direction of b; its covariance is s_a^2 F^2 (1 - uu') + the part
of U U' across u, less what the residual |b| - F along u tells already. It is the attitude that is noisy and the
outputs that stand in the derivatives, so a poor attitude does not attenuate the matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array, Mask
from magtensor.frame.sources import edges_of, excess


@dataclass(frozen=True)
class Sighting:
    """Known directions with their weights, which are held while the parameters are sought.

    Attributes:
        direction: (N, 3) v; length: (N,) nT, |b| when the weights were made: a scale of all fields changes nothing.
        root: (N, 3, 2) 1/nT; root' (b / |b| - v) length has unit variance.
        coupling: (N, 2), what of the along residual is taken off the two whitened ones, 1/nT.
        variance: (N,) nT^2, of one component across, from the outputs' noise alone.
    """

    direction: Array
    length: Array
    root: Array
    coupling: Array
    variance: Array

    def at(self, some: Mask) -> Sighting:
        """Those of some samples."""
        return Sighting(
            self.direction[some], self.length[some], self.root[some], self.coupling[some], self.variance[some]
        )


@dataclass(frozen=True)
class Across:
    """Two whitened residuals a sample, (n, 2), and their derivatives with the field, (n, 2, 3)."""

    residual: Array
    slope: Array


def sighting(matrix: Array, b: Array, direction: Array, attitude_std: float, reference_noise: float | None) -> Sighting:
    """Weights at fields b (N, 3) nT, made by U = matrix (3, 3) from outputs of unit variance.

    Parameters
    ----------
    direction: (N, 3); attitude_std: rad; reference_noise: nT, of a known total field; None where it is unknown, and the
        residual along the field, which then has a parameter of its own, tells nothing of those across.
    """
    length = np.linalg.norm(b, axis=1)
    unit = b / length[:, None]
    some = np.where(np.abs(unit[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(unit, some)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    tangent = np.stack([first, np.cross(unit, first)], axis=2)
    square = matrix @ matrix.T
    own = unit @ square
    along = np.einsum("ni,ni->n", own, unit) + (np.inf if reference_noise is None else reference_noise**2)
    mixed = np.einsum("nik,ni->nk", tangent, own)
    outputs = tangent.swapaxes(1, 2) @ square @ tangent - mixed[:, :, None] * mixed[:, None] / along[:, None, None]
    whole = outputs + (attitude_std * length)[:, None, None] ** 2 * np.eye(2)
    whiten = np.linalg.inv(np.linalg.cholesky(whole))
    return Sighting(
        direction,
        length,
        tangent @ whiten.swapaxes(1, 2),
        np.einsum("nkl,nl->nk", whiten, mixed / along[:, None]),
        0.5 * np.trace(outputs, axis1=1, axis2=2),
    )


def across(seen: Sighting, part: slice, b: Array, along: Array) -> Across:
    """The residuals of some samples with fields b (n, 3) nT and |b| - F = along (n,) nT."""
    length = np.linalg.norm(b, axis=1)
    unit, size = b / length[:, None], seen.length[part]
    root, coupling = seen.root[part], seen.coupling[part]
    off = size[:, None] * (unit - seen.direction[part])
    residual = np.einsum("nik,ni->nk", root, off) - coupling * along[:, None]
    turned = root * (size / length)[:, None, None]
    by_length = np.einsum("nik,ni->nk", turned, unit) + coupling
    slope = turned.swapaxes(1, 2) - by_length[:, :, None] * unit[:, None]
    return Across(residual, slope)


def disagreement(seen: Sighting, b: Array, total_field: Array) -> float:
    """How much more the parts of a record disagree about the rotation of everything than independent errors of the
    attitude let them: a ratio of variances, one where that may be chance. An attitude that drifts shows here.

    Parameters
    ----------
    b: (N, 3) nT at the minimum.
    """
    side = across(seen, slice(None), b, np.linalg.norm(b, axis=1) - total_field)
    turning = np.cross(b[:, None], side.slope)  # (N, 2, 3): derivative of either residual with a rotation vector
    gradient = np.einsum("nk,nki->ni", side.residual, turning)
    parts = edges_of(np.ones(len(b)))
    scatter = np.einsum("nki,nkj->ij", turning, turning)
    return excess(np.stack([gradient[p].sum(axis=0) for p in parts]), scatter)


def attitude_std(seen: Sighting, b: Array, total_field: Array, free: int) -> float:
    """rad, the angle by which the known directions scatter beyond the outputs' noise.

    Parameters
    ----------
    b: (N, 3) nT; free: parameters that the directions determined.
    """
    length = np.linalg.norm(b, axis=1)
    unit = b / length[:, None]
    off = b - length[:, None] * seen.direction
    off -= np.einsum("ni,ni->n", off, unit)[:, None] * unit
    count = len(b)
    variance = np.sum(off**2) / max(2 * count - free, 1) - np.mean(seen.variance)
    return float(np.sqrt(max(variance, 0.0) / np.mean(total_field**2)))
