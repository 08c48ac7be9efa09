"""The noise of sensors over frequency, across the plane that they share: how much each of them has in each octave."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.evidence.colour import Colour, colour_of

LEAST = 64  # samples, of fewer the noise is taken for white
OCTAVE = 4  # frequencies in the lowest one
NARROW = 4  # parts of an octave
BAND = 8  # frequencies in the lowest band in which sensors are compared
ALIKE = 4.0  # values that the axes of one sensor are taken to be alike by
_LEAST_POWER = 1e-12  # of the largest
_SMOOTHING = 8  # rounds in which a course between the middles of octaves gets their levels
_SCORING = 30  # rounds in which the levels of the sensors are found


@dataclass(frozen=True)
class SensorNoise:
    """What the contrasts between the sensors say of their noise.

    Attributes:
        values: (N, 3 S) the residual across, over the cosine frequencies, without its mean.
        projector: (3 S, 3 S) on the plane that they are in.
        left: (N,) part of the noise at each frequency that the values hold: less than all of it where something was
            taken off.
    """

    values: Array
    projector: Array
    left: Array

    @classmethod
    def of(cls, values: Array, projector: Array) -> SensorNoise:
        """Of all that there is."""
        return cls(values, projector, np.ones(len(values)))

    def without(self, series: Array) -> SensorNoise:
        """What the noise is beside series (N, K) over frequency, each with coefficients of its own in every output."""
        basis, size, _ = np.linalg.svd(series / self.root[:, None], full_matrices=False)
        basis = basis[:, size > 1e-9 * max(size.max(initial=0.0), 1e-300)]
        white = self.values / self.root[:, None]
        rest = (white - basis @ (basis.T @ white)) * self.root[:, None]
        left = np.maximum(self.left - np.sum(basis**2, axis=1), 0.0)
        return SensorNoise(rest, self.projector, left)

    @cached_property
    def edges(self) -> NDArray[np.int_]:
        """(B + 1,) frequencies between which the noise of the sensors is compared."""
        return bands(len(self.values))

    @cached_property
    def root(self) -> Array:
        """(N,) root of the mean power, smoothed."""
        power = np.sum(self.values**2, axis=1) / (len(self.projector) - 3)
        return np.sqrt(smoothed_spectrum(power, self.left))

    @cached_property
    def levels(self) -> Array:
        """(B, 3 S) power of each output's noise over that of all, in each band."""
        return _levels(grams_in_bands(self.values / self.root[:, None], self.edges), self.counts, self.projector)

    @cached_property
    def counts(self) -> Array:
        """(B,) how many values of an output tell its level."""
        return np.add.reduceat(self.left, self.edges[:-1])

    @cached_property
    def weights(self) -> Array:
        """(B, 3 S, 3 S) inverse covariance across of the sensors' noise in each band."""
        return inverse_of(self.projector * self.levels[:, None] @ self.projector, 1e-9)

    def from_quiet_to_noisy(self) -> list[int]:
        """The numbers of the sensors."""
        of_each = np.log(self.levels).reshape(len(self.levels), -1, 3).mean(axis=(0, 2))
        return [int(s) for s in np.argsort(of_each)]

    def narrow(self) -> list[tuple[slice, Array]]:
        """Bands so narrow that no power changes much in them, and the power of each output (3 S,) there.

        The power of an octave is as measured, its course there a law's for each sensor: white noise and slow processes.
        """
        power, held = np.empty(self.values.shape), self.left / self.root**2
        for s in range(len(self.projector) // 3):
            law, own = self._law(s).power, slice(3 * s, 3 * s + 3)
            course = np.ones(len(power)) if law is None else law
            for (i, j), count, level in zip(pairwise(self.edges), self.counts, self.levels[:, own], strict=True):
                power[i:j, own] = level * (course[i:j] * count / max(held[i:j] @ course[i:j], 1e-300))[:, None]
        power = np.maximum(power, _LEAST_POWER * power.max())  # where series took all that there was
        edges = np.unique(np.round(OCTAVE * 2.0 ** np.arange(0.0, np.log2(len(power)), 1.0 / NARROW)).astype(int))
        edges = np.concatenate([np.arange(OCTAVE), edges[(edges >= OCTAVE) & (edges < len(power))], [len(power)]])
        return [(slice(i, j), power[i:j].mean(axis=0)) for i, j in pairwise(edges)]

    def _law(self, sensor: int) -> Colour:
        """The law of a sensor's noise, from what differs between it and the others."""
        from scipy.fft import idct

        own, white = np.arange(3 * sensor, 3 * sensor + 3), self.values / self.root[:, None]
        differs = np.empty((len(white), 3))
        for (i, j), weight in zip(pairwise(self.edges), self.weights, strict=True):
            differs[i:j] = white[i:j] @ weight[:, own] @ inverse_of(weight[np.ix_(own, own)])
        return colour_of(idct(differs * self.root[:, None], axis=0, norm="ortho"), stiff=True, left=self.left)


def octaves(count: int) -> NDArray[np.int_]:
    """(B + 1,) edges of octaves of so many frequencies, the mean left out."""
    edges = OCTAVE * 2 ** np.arange(max(int(np.log2(count)), 1))
    return np.concatenate([[1], edges[edges < count // 2], [count]])


def bands(count: int) -> NDArray[np.int_]:
    """(B + 1,) edges of octaves of so many frequencies, wide enough to compare sensors in."""
    edges = BAND * 2 ** np.arange(max(int(np.log2(count)), 1))
    return np.concatenate([[0], edges[edges < count // 2], [count]])


def smoothed_spectrum(power: Array, left: Array | None = None) -> Array:
    """Power (N,) over the cosine frequencies, smoothed over octaves; below the middle of the lowest it rises as it does
    above.

    Parameters
    ----------
    left: (N,) the part of it that the power holds; all where not given.
    """
    n = len(power)
    if n < LEAST:
        return np.full(n, max(float(np.sum(power[1:]) / max(n - 1 if left is None else left[1:].sum(), 1.0)), 1e-300))
    edges, place = octaves(n), np.log(np.arange(1, n))
    part = np.ones(n - 1) if left is None else np.maximum(left[1:], 1e-9)
    parts = np.add.reduceat(part, edges[:-1] - 1)

    def means(values: Array) -> Array:
        return np.add.reduceat(values, edges[:-1] - 1) / parts

    level, middle = means(np.maximum(power[1:], 1e-300)), means(part * place)

    def between(course: Array) -> Array:
        values = np.interp(place, middle, course)
        slope = min((course[1] - course[0]) / (middle[1] - middle[0]), 0.0)
        return np.exp(values + slope * np.minimum(place - middle[0], 0.0))

    course = np.log(level)
    for _ in range(_SMOOTHING):
        course += np.log(level / means(part * between(course)))
    smooth = between(course)
    return np.concatenate([smooth[:1], smooth])


def _levels(squares: Array, counts: Array, projector: Array) -> Array:
    """(B, 3 S), the likeliest power of each output's noise in whitened values across.

    First of each sensor, then of each of its axes, held to that of the sensor as by some values more of the same power.
    Two sensors have one contrast, which does not tell whose noise it is.

    Parameters
    ----------
    squares: (B, 3 S, 3 S) products of the values of each band; counts: (B,) how many it has.
    """
    outputs, sensors = len(projector), len(projector) // 3
    covariance = squares / counts[:, None, None]
    if sensors < 3:
        mean = np.trace(covariance, axis1=1, axis2=2) / (outputs - 3)
        return np.repeat(mean[:, None], outputs, axis=1)
    of_sensors = _scored(covariance, projector, np.ones((len(counts), outputs)), 3, np.ones(len(counts)))
    values = counts * (sensors - 1) / sensors
    return _scored(covariance, projector, of_sensors, 1, values / (values + ALIKE))


def _scored(covariance: Array, projector: Array, levels: Array, alike: int, weight: Array) -> Array:
    """Levels (B, 3 S), those of so many neighbours alike, by steps of scoring on the logarithms from those given, which
    count for the rest of the weight (B,); halved, the steps keep the levels positive and raise the likelihood."""
    first, weight = levels, weight[:, None]

    def of_neighbours(matrices: Array) -> Array:
        each = np.diagonal(matrices, axis1=1, axis2=2).reshape(len(levels), -1, alike)
        return np.repeat(each.sum(axis=2), alike, axis=1)

    for _ in range(_SCORING):
        inverse = inverse_of(projector * levels[:, None] @ projector, 1e-9)
        seen, expected = of_neighbours(inverse @ covariance @ inverse), of_neighbours(inverse)
        likeliest = levels * np.sqrt(np.maximum(seen, 1e-12 * expected) / expected)
        levels = weight * likeliest + (1.0 - weight) * first
    return levels


def grams_in_bands(columns: Array, edges: NDArray[np.int_]) -> Array:
    """(B, P, P) products of the columns of (N, P) in each band."""
    return np.stack([columns[i:j].T @ columns[i:j] for i, j in pairwise(edges)])


def over_frequency(series: Array, axis: int = 0) -> Array:
    """The cosine transform of series (N, ...), or with N along another axis, of which noise has independent values."""
    from scipy.fft import dct

    out: Array = dct(series, axis=axis, norm="ortho")
    return out


def inverse_of(matrix: Array, least: float = 1e-10) -> Array:
    """The inverse in the directions in which symmetric matrices (..., P, P) have more than so little."""
    return np.asarray(np.linalg.pinv(matrix, rcond=least, hermitian=True), dtype=float)
