"""A calibration that changes with the date: C and o at a date, with the covariance carried there.

The change is kept in the axes of the raw outputs, G = (dC/dt) C^-1: its diagonal is the drift of the scale factors, the
rest that of angles, and turning the common frame leaves it as it is. So does it leave the relative errors dC C^-1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibration.joint import diagnostics, widening
from magtensor.calibration.joint_covariance import frame_projection
from magtensor.calibration.types import Array, ArrayCalibration

from .changing import ChangingFit
from .corrections import frame_words, scatter_of
from .covariance import as_white, covariance_of, to_corrections
from .straight import Straight

UNSEEN_RATE = (
    "a rotation that all sensors share between surveys: every survey's frame is the one nearest to the raw axes"
)


@dataclass(frozen=True)
class Change:
    """How C and o change about a date, linear in time.

    Attributes:
        rate: (S, 3, 3) 1/a, (dC/dt) C^-1 at that date; offset_rate: (S, 3) nT/a, zero where offsets do not change.
        covariance: (24 S, 24 S): of each sensor the relative error dC C^-1 (row by row) and o, sensor after sensor;
            then of each sensor the rate and the rate of o.
    """

    rate: Array
    offset_rate: Array
    covariance: Array


@dataclass(frozen=True)
class Dated:
    """A calibration at a date, and its change about it."""

    calibration: ArrayCalibration
    change: Change

    def after(self, years: float) -> Dated:
        """So many years later."""
        cal, own = self.calibration, self.change
        sensors, half = len(cal.matrix), 12 * len(cal.matrix)
        back = np.asarray(np.linalg.inv(np.eye(3) + years * own.rate), dtype=np.float64)  # C(t) = (1 + t G) C
        to_matrix, of_rate, of_error, to_rate = (np.zeros((half, half)) for _ in range(4))
        later_error = np.zeros((half, half))
        for s in range(sensors):
            c, o = slice(12 * s, 12 * s + 9), slice(12 * s + 9, 12 * s + 12)
            h = back[s]
            to_matrix[c, c] = np.kron(np.eye(3), h.T)
            of_rate[c, c] = -years * np.kron(cal.matrix[s] @ h, h.T)
            of_error[c, c] = -np.kron(cal.matrix[s], np.eye(3))  # dM = -M (dC C^-1)
            later_error[c, c] = np.kron(np.eye(3) + years * own.rate[s], h.T)
            to_rate[c, c] = np.kron(h, h.T)
            of_rate[o, o] = years * np.eye(3)
            to_matrix[o, o] = of_error[o, o] = later_error[o, o] = to_rate[o, o] = np.eye(3)
        rates = own.covariance[half:, half:]
        mixed = to_matrix @ of_error @ own.covariance[:half, half:] @ of_rate.T
        covariance = to_matrix @ cal.covariance @ to_matrix.T + mixed + mixed.T + of_rate @ rates @ of_rate.T
        error_of_rate = np.zeros((half, half))
        for s in range(sensors):
            c, o = slice(12 * s, 12 * s + 9), slice(12 * s + 9, 12 * s + 12)
            error_of_rate[c, c] = years * np.kron(np.eye(3), back[s].T)
            error_of_rate[o, o] = years * np.eye(3)
        move = np.block([[later_error, error_of_rate], [np.zeros((half, half)), to_rate]])
        later = replace(
            cal, matrix=cal.matrix @ back, offset=cal.offset + years * own.offset_rate, covariance=covariance
        )
        change = Change(own.rate @ back, own.offset_rate, move @ own.covariance @ move.T)
        return Dated(later, change)


def dated(fit: ChangingFit, found: Straight, survey: int, mean_offset: bool = False) -> Dated:
    """The calibration at the date of one survey, with its offset or the mean of all surveys' own.

    The scatter of C about the line, and of the offsets where their mean is taken, is in the covariance.
    """
    design, t = fit.design, float(fit.years[survey])
    sensors, surveys, terms = len(design.noise) // 3, len(fit.said), design.matrices.shape[1]
    weights, slope = design.offsets[survey], np.zeros(design.offsets.shape[1])
    if mean_offset:
        weights = np.full(surveys, 1.0 / surveys)
    elif not design.own_offsets and len(slope) == 2:
        slope[1] = 1.0
    here = design.at(np.array([1.0, t])[:terms], weights)
    rate = design.at(np.array([0.0, 1.0])[:terms], slope)
    values, rates = ((j @ fit.parameters).reshape(sensors, 12) for j in (here, rate))
    forward, offset = values[:, :9].reshape(-1, 3, 3), values[:, 9:]
    matrix = np.asarray(np.linalg.inv(forward), dtype=np.float64)
    relative = rates[:, :9].reshape(-1, 3, 3) @ matrix
    to_error, to_rate, less, to_correction = (np.zeros((12 * sensors, 12 * sensors)) for _ in range(4))
    for s, m in enumerate(matrix):
        c, o = slice(12 * s, 12 * s + 9), slice(12 * s + 9, 12 * s + 12)
        to_error[c, c] = to_rate[c, c] = np.kron(np.eye(3), m.T)
        less[c, c] = np.kron(relative[s], np.eye(3)) @ to_error[c, c]
        to_correction[c, c] = -np.kron(m, m.T)
        to_error[o, o] = to_rate[o, o] = to_correction[o, o] = np.eye(3)
    both = np.concatenate([to_error @ here, to_rate @ rate - less @ here])
    between = _between(fit, found, forward, mean_offset)
    covariance = both @ found.covariance @ both.T
    half = 12 * sensors
    covariance[:half, :half] += to_error @ between @ to_error.T
    own = here @ found.covariance @ here.T + between
    told = diagnostics(fit.alike.keep, fit.alike.chi2_along, fit.alike.plane, fit.alike.coverage, matrix)
    frame, free, more = frame_words(fit.alike)
    if any(one.coloured is not None for one in fit.said):
        white = here @ covariance_of(design, as_white(fit.said), fit.alike.chi2_along, found.scatter**2) @ here.T
        more |= widening(to_correction @ own @ to_correction.T, to_correction @ (white + between) @ to_correction.T)
    free = (*free, UNSEEN_RATE) if free and terms == 2 else free
    calibration = ArrayCalibration(matrix, offset, to_correction @ own @ to_correction.T, frame, free, told | more)
    return Dated(calibration, Change(relative, rates[:, 9:], covariance))


def survey_covariance(fit: ChangingFit, found: Straight, survey: int) -> Array:
    """Covariance (9 S + 3 S K, squared) of the corrections' elements at the date of one survey, sensor after sensor,
    and of the offsets of every survey, each its own."""
    design, t = fit.design, float(fit.years[survey])
    sensors, terms, surveys = len(design.noise) // 3, design.matrices.shape[1], len(fit.said)
    of_c = np.arange(12 * sensors).reshape(sensors, 12)[:, :9].ravel()
    here = design.at(np.array([1.0, t])[:terms], np.zeros(surveys))[of_c]
    forward = (here @ fit.parameters).reshape(-1, 3, 3)
    matrix = np.asarray(np.linalg.inv(forward), dtype=np.float64)
    size = 9 * sensors
    both = np.concatenate([to_corrections(matrix) @ here, np.eye(design.size)[size * terms :]])
    covariance: Array = both @ found.covariance @ both.T
    between = _between(fit, found, forward, False)[np.ix_(of_c, of_c)]
    covariance[:size, :size] += to_corrections(matrix) @ between @ to_corrections(matrix).T
    return covariance


def _between(fit: ChangingFit, found: Straight, forward: Array, mean_offset: bool) -> Array:
    """(12 S, 12 S): what C and o of one survey scatter by about the line, or the mean."""
    sensors = len(forward)
    places = np.arange(12 * sensors).reshape(sensors, 12)
    out = np.zeros((12 * sensors, 12 * sensors))
    of_c = places[:, :9].ravel()
    out[of_c, of_c] = found.scatter**2
    if not fit.design.sighted:
        fixing = frame_projection(forward)
        out = fixing @ out @ fixing.T
    if mean_offset:
        of_o = places[:, 9:].ravel()
        out[of_o, of_o] += offset_scatter(fit, found) ** 2 * (1 + 1 / len(fit.said))
    return out


def offset_scatter(fit: ChangingFit, found: Straight) -> float:
    """nT: `scatter_of` the surveys' own offsets."""
    size = 3 * len(fit.design.noise) * fit.design.matrices.shape[1]
    offset = fit.parameters[size:].reshape(-1, len(fit.design.noise))
    return scatter_of(offset, found.covariance[size:, size:])
