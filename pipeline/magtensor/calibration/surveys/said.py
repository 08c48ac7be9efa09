"""What the samples of one survey say of its own C and o of all sensors, as a score and its information.

Outputs divided by their noise, x = W b + w + noise of unit variance, with the unknown field b of every sample
eliminated: perpendicular to W the residual itself is left, 3 S - 3 values a sample; within it, b = W^+ (x - w) is one
three-axis sensor that the total field (and a known direction) judges. A change [dW | dw] moves the residual by its part
perpendicular to W times (b, 1), and the field by - W^+ [dW | dw] (b, 1). Rotations of b have no information without
known directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.calibration.joint_covariance import SYMMETRIC as PLACES
from magtensor.calibration.maximum_likelihood import along
from magtensor.calibration.types import Array

from .directions import Sighting, across
from .samples import Samples
from .sums import SYMMETRIC, InPlane, Sums, summed


@dataclass(frozen=True)
class Said:
    """Of one survey of n samples; parameters are [C | o] / noise, output after output, four each.

    Attributes:
        samples: n; across: sum of the squared residuals perpendicular to W.
        sums: of the part within W, E and e in the frame of C.
        to_field: (P, 12 S) the parameters of `sums` from a change of [C | o], with the sign reversed.
        perpendicular: (3 S, 3 S) projection; score: (12 S,) minus half the derivative of the cost.
        coloured: (12 S, 12 S) covariance of the score, without known directions, where noise is not white (`colour`).
    """

    samples: int
    across: float
    sums: Sums
    to_field: Array
    perpendicular: Array
    score: Array
    coloured: Array | None = None

    @property
    def cost(self) -> float:
        return self.across + self.sums.cost

    @property
    def outside(self) -> Array:
        """(12 S, 12 S): information perpendicular to W."""
        return np.kron(self.perpendicular, self.sums.moments[0])

    @property
    def along(self) -> Array:
        """(12 S, 12 S): information of |b| - F; of unknown constants without their mean."""
        own = self.sums.along_normal - np.outer(self.sums.held, self.sums.held)
        out: Array = self.to_field.T @ own @ self.to_field
        return out

    @property
    def sighted(self) -> Array:
        """(12 S, 12 S): information of known directions."""
        out: Array = self.to_field.T @ self.sums.across_normal @ self.to_field
        return out

    @property
    def information(self) -> Array:
        """(12 S, 12 S)."""
        return self.outside + self.along + self.sighted


@dataclass(frozen=True)
class OneSurvey:
    """Samples of one survey: raw (n, S, 3) nT and, of the part within W, what `InPlane` holds."""

    raw: Array
    total_field: Array
    level: np.ndarray | None = None
    reference_noise: float = 0.0
    sighting: Sighting | None = None


def each_of(samples: Samples, data: InPlane) -> list[OneSurvey]:
    """The surveys of samples that are all used, with the weights of `data`, which holds the same samples."""
    given = []
    for k in range(samples.surveys):
        mask = samples.survey == k
        own = samples.at(mask)
        sighting = None if data.sighting is None else data.sighting.at(mask)
        given.append(OneSurvey(own.raw, own.total_field, own.level, data.reference_noise, sighting))
    return given


@dataclass(frozen=True)
class View:
    """Samples of one survey at its C and o.

    Attributes:
        basis: (3 S, 3) orthonormal, spans W; matrix: (3, 3) from coordinates in it to b, in the frame of C.
        data: the coordinates, from b = 0; residual: (n, 3 S) perpendicular.
    """

    basis: Array
    matrix: Array
    data: InPlane
    residual: Array

    @property
    def field(self) -> Array:
        """(n, 3) nT, b."""
        out: Array = self.data.y @ self.matrix.T
        return out


def view(survey: OneSurvey, forward: Array, offset: Array, noise: Array) -> View:
    """Samples seen with C (S, 3, 3), o (S, 3) nT and the noise (3 S,) nT of the outputs."""
    x = (survey.raw - offset).reshape(len(survey.raw), -1) / noise
    basis, upper = np.linalg.qr(forward.reshape(-1, 3) / noise[:, None])
    y = x @ basis
    level = None if survey.level is None else np.unique(survey.level, return_inverse=True)[1]
    centre = np.zeros(len(y), dtype=int)
    data = InPlane(y, centre, survey.total_field, level, survey.reference_noise, survey.sighting)
    return View(basis, np.asarray(np.linalg.inv(upper), dtype=np.float64), data, x - y @ basis.T)


def said(seen: View) -> Said:
    """The score and the information of samples."""
    sums = summed(seen.data, seen.matrix, np.zeros((1, 3)))
    to_field = field_change(seen.matrix @ seen.basis.T, seen.data.free)
    one_more = np.column_stack([seen.field, np.ones(len(seen.residual))])
    score = seen.residual.T @ one_more
    score[:, :3] -= seen.residual.T @ _pull(seen, sums.total_field)  # W^+ turns with W
    score = score.ravel() + to_field.T @ sums.gradient
    perpendicular = np.eye(len(seen.basis)) - seen.basis @ seen.basis.T
    return Said(len(one_more), float(np.sum(seen.residual**2)), sums, to_field, perpendicular, score)


def _pull(seen: View, total_field: Array) -> Array:
    """(n, 3): half the derivative of the cost with b, times (W' W)^-1."""
    data = seen.data
    inward = along(seen.matrix, np.zeros(3), data.y.T, total_field, data.reference_noise)
    slope = (inward.unit * inward.residual * inward.inverse_std).T
    if data.sighting is not None:
        side = across(data.sighting, slice(None), seen.field, inward.length - total_field)
        slope = slope + np.einsum("nk,nki->ni", side.residual, side.slope)
    out: Array = slope @ seen.matrix @ seen.matrix.T
    return out


def field_change(inverse: Array, free: int) -> Array:
    """(P, 12 S): the parameters of `sums`, six or nine of E and three of e, from a change [dW | dw] of the outputs,
    which moves the field by -W^+ [dW | dw] (b, 1); with the sign reversed.

    Parameters
    ----------
    inverse: (3, 3 S), W^+.
    """
    outputs = inverse.shape[1]
    out = np.zeros((free + 3, outputs, 4))
    if free == SYMMETRIC:
        for k, (i, j) in enumerate(PLACES):
            out[k, :, j] += inverse[i] / 2
            out[k, :, i] += inverse[j] / 2
    else:
        for k in range(free):
            out[k, :, k % 3] = inverse[k // 3]
    out[free:, :, 3] = inverse
    return out.reshape(free + 3, 4 * outputs)
