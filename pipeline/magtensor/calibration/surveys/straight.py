"""Do surveys want a C that changes with the date, and does a straight line explain them?

The surveys about the line are judged as in `about`, the change itself by its covariance with their scatter in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array

from .about import about_line
from .changing import ChangingFit
from .covariance import covariance_of

SIGNIFICANT = 0.01  # chance that noise as stated passes for a change, or for a scatter


@dataclass(frozen=True)
class Straight:
    """How C changes and how straight.

    Attributes:
        covariance: (P, P) of the parameters, with the scatter.
        change: chi-square of the change of C, of offsets alone where only they change, and its degrees of freedom;
            chance: that no change gives as much.
        about: chi-square of the surveys about the line and its mean in noise alone; None of two surveys.
        about_chance: that noise alone gives as much; 1 of two surveys.
        scatter: standard deviation of the elements of C about the line between surveys.
    """

    covariance: Array
    change: tuple[float, int]
    chance: float
    about: tuple[float, float] | None
    about_chance: float
    scatter: float


def straight(fit: ChangingFit) -> Straight:
    """Judge the line through the surveys of a fit."""
    from scipy.special import chdtrc

    about, variance = about_line(fit.design, fit.said, fit.alike.chi2_along)
    covariance = covariance_of(fit.design, fit.said, fit.alike.chi2_along, variance)
    size, of_c = 3 * len(fit.design.noise), fit.design.matrices.shape[1] == 2
    own = slice(size, 2 * size) if of_c else slice(len(covariance) - size // 3, len(covariance))
    rate = fit.parameters[own]
    std = np.sqrt(np.diag(covariance)[own])
    values, vectors = np.linalg.eigh(covariance[own, own] / np.outer(std, std))
    freedom = len(rate) - (3 if of_c and not fit.design.sighted else 0)
    square = float(np.sum((vectors[:, -freedom:].T @ (rate / std)) ** 2 / values[-freedom:]))
    return Straight(
        covariance,
        (square, freedom),
        float(chdtrc(freedom, square)),
        about,
        1.0 if about is None else float(chdtrc(about[1], about[0])),
        float(np.sqrt(variance)),
    )


def in_words(found: Straight, rate: Array, offset_rate: Array, sensors: Sequence[str]) -> str:
    """What the line says, in a sentence or two.

    Parameters
    ----------
    rate: (S, 3, 3) 1/a, relative, in the axes of the raw outputs, zero where C does not change; offset_rate: (S, 3)
        nT/a.
    """
    of_c = bool(rate.any())
    place = np.unravel_index(int(np.abs(rate if of_c else offset_rate).argmax()), (rate if of_c else offset_rate).shape)
    where = f"{sensors[int(place[0])]} {''.join('xyz'[int(i)] for i in place[1:])}"
    most = f"{abs(rate[place]):.2g}" if of_c else f"{abs(offset_rate[place]):.3g} nT"
    square, freedom = found.change
    what, less = ("C changes", "matrices: common") if of_c else ("the offsets change", "offsets: common")
    words = f"{what} by up to {most} a year ({where}), chi2 {square:.4g} of {freedom}: "
    words += (
        "the surveys want the change"
        if found.chance < SIGNIFICANT
        else f"noise explains it, and `{less}` says as much with fewer parameters"
    )
    if found.about is None:
        return f"{words}. Two surveys lie on any line: whether the change is steady cannot be told"
    square, mean = found.about
    told = f"chi2 {square:.4g} about it, where noise has {mean:.4g}"
    if found.about_chance < SIGNIFICANT:
        return (
            f"{words}. The line does not explain all ({told}): C scatters by {found.scatter:.2g} (rms of its elements) "
            "between surveys, which the standard deviations hold"
        )
    return f"{words}. The line explains C of the surveys ({told})"
