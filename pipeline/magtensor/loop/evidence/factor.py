"""One factor common to the sensors beside noise of their own: maximum likelihood from a covariance.

Outputs n = w d + e, of which only z = N' n is seen, what lies off the plane that all sensors share. The noise e is that
of each group of outputs alone (a sensor, or an output): independent between groups, of any level and correlation within
one. So a group's own disturbance, however strong, is no common factor. Likelihood ratios have Bartlett's correction
(Lawley and Maxwell, Factor Analysis as a Statistical Method, 1971, chapter 4), which makes them chi-square from a few
dozen samples on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.evidence.scoring import rarity

Groups = Sequence[NDArray[np.int_]]
REACHED = 0.1  # singular value, relative, of a direction of covariances that noise of small correlation can reach
ROUNDING = 1e-9  # of the mean variance, that every direction has
_ITERATIONS = 400


@dataclass(frozen=True)
class Factors:
    """The model that fits a covariance best.

    Attributes:
        noise: (n, n) covariance of the groups' own noise, zero between groups.
        direction: (n,) of the factor, of unit variance; zero where there is none.
        covariance: (m, m) of what is seen.
        deviance: minus twice the log likelihood for each sample, over that of the covariance itself.
        freedom: how many numbers of the covariance the model leaves free to disagree with it.
    """

    noise: Array
    direction: Array
    covariance: Array
    deviance: float
    freedom: int

    def log_p(self, samples: float) -> float:
        """Log of the probability of so large a deviance where the model holds; zero where nothing can disagree."""
        if self.freedom == 0:
            return 0.0
        factors = int(self.direction.any())
        effective = samples - (2 * len(self.covariance) + 5) / 6 - 2 * factors / 3
        return -rarity(max(effective, 0.0) * self.deviance, self.freedom)


def noise_alone(covariance: Array, basis: Array, groups: Groups) -> Factors:
    """Noise of the groups and nothing in common.

    Parameters
    ----------
    covariance: (m, m) of z, positive definite.
    basis: (n, m) orthonormal, N of z = N' n.
    groups: the outputs of each group.
    """
    covariance = _definite(covariance)
    level = np.sqrt(np.trace(covariance) / len(covariance))
    return _fitted(covariance, basis, groups, level * np.eye(len(basis)), None)


def with_factor(covariance: Array, basis: Array, groups: Groups, alone: Factors) -> Factors:
    """Noise of the groups and one common factor; `alone` is the fit without it.

    The better of two maxima: from the noise as it is without a factor, and from a factor of all that the strongest
    direction has above the others. A strong factor is in the noise without it, and the search does not come back.
    """
    covariance = _definite(covariance)
    values, vectors = np.linalg.eigh(alone.covariance)
    values = np.maximum(values, 1e-9 * values[-1])
    root, inverse = vectors * np.sqrt(values) @ vectors.T, vectors / np.sqrt(values) @ vectors.T
    above, directions = np.linalg.eigh(inverse @ covariance @ inverse)
    first = basis @ (root @ directions[:, -1]) * np.sqrt(max(above[-1] - 1.0, 0.1))
    start = np.linalg.cholesky(alone.noise + 1e-9 * np.trace(alone.noise) * np.eye(len(basis)))
    variances, axes = np.linalg.eigh(covariance)
    rest = float(np.mean(variances[:-1]))
    strongest = basis @ axes[:, -1] * np.sqrt(variances[-1] - rest)
    fits = (
        _fitted(covariance, basis, groups, start, first),
        _fitted(covariance, basis, groups, np.sqrt(rest) * np.eye(len(basis)), strongest),
    )
    return min(fits, key=lambda fit: fit.deviance)


def refitted(covariance: Array, basis: Array, groups: Groups, near: Factors) -> Factors:
    """The same model as that of a covariance nearby, from where that was found."""
    covariance = _definite(covariance)
    noise = near.noise + 1e-9 * np.trace(near.noise) / len(basis) * np.eye(len(basis))
    direction = near.direction if near.direction.any() else None
    return _fitted(covariance, basis, groups, np.linalg.cholesky(noise), direction)


def _definite(covariance: Array) -> Array:
    """A covariance (m, m) with a trace of noise in every direction: outputs that were computed may have none."""
    out: Array = covariance + ROUNDING * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    return out


def _fitted(covariance: Array, basis: Array, groups: Groups, start: Array, direction: Array | None) -> Factors:
    """Quasi-Newton over the triangular roots of the groups' noise and the factor's direction."""
    from scipy.optimize import minimize

    size, m = basis.shape
    pairs = np.array([(i, j) for group in groups for a, i in enumerate(group) for j in group[: a + 1]])
    rows, columns = pairs.T
    own = float(np.linalg.slogdet(covariance)[1]) + m

    def parts(x: Array) -> tuple[Array, Array]:
        root = np.zeros((size, size))
        root[rows, columns] = x[: len(rows)]
        return root, x[len(rows) :] if direction is not None else np.zeros(size)

    def seen(root: Array, d: Array) -> Array:
        out: Array = basis.T @ (root @ root.T + np.outer(d, d)) @ basis
        return out

    def deviance(x: Array) -> tuple[float, Array]:
        root, d = parts(x)
        model = seen(root, d)
        model += 1e-12 * np.trace(model) * np.eye(m)
        inverse = np.linalg.inv(model)
        value = float(np.linalg.slogdet(model)[1] + np.sum(inverse * covariance)) - own
        slope = basis @ (inverse - inverse @ covariance @ inverse) @ basis.T
        gradient = 2.0 * (slope @ root)[rows, columns]
        return value, gradient if direction is None else np.concatenate([gradient, 2.0 * slope @ d])

    x0 = start[rows, columns] if direction is None else np.concatenate([start[rows, columns], direction])
    options = {"maxiter": _ITERATIONS, "maxfun": 2 * _ITERATIONS, "ftol": 1e-10, "gtol": 1e-7}
    found = minimize(deviance, x0, jac=True, method="L-BFGS-B", options=options)
    root, d = parts(found.x)
    return Factors(root @ root.T, d, seen(root, d), max(float(found.fun), 0.0), _freedom(basis, pairs, d))


def _freedom(basis: Array, pairs: NDArray[np.int_], direction: Array) -> int:
    """Numbers of the covariance less the directions in which the parameters move it."""
    size, m = basis.shape
    upper = np.triu_indices(m)
    moves = []
    for i, j in pairs:
        outer = np.outer(basis[i], basis[j])
        moves.append((outer + outer.T)[upper])
    if direction.any():
        d = basis.T @ (direction / np.linalg.norm(direction))
        for i in range(size):
            outer = np.outer(basis[i], d)
            moves.append((outer + outer.T)[upper])
    s = np.linalg.svd(np.array(moves), compute_uv=False)
    return len(upper[0]) - int(np.sum(s > REACHED * s[0]))
