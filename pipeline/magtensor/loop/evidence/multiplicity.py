"""How many independent tests the settings of a model amount to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.terms import Terms


def projected(terms: Terms, basis: Array) -> Array:
    """The series (N, K) of terms, of unit length, without what they have in an orthonormal basis (N, Q)."""
    left = terms.series - basis @ (basis.T @ terms.series)
    size = np.linalg.norm(left, axis=0)
    out: Array = left / np.where(size > 0, size, 1.0)
    return out


def alike(a: Array, b: Array) -> float:
    """Correlation of the test statistics of two settings, from their projected series (N, K)."""
    if a.shape != b.shape:
        return 0.0
    return float(np.sqrt(np.mean(np.einsum("nk,nk->k", a, b) ** 2)))


def effective_tests(correlations: Sequence[float], alpha: float) -> float:
    """Independent tests that a chain of dependent ones amounts to (Hunter 1976, Worsley 1982).

    The probability that any of them exceeds a limit is at most the sum of those of the single tests less those that
    neighbours exceed it together. Of two normal deviates with correlation r, one beyond z takes the other along with
    probability 2 Q(z sqrt((1 - r) / (1 + r))).

    Parameters
    ----------
    correlations: of each test with the one before it.
    alpha: probability at which all tests together are to be judged.
    """
    from scipy.special import ndtr, ndtri

    if not len(correlations):
        return 1.0
    r = np.clip(np.asarray(correlations, dtype=float), 0.0, 1.0)
    z = float(-ndtri(alpha / (len(r) + 1) / 2.0))
    together = 2.0 * ndtr(-z * np.sqrt((1.0 - r) / (1.0 + r)))
    return 1.0 + float(np.sum(1.0 - together))
