"""The sensors' slow noise as a total field shows it: turned with the platform.

The sensors' slow noise is slow in their own axes. Along the field, |b| - F holds its projection on a direction that
turns: no stationary noise, however coloured, but a band at the rate of turning whose phase is known. A slow effect of
the sensors has the same form; judged in stationary noise it would seem to stand out of nothing. The noise's slowest
cosines, each in three axes, are random quantities of known variance here, and are filtered out with their covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.colour import Colour

ROUNDING = 1e-10  # of the largest eigenvalue of a matrix
LEAST_EXCESS = 1.0  # over the white power: a mode with less is left to the stationary part
MOST_MODES = 100
MOST_ENTRIES = 1e7
STEPS = 8  # of a half wave of the fastest mode
LAWS = (1.0, 2.0)  # of the power over frequency, tried for a single sensor
STRENGTHS = np.geomspace(1.0, 1e6, 13)  # of its slowest mode over white noise
SINGLE_MODES = 40


@dataclass(frozen=True)
class SlowModes:
    """Cosines over the survey times the response of |b| - F to three common axes.

    The cosines are slow: each is held over `step` samples, an eighth of the fastest half wave at most.

    Attributes:
        response: (N, 3) d along / d whitened output in the plane the sensors share.
        wanted: how many cosines are asked for.
    """

    response: Array
    wanted: int = MOST_MODES

    @property
    def most(self) -> int:
        """How many cosines are used, the slowest ones."""
        n = len(self.response)
        return int(max(min(self.wanted, MOST_ENTRIES / (3 * n), n // STEPS), 0))

    def slowest(self, count: int) -> SlowModes:
        """So many of them, which may be held for longer."""
        return replace(self, wanted=count)

    @property
    def step(self) -> int:
        """Samples over which a cosine is held."""
        return max(len(self.response) // (STEPS * max(self.most, 1)), 1)

    @cached_property
    def _held(self) -> Array:
        """(B, step, 3) the response, with zeros after the end."""
        return self._in_steps(self.response)

    @cached_property
    def _cosines(self) -> Array:
        """(K, B), of unit length over the survey. Of so few a product takes less time than a transform, whatever B."""
        blocks = len(self._held)
        phase = np.pi / blocks * np.outer(np.arange(1, self.most + 1), np.arange(blocks) + 0.5)
        return np.asarray(np.cos(phase) * np.sqrt(2.0 / len(self.response)))

    def seen_in(self, series: Array) -> Array:
        """(3 K, Q) products of (N, Q) with each cosine times response, three for each cosine, the slowest first."""
        q = series.shape[1]
        sums = self._held.transpose(0, 2, 1) @ self._in_steps(series)
        out: Array = self._cosines @ sums.reshape(len(sums), 3 * q)
        return out.reshape(3 * self.most, q)

    def made_of(self, coefficients: Array) -> Array:
        """(N, Q) series that have such coefficients (3 K, Q) in the cosines times response."""
        k, q = self.most, coefficients.shape[1]
        each = (self._cosines.T @ coefficients.reshape(k, 3 * q)).reshape(len(self._held), 3, q)
        out: Array = (self._held @ each).reshape(len(self._held) * self.step, q)
        return out[: len(self.response)]

    @cached_property
    def gram(self) -> Array:
        """(3 K, 3 K): a product of two cosines is half the sum of those of their difference and sum."""
        from scipy.fft import dct

        k = self.most
        products = self._held.transpose(0, 2, 1) @ self._held
        sums = dct(products, axis=0)[: 2 * k + 1] / 2.0
        order = np.arange(1, k + 1)
        pairs = sums[np.abs(order[:, None] - order)] + sums[order[:, None] + order]
        out: Array = (pairs / len(self.response)).transpose(0, 2, 1, 3).reshape(3 * k, 3 * k)
        return out

    def _in_steps(self, series: Array) -> Array:
        """(B, step, Q) of (N, Q), zeros after the end."""
        n, q = series.shape
        steps = -(-n // self.step)
        if n < steps * self.step:
            series = np.concatenate([series, np.zeros((steps * self.step - n, q))])
        return series.reshape(steps, self.step, q)


@dataclass(frozen=True)
class TurnedColour:
    """Slow noise in the sensors' axes, and a stationary rest.

    Attributes:
        modes: what the slow noise looks like, no more of them than have a variance.
        variance: (M,) of the columns of the modes, in the units of the squared residual over `white`.
        rest: the colour of what is left when they are filtered out.
    """

    modes: SlowModes
    variance: Array
    rest: Colour

    def __post_init__(self) -> None:
        object.__setattr__(self, "modes", self.modes.slowest(len(self.variance) // 3))

    def among(self, modes: SlowModes) -> TurnedColour:
        """The same where slow noise shows as these modes say, of a series with more or fewer samples."""
        modes = modes.slowest(len(self.variance) // 3)
        return TurnedColour(modes, self.variance[: 3 * modes.most], self.rest.among(len(modes.response)))

    def louder(self, times: float) -> TurnedColour:
        """The same of noise with so many times the power."""
        return self if times == 1.0 else replace(self, rest=self.rest.louder(times))

    @property
    def white(self) -> float:
        """The white level."""
        return self.rest.white

    @property
    def lowest(self) -> float:
        """Power at the lowest frequency over the white level."""
        shown = self.variance * np.diag(self.modes.gram)
        return self.rest.lowest * float(1.0 + shown.max())

    @cached_property
    def _root(self) -> tuple[Array, Array]:
        """sqrt(variance) (M,), and the lower Cholesky factor (M, M) of one plus the modes' power over the white."""
        size = np.sqrt(self.variance)
        power = self.modes.gram * np.outer(size, size)
        try:
            return size, np.linalg.cholesky(np.eye(len(size)) + power)
        except np.linalg.LinAlgError:  # next to noiseless: rounding of the largest is more than the white level
            values, vectors = np.linalg.eigh(power)
            values = 1.0 + np.maximum(values, ROUNDING * values[-1])
            return size, np.linalg.cholesky((vectors * values) @ vectors.T)

    def log_volume(self, count: int) -> float:
        """As `Colour.log_volume`."""
        return self.rest.log_volume(count) + 2.0 * float(np.sum(np.log(np.diag(self._root[1]))))

    def whiten(self, series: Array, *, back: bool = True) -> Array:
        """As `Colour.whiten`."""
        return self.rest.whiten(self.still(series), back=back)

    def still(self, series: Array) -> Array:
        """(N,) or (N, Q) with the slow noise filtered down to the white level.

        With columns A of the noise's standard deviation, G = A' A and its Cholesky factor K of 1 + G, the filter
        1 - A (1 + K')^-1 K^-1 A' is a root of (1 + A A')^-1.
        """
        from scipy.linalg import solve_triangular

        size, root = self._root
        columns = series.reshape(len(series), -1)
        shown = size[:, None] * self.modes.seen_in(columns)
        taken = solve_triangular(root, shown, lower=True, check_finite=False)
        taken = solve_triangular(root + np.eye(len(size)), taken, trans="T", lower=True, check_finite=False)
        out: Array = columns - self.modes.made_of(size[:, None] * taken)
        return out.reshape(series.shape)


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
    right = modes.seen_in(along[:, None])[: 3 * count, 0]
    best, likeliest = np.zeros(0), 0.0
    for law in LAWS:
        excess = 1.0 / np.arange(1, count + 1) ** law
        size = np.sqrt(np.repeat(excess, 3))
        values, vectors = np.linalg.eigh(gram * np.outer(size, size))
        values = np.maximum(values, 0.0)
        shown = (vectors.T @ (size * right)) ** 2 / white
        for strength in STRENGTHS:
            powers = strength * values
            explained = float(np.sum(strength * shown / (1.0 + powers)))
            likelihood = 0.5 * (explained - float(np.sum(np.log1p(powers))))
            if likelihood > likeliest:
                best, likeliest = strength * excess, likelihood
    return best
