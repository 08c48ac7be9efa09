"""How unlikely one coefficient is where the spectrum of the noise is known from the residual alone.

A step of the base station lies in a few of the lowest frequencies, and there its own power is most of what the noise is
estimated from: however large it is, a score in units of that power stays small. What tells a step from noise of the
same power is that the values at all frequencies are what one coefficient makes them. Given the power in each band,
noise may point in any direction there (its spectrum is smooth, its values are independent), and the cosines of these
directions with the regressor have a known law whatever the power is. So the likelihood ratio, with the power of every
band free, is judged by that law: an exact conditional test. Its small probabilities are found by drawing cosines that
favour the alternative, weighed by how much they do (importance sampling, Hammersley and Handscomb 1964, chapter 5).
"""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array

LEAST_COUNT = 2.0  # values of a band, in fewer there is no direction to speak of
SIZES = 24  # of the coefficient, at which the likelihood is asked, between a hundredth and a quarter more than all
DRAWS = 250  # of cosines for each size, and as many for none
STEPS = 4001  # of a cosine
ROUNDING = 1e-12


def one_coefficient_p(counts: Array, product: Array, square: Array, power: Array) -> float:
    """Probability that noise has so large a likelihood ratio for one coefficient, given its power in each band.

    Parameters
    ----------
    counts: (B,) how many values a band holds that the fit has not taken; product: (B,) of them and the regressor;
        square, power: (B,) sums of squares of the regressor and of them.
    """
    known = (counts > LEAST_COUNT) & (square > ROUNDING * square.sum()) & (power > 0)
    if not known.any():
        return 1.0
    n, size = counts[known], np.sqrt(square[known] / power[known])
    cosine = product[known] / np.sqrt(square[known] * power[known])
    sizes = np.geomspace(0.01, 1.25, SIZES // 2) / size.max()
    sizes = np.concatenate([-sizes[::-1], sizes])
    found = _ratio(cosine[None], n, size, sizes)[0]
    rng = np.random.default_rng(1964)
    grid = (np.arange(STEPS) + 0.5) * 2.0 / STEPS - 1.0
    law = 0.5 * (n[:, None] - 3.0) * np.log1p(-(grid**2))  # of the cosine of any direction with a given one
    favour = np.concatenate([[0.0], sizes])[:, None] * size * n / np.maximum(1.0 - (sizes.max() * size) ** 2, 0.05)
    tilted = law + favour[:, :, None] * grid  # (T, B, STEPS)
    total = np.logaddexp.reduce(tilted, axis=2)
    drawn = np.empty((len(favour), DRAWS, len(n)))
    for t, b in np.ndindex(len(favour), len(n)):
        each = np.cumsum(np.exp(tilted[t, b] - total[t, b]))
        place = np.searchsorted(each / each[-1], rng.random(DRAWS))
        drawn[t, :, b] = grid[np.minimum(place, STEPS - 1)]
    cosines = drawn.reshape(-1, len(n))
    over = cosines @ favour.T - (total - total[0]).sum(axis=1)  # log density of each kind of draw over that of noise
    weight = np.exp(-(np.logaddexp.reduce(over, axis=1) - np.log(len(favour))))
    return float(min(np.mean(weight * (_ratio(cosines, n, size, sizes) >= found)), 1.0))


def _ratio(cosines: Array, counts: Array, size: Array, sizes: Array) -> Array:
    """(R,) the largest log likelihood ratio over coefficients of cosines (R, B), the power of each band being free."""
    best = np.zeros(len(cosines))
    for coefficient in sizes:
        part = coefficient * size
        left = np.maximum(1.0 - 2.0 * part * cosines + part**2, ROUNDING)
        best = np.maximum(best, -0.5 * np.log(left) @ counts)
    return best
