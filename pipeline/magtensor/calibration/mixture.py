"""What a measured spectrum is made of: white noise and slow processes, none of them with a negative power."""

from __future__ import annotations

import numpy as np

from .types import Array

_MOST_STEPS = 30  # a few are enough but where a trend stands far above all else
_SHARES = 0.5 ** np.arange(8)  # of a step, tried in this order
_RESTS = 0.02  # twice the log likelihood that a last step gains


def likeliest_mixture(level: Array, count: Array, shapes: Array) -> tuple[Array, Array]:
    """(Q,) the weights, none of them negative, of spectral shapes (M, Q) that make mean squares (M,) of so many values
    each likeliest; and the spectrum (M,) that they make.

    By Fisher's scoring, each step a least-squares fit with the variances of the spectrum before it. Where a trend
    stands far above all else whole steps go in circles; a part of one always leads to what is likelier.
    """
    from scipy.optimize import nnls

    def fitted(about: Array) -> Array:
        weight = np.sqrt(count / 2.0) / np.maximum(about, 1e-300)
        return np.asarray(nnls(shapes * weight[:, None], level * weight, maxiter=100 * shapes.shape[1])[0])

    def modelled(weights: Array) -> Array:
        return np.maximum(shapes @ weights, max(1e-12 * level.max(), 1e-300))

    def unlikely(model: Array) -> float:
        return float(np.sum(count * (np.log(model) + level / model)))

    here = fitted(level)
    model = modelled(here)
    now = unlikely(model)
    for _ in range(_MOST_STEPS):
        step = fitted(model) - here
        for share in _SHARES:
            there = modelled(here + share * step)
            after = unlikely(there)
            if after < now:
                break
        else:
            break
        gained, here, model, now = now - after, here + share * step, there, after
        if gained < _RESTS:
            break
    return here, model
