"""Whether outputs share one waveform: the test in bands of the lowest frequencies, a second factor beside the first,
and what each sensor's residual has of the others' in stretches held out."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.evidence.factor import Factors, Groups, noise_alone, refitted, with_factor
from magtensor.loop.evidence.folds import FOLDS
from magtensor.loop.evidence.gains import Gain

ALPHA = 0.001  # family-wise over the bands
LEAST_BAND = 6  # coefficients of the lowest band for each value across


@dataclass(frozen=True)
class BandTest:
    """The band that speaks most clearly against noise of the groups alone.

    Attributes:
        band: number of its highest cosine frequency.
        effective: coefficients of one colour, and of one strength all the time, that would tell as much.
        covariance: of the values across; alone: as noise of the groups makes it; p: of the test.
    """

    band: int
    effective: float
    covariance: Array
    alone: Factors
    p: float


def strongest(white: Array, basis: Array, groups: Groups) -> BandTest:
    """The test in the lowest 1/2^k of the cosine coefficients of (N, m), for all k that leave enough of them."""
    from scipy.fft import dct

    n, m = white.shape
    coefficients = dct(white, axis=0, norm="ortho")
    count = int(np.log2((n - 1) / (LEAST_BAND * m)))
    bands = sorted({LEAST_BAND * m * 2**k for k in range(count + 1)} | {n - 1})
    tests = []
    for band in bands:
        own = coefficients[1 : band + 1]
        covariance = own.T @ own / band
        alone = noise_alone(covariance, basis, groups)
        effective = _effective(own, lowest(white, band), covariance)
        p = min(1.0, float(np.exp(alone.log_p(effective))) * len(bands))
        tests.append(BandTest(band, effective, covariance, alone, p))
    return max(tests, key=lambda t: t.band * t.alone.deviance)


def _effective(coefficients: Array, course: Array, covariance: Array) -> float:
    """How many coefficients of one colour and of one strength all the time tell as much.

    Parameters
    ----------
    coefficients: (K, m) of a band; course: (N, m) the same over time.
    """
    return len(coefficients) / (_unevenness(coefficients, covariance) * _unevenness(course, covariance))


def _unevenness(values: Array, covariance: Array) -> float:
    """By what factor fewer values (K, m) tell as much, where their powers rise and fall together.

    The covariance of two independent series varies as the mean product of their squares does.
    """
    values = values / np.sqrt(max(float(np.mean(values**2)), 1e-300) * len(covariance) / np.trace(covariance))
    powers, vectors = np.linalg.eigh(covariance)
    unit = values @ (vectors / np.sqrt(np.maximum(powers, 1e-12 * powers[-1])))
    square = unit**2
    products = square.T @ square / len(square)
    m = len(covariance)
    alike = (products.sum() - np.trace(products)) / (m * (m - 1))
    return max(float(alike), 1.0)


def lowest(series: Array, band: int) -> Array:
    """(N, K) without its mean and all cosine coefficients above the lowest ones."""
    from scipy.fft import dct, idct

    coefficients = dct(series, axis=0, norm="ortho")
    coefficients[0] = 0.0
    coefficients[band + 1 :] = 0.0
    out: Array = idct(coefficients, axis=0, norm="ortho")
    return out


def by_output(basis: Array) -> Groups:
    return [np.array([i]) for i in range(len(basis))]


def second_factor(test: BandTest, basis: Array, factors: Factors) -> float:
    """Strength of a second factor beside the first; zero where noise may make it."""
    alone = test.alone
    if factors.freedom == 0:  # three sensors: only noise of each output alone leaves anything to disagree
        alone = noise_alone(test.covariance, basis, by_output(basis))
        factors = with_factor(test.covariance, basis, by_output(basis), alone)
    if factors.log_p(test.effective) > np.log(ALPHA):
        return 0.0
    first = alone.deviance - factors.deviance - (alone.freedom - factors.freedom) / test.effective
    second = factors.deviance - factors.freedom / test.effective
    return second / max(first, 1e-300)


def predicted(inside: Array, outside: Array, basis: Array, groups: Groups) -> Gain:
    """Squares of each sensor's whitened residual as the others predict it, in stretches that the model has not seen.

    Before: the noise of the sensors, with all that it lets them know of each other. After: with the factor. What is
    outside the band is in both.
    """
    n = len(inside)
    edges = np.linspace(0, n, FOLDS + 1).round().astype(int)
    sums = np.stack([inside[a:b].T @ inside[a:b] for a, b in itertools.pairwise(edges)])
    split = [_own_and_others(basis, group) for group in groups]
    total = sums.sum(axis=0)
    noise = noise_alone(total / n, basis, groups)
    whole = with_factor(total / n, basis, groups, noise)
    before, after = np.zeros(FOLDS), np.zeros(FOLDS)
    for k, (a, b) in enumerate(itertools.pairwise(edges)):
        train = (total - sums[k]) / (n - (b - a))
        alone, factors = (refitted(train, basis, groups, near) for near in (noise, whole))
        for own, others in split:
            rest = float(np.sum((outside[a:b] @ own) ** 2))
            before[k] += rest + _error(alone.covariance, sums[k], own, others)
            after[k] += rest + _error(factors.covariance, sums[k], own, others)
    return Gain(before, after, np.diff(edges) * float(sum(own.shape[1] for own, _ in split)))


def _own_and_others(basis: Array, group: NDArray[np.int_]) -> tuple[Array, Array]:
    """Directions (m, k) that a group of outputs moves, and those (m, m - k) that it does not."""
    u, s, _ = np.linalg.svd(basis[group].T, full_matrices=True)
    return u[:, : len(s)], u[:, len(s) :]


def _error(model: Array, sums: Array, own: Array, others: Array) -> float:
    """Sum of squares of `own` less what a model's covariance predicts of it from `others`."""
    through = np.linalg.solve(others.T @ model @ others, others.T @ model @ own)
    left = own - others @ through
    return float(np.sum(left * (sums @ left)))
