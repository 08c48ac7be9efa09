"""How unlikely coefficients of one series are where the spectrum of the noise is known from the residual alone.

What is slow, a step of the base station or a sensor that warms up, lies in a few of the lowest frequencies, and there
its own power is most of what the noise is estimated from: however large it is, a score in units of that power stays
small. What tells it from noise of the same power is that the values at all frequencies are what one series makes them.
Given the power in each band, noise may point in any direction there (its spectrum is smooth, its values are
independent), whatever the power is: an exact conditional test. Coefficients make the directions gather about those of
the series, as a von Mises-Fisher law says, and the likelihood ratio of these laws, averaged over sizes and over all
directions that coefficients may have, is what is judged. Its small probabilities are found by drawing directions from
that average, each weighed by the reciprocal of the ratio itself (importance sampling, Hammersley and Handscomb 1964,
chapter 5; draws as in Wood 1994).
"""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.sensor_noise import octaves

SPARE = 1.0  # values that a band has to hold more than a coefficient has directions: of fewer nothing is to be told
SIZES = 12  # of the coefficients, from a hundredth to a quarter more than what explains all of a band
DRAWS = 300  # of directions for each size, and as many for none
MOST_CERTAIN = 0.05  # of a band's power is left at least, where a size is said to explain all of it
EXACT_ORDER = 30.0  # of Bessel functions; beyond it they are given by their uniform expansion, to a thousandth
ROUNDING = 1e-12
SPHERE = 3  # dimensions


def one_series_p(counts: Array, product: Array, square: Array, power: Array) -> float:
    """Probability that noise has so large a likelihood ratio for the coefficients, given its power in each band.

    Parameters
    ----------
    counts: (B,) how many values a band holds that the fit has not taken; product: (B, D) sums of them times the series,
        in each of the D directions that the coefficients have, in which noise is alike; square: (B,) of the squares of
        the series; power: (B,) of the squares of the values.
    """
    dimension = product.shape[1]
    known = (counts >= dimension + SPARE) & (square > ROUNDING * square.sum()) & (power > 0)
    if not known.any():
        return 1.0
    n, size = counts[known], np.sqrt(square[known] / power[known])
    found = product[known] / np.sqrt(square[known] * power[known])[:, None]
    share = np.concatenate([[0.0], np.geomspace(0.01, 1.25, SIZES)])[:, None] * size / size.max()
    gathered = share * n / np.maximum(1.0 - share**2, MOST_CERTAIN)  # (T, B) the concentrations of the laws
    rng = np.random.default_rng(1964)
    ratio = _log_ratio(found[None], gathered, n)[0]
    drawn = _directions(gathered, n, dimension, rng)
    each = _log_ratio(drawn, gathered, n)
    return float(min(np.mean(np.exp(-each) * (each >= ratio - ROUNDING)), 1.0))


def _log_ratio(directions: Array, gathered: Array, counts: Array) -> Array:
    """(R,) log of the mean likelihood ratio of the laws (T, B) over no preference.

    Parameters
    ----------
    directions: (R, B, D) the part of the unit vectors of each band that coefficients can make.
    """
    length = np.linalg.norm(np.einsum("tb,rbd->trd", gathered, directions), axis=2)
    about = _log_mean(length, directions.shape[2]) - np.sum(_log_mean(gathered, counts), axis=1)[:, None]
    out: Array = np.logaddexp.reduce(about, axis=0) - np.log(len(gathered))
    return out


def _log_mean(length: Array, dimension: Array | float) -> Array:
    """Log of the mean of exp(v . u) over all unit vectors u of a dimension, of vectors v of that length.

    That is Gamma(m + 1) (2 / v)^m I_m(v), m = dimension / 2 - 1 (Mardia and Jupp 2000, equation 9.3.4); where m is
    large by the uniform expansion of I_m (Abramowitz and Stegun 1964, 9.7.7). In three dimensions it is sinh(v) / v.
    """
    from scipy.special import gammaln, ive

    if np.ndim(dimension) == 0 and dimension == SPHERE:
        v = np.maximum(length, ROUNDING)
        return np.asarray(v - np.log(2.0 * v) + np.log(-np.expm1(-2.0 * v)))
    length, order = np.broadcast_arrays(length, np.asarray(dimension) / 2.0 - 1.0)
    out = length**2 / (4.0 * (order + 1.0))  # of short ones
    exact = (order <= EXACT_ORDER) & (length > 1e-4)
    v, m = length[exact], order[exact]
    out[exact] = gammaln(m + 1.0) + m * np.log(2.0 / v) + np.log(ive(m, v)) + v
    large = order > EXACT_ORDER
    v, m = length[large], order[large]
    root = np.sqrt(1.0 + (v / m) ** 2)
    out[large] = m * (root - 1.0 + np.log(2.0 / (1.0 + root))) - 0.5 * np.log(root)
    return out


def _directions(gathered: Array, counts: Array, dimension: int, rng: np.random.Generator) -> Array:
    """(T DRAWS, B, D) draws from each law, about the first of D axes (no direction is special)."""
    first = _cosines(np.repeat(gathered, DRAWS, axis=0), counts, rng)
    out = np.empty((*first.shape, dimension))
    out[:, :, 0] = first
    if dimension > 1:
        others = rng.standard_normal((*first.shape, dimension - 1))
        beyond = rng.chisquare(np.broadcast_to(counts - dimension, first.shape))
        whole = np.sqrt(np.sum(others**2, axis=2) + beyond)
        out[:, :, 1:] = others * (np.sqrt(1.0 - first**2) / whole)[:, :, None]
    return out


def _cosines(gathered: Array, counts: Array, rng: np.random.Generator) -> Array:
    """(R, B) draws of the cosine with the direction about which unit vectors of so many dimensions gather (R, B)."""
    counts = np.broadcast_to(counts, gathered.shape)
    less = counts - 1.0
    slope = less / (2.0 * gathered + np.sqrt(4.0 * gathered**2 + less**2))
    start = (1.0 - slope) / (1.0 + slope)
    level = gathered * start + less * np.log1p(-(start**2))
    out, open_ = np.zeros(gathered.shape), np.ones(gathered.shape, dtype=bool)
    while open_.any():
        b, x, k, n = slope[open_], start[open_], gathered[open_], less[open_]
        beta = rng.beta(n / 2.0, n / 2.0)
        cosine = (1.0 - (1.0 + b) * beta) / (1.0 - (1.0 - b) * beta)
        taken = k * cosine + n * np.log1p(-x * cosine) - level[open_] >= np.log(rng.random(len(cosine)))
        places = np.flatnonzero(open_)[taken]
        out.flat[places] = cosine[taken]
        open_.flat[places] = False
    return out


def in_octaves(column: Array, values: Array, taken: Array) -> float:
    """P value of a column (N,) in values (N, D) of white noise over frequency, whose level is known from themselves.

    Parameters
    ----------
    taken: (N, Q) orthonormal, what has been projected off all of these.
    """
    count, dimension = values.shape
    edges = octaves(count)

    def sums(each: Array) -> Array:
        return np.add.reduceat(each, edges[:-1])

    left = dimension * (np.diff(edges) - sums(np.sum(taken**2, axis=1)))
    return one_series_p(left, sums(column[:, None] * values), sums(column**2), sums(np.sum(values**2, axis=1)))
