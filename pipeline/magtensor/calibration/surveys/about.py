"""How far the C of every survey lies off what a design of all of them says, beyond noise.

Each survey's scores at the fit, its own offsets eliminated, say how far its own C lies off. Their squares, each by its
covariance in noise alone, add up to a chi-square whose mean under the fit is known exactly; what exceeds it is taken
for a scatter of the elements of C between surveys, one variance for all of them (the moment estimate of DerSimonian and
Laird 1986, generalised). Once that is known, the best guess of a survey's own C is its own estimate drawn toward the
line by as much as noise asks for.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magtensor.calibration.types import Array

from .covariance import of_scatter, of_scores
from .design import Design, inverse_in, summed_up
from .said import Said

LEAST_FREEDOM = 1.0  # of what surveys have beyond a line
_NONE = 1e-9  # share of the largest information, below which a direction has none


def about_line(design: Design, surveys: Sequence[Said], chi2_along: float) -> tuple[tuple[float, float] | None, float]:
    """Chi-square about the design with its mean in noise alone, None where nothing is left to judge by; and the
    variance of the elements of C between surveys that explains the excess."""
    jacobians = [design.whitened(k) for k in range(len(surveys))]
    information = [one.information for one in surveys]
    noise = [of_scores(one, chi2_along) for one in surveys]
    bread = inverse_in(design.free(), summed_up(jacobians, information))
    unit = of_scatter(design, 1.0)
    scattered = [own @ unit @ own for own in information]
    of_noise, of_unit = (bread @ summed_up(jacobians, parts) @ bread for parts in (noise, scattered))
    square, expected, gained = 0.0, 0.0, 0.0
    for one, jacobian, own, in_noise, in_scatter in zip(surveys, jacobians, information, noise, scattered, strict=True):
        eliminate = _without_offsets(own)
        weight = _inverse(eliminate @ in_noise @ eliminate.T)
        score = eliminate @ one.score
        square += float(score @ weight @ score)
        taken = own @ jacobian
        for parts, own_part, add in ((of_noise, in_noise, 0), (of_unit, in_scatter, 1)):
            mixed = own_part @ jacobian @ bread @ taken.T
            left = eliminate @ (own_part - mixed - mixed.T + taken @ parts @ taken.T) @ eliminate.T
            mean = float(np.sum(weight * left))
            expected, gained = (expected + mean, gained) if add == 0 else (expected, gained + mean)
    if expected < LEAST_FREEDOM:
        return None, 0.0
    return (square, expected), max(square - expected, 0.0) / gained


def _without_offsets(information: Array) -> Array:
    """(9 S, 12 S): scores of C from those of [C | o], output after output, with the survey's own offsets eliminated."""
    places = np.arange(len(information)).reshape(-1, 4)
    c, o = places[:, :3].ravel(), places[:, 3]
    out = np.zeros((len(c), len(information)))
    out[np.arange(len(c)), c] = 1.0
    out[:, o] = -information[np.ix_(c, o)] @ _inverse(information[np.ix_(o, o)])
    return out


def _inverse(square: Array) -> Array:
    """Of a symmetric matrix, without the directions that have nothing."""
    scale = np.sqrt(np.maximum(np.diag(square), 1e-300))
    values, vectors = np.linalg.eigh(square / np.outer(scale, scale))
    seen = values > _NONE * values[-1]
    root = (vectors[:, seen] / np.sqrt(values[seen])) / scale[:, None]
    out: Array = root @ root.T
    return out


def own_deviation(design: Design, one: Said, variance: float, own_offsets: bool) -> tuple[Array, Array]:
    """How far C (S, 3, 3) and, of a survey with its own, o (S, 3) nT lie off the design: the best guess where the
    elements of C scatter by a variance between surveys.

    Parameters
    ----------
    one: what the survey says at the design.
    """
    sensors = len(design.noise) // 3
    if variance <= 0:
        return np.zeros((sensors, 3, 3)), np.zeros((sensors, 3))
    wanted = np.ones((3 * sensors, 4), dtype=bool)
    wanted[:, 3] = own_offsets
    prior = np.zeros((3 * sensors, 4))
    prior[:, :3] = design.noise[:, None] ** 2 / variance
    at = wanted.ravel()
    moved = np.zeros(12 * sensors)
    moved[at] = np.linalg.solve(one.information[np.ix_(at, at)] + np.diag(prior.ravel()[at]), one.score[at])
    rows = moved.reshape(3 * sensors, 4) * design.noise[:, None]
    return rows[:, :3].reshape(sensors, 3, 3), rows[:, 3].reshape(sensors, 3)
