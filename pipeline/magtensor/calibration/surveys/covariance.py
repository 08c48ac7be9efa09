"""The covariance of the parameters of several surveys, in the frame of the calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magtensor.calibration.types import Array

from .design import Design, inverse_in, summed_up
from .said import Said


def covariance_of(design: Design, surveys: Sequence[Said], chi2_along: float, scatter: float = 0.0) -> Array:
    """Covariance (P, P) of the parameters of a design.

    In white noise the scores of a survey have its information for their covariance, along the field times chi2_along
    where that is more than one; in other noise what its blocks show. What the convention of the frame fixes has no
    variance.

    Parameters
    ----------
    scatter: variance of the elements of C about what the design gives each survey.

    Raises
    ------
    NotEnoughData: a parameter is left open.
    """
    jacobians = [design.whitened(k) for k in range(len(surveys))]
    held, weight = np.zeros(design.size), sum(one.sums.weight for one in surveys)
    for jacobian, one in zip(jacobians, surveys, strict=True):
        held += jacobian.T @ one.to_field.T @ one.sums.held * np.sqrt(one.sums.weight)
    mean = np.outer(held, held) / weight if weight else np.zeros((design.size, design.size))
    bread = inverse_in(design.free(), summed_up(jacobians, [one.information for one in surveys]) + mean)
    between = np.zeros_like(bread)
    if scatter:
        own = [one.information @ of_scatter(design, scatter) @ one.information for one in surveys]
        between = summed_up(jacobians, own)
    filling = summed_up(jacobians, [of_scores(one, chi2_along) for one in surveys]) + mean
    out: Array = bread @ (filling + between) @ bread
    return (out + out.T) / 2


def of_scores(one: Said, chi2_along: float) -> Array:
    """(12 S, 12 S): covariance of a survey's scores."""
    if one.coloured is not None:
        return one.coloured + one.sighted
    return one.outside + max(chi2_along, 1.0) * one.along + one.sighted


def as_white(surveys: Sequence[Said]) -> list[Said]:
    """What surveys say, their noise taken as white."""
    return [replace(one, coloured=None) for one in surveys]


def of_scatter(design: Design, scatter: float) -> Array:
    """(12 S, 12 S): covariance of [C | o] / noise of a survey whose elements of C scatter by so large a variance."""
    own = np.repeat(design.noise**-2.0, 4) * scatter
    own[3::4] = 0.0
    return np.diag(own)


def to_corrections(matrix: Array) -> Array:
    """(9 S, 9 S): derivative of the corrections' elements with those of C, sensor after sensor, row by row."""
    sensors = len(matrix)
    out = np.zeros((9 * sensors, 9 * sensors))
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
