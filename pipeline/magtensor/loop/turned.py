"""The sensors' slow noise as a total field shows it: turned with the platform.

The sensors' slow noise is slow in their own axes. Along the field, |b| - F holds its projection on a direction that
turns: no stationary noise, however coloured, but a band at the rate of turning whose phase is known. A slow effect of
the sensors has the same form; judged in stationary noise it would seem to stand out of nothing. The noise's slowest
cosines, each in three axes, are random quantities of known variance here, and are filtered out with their covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.colour import Colour

LEAST_EXCESS = 1.0  # over the white power: a mode with less is left to the stationary part
MOST_MODES = 100
MOST_ENTRIES = 1e7
LAWS = (1.0, 2.0)  # of the power over frequency, tried for a single sensor
STRENGTHS = np.geomspace(1.0, 1e6, 13)  # of its slowest mode over white noise
SINGLE_MODES = 40


@dataclass(frozen=True)
class SlowModes:
    """Cosines over the survey times the response of |b| - F to three common axes.

    Attributes:
        response: (N, 3) d along / d whitened output in the plane the sensors share.
    """

    response: Array

    @property
    def most(self) -> int:
        """How many cosines are used at most."""
        n = len(self.response)
        return int(max(min(MOST_MODES, MOST_ENTRIES / (3 * n), n // 8), 0))

    @cached_property
    def columns(self) -> Array:
        """(N, 3 K), three columns for each cosine, slowest first, without the constant."""
        n = len(self.response)
        at = (np.arange(n) + 0.5) * np.pi / n
        cosines = np.sqrt(2.0 / n) * np.cos(at[:, None] * np.arange(1, self.most + 1))
        out: Array = (cosines[:, :, None] * self.response[:, None, :]).reshape(n, -1)
        return out

    @cached_property
    def gram(self) -> Array:
        """(3 K, 3 K)."""
        out: Array = self.columns.T @ self.columns
        return out


@dataclass(frozen=True)
class TurnedColour:
    """Slow noise in the sensors' axes, and a stationary rest.

    Attributes:
        modes: what the slow noise looks like.
        variance: (M,) of the first M columns of the modes, in the units of the squared residual over `white`.
        rest: the colour of what is left when they are filtered out.
    """

    modes: SlowModes
    variance: Array
    rest: Colour

    @property
    def white(self) -> float:
        """The white level."""
        return self.rest.white

    @property
    def lowest(self) -> float:
        """Power at the lowest frequency over the white level."""
        return self.rest.lowest * float(1.0 + self._spectrum[0].max())

    @cached_property
    def _spectrum(self) -> tuple[Array, Array]:
        size = np.sqrt(self.variance)
        m = len(size)
        values, vectors = np.linalg.eigh(self.modes.gram[:m, :m] * np.outer(size, size))
        return np.maximum(values, 0.0), vectors * size[:, None]

    def log_volume(self, count: int) -> float:
        """As `Colour.log_volume`."""
        return self.rest.log_volume(count) + float(np.sum(np.log1p(self._spectrum[0])))

    def whiten(self, series: Array) -> Array:
        """As `Colour.whiten`."""
        return self.rest.whiten(self.still(series))

    def still(self, series: Array) -> Array:
        """(N,) or (N, K) with the slow noise filtered down to the white level."""
        values, vectors = self._spectrum
        seen = values > 1e-12
        u = vectors[:, seen]
        weight = (1.0 - 1.0 / np.sqrt(1.0 + values[seen])) / values[seen]
        columns = self.modes.columns[:, : len(self.variance)]
        shown = u.T @ (columns.T @ series)
        out: Array = series - columns @ (u @ (weight * shown.T).T)
        return out


def excess_of(colour: Colour, most: int) -> Array:
    """(K,) power over the white level of the slowest cosines of a colour, as far as it is worth the while."""
    if colour.power is None:
        return np.zeros(0)
    beyond = colour.power[1 : most + 1] - 1.0
    count = int(np.argmax(beyond < LEAST_EXCESS)) if (beyond < LEAST_EXCESS).any() else len(beyond)
    return beyond[:count]


def excess_of_one(modes: SlowModes, along: Array, white: float) -> Array:
    """(K,) the likeliest power over the white level, where no other sensor shows it: a law of frequency."""
    count = min(modes.most, SINGLE_MODES)
    if count < 1:
        return np.zeros(0)
    gram = modes.gram[: 3 * count, : 3 * count]
    right = modes.columns[:, : 3 * count].T @ along
    best, likeliest = np.zeros(0), 0.0
    for law in LAWS:
        for strength in STRENGTHS:
            excess = strength / np.arange(1, count + 1) ** law
            size = np.sqrt(np.repeat(excess, 3))
            values, vectors = np.linalg.eigh(gram * np.outer(size, size))
            values = np.maximum(values, 0.0)
            explained = np.sum((vectors.T @ (size * right)) ** 2 / (1.0 + values)) / white
            likelihood = 0.5 * (explained - float(np.sum(np.log1p(values))))
            if likelihood > likeliest:
                best, likeliest = excess, likelihood
    return best
