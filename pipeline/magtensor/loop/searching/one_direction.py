"""Whether what lags the field goes with one direction of it only: then it need not be the field that is lagged.

Iron that is magnetised late shows the field through a matrix at each sensor, and one piece of another form or place
than the other, another matrix. A board that is warmed on the side that faces the sun, or a hot engine, is moved along
one vector at each sensor by one temperature, which lags the attitude: to first order a component of the field along one
direction, the same for all sensors. What such a direction explains nearly all of may be either.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.evidence.assessment import estimated
from magtensor.loop.fitting.model import State
from magtensor.loop.searching.contribution import put_back, slices

VISCOUS = "viscous_magnetisation"
CHANCE = 0.01  # probability that noise alone makes the other directions explain as much
A_FIFTH = 0.2  # of what matrices without any order would leave beside one direction
_ROUNDS = 50
_STILL = 1e-8  # a unit vector that moves no farther
_DRAWS = 30


def of_one_direction(state: State, which: int) -> bool:
    """Whether one direction of the lagged field explains what an adopted model with a matrix for each sensor does: all
    but what chance makes of the others, or a fifth of what is left of matrices whose entries are alike at random."""
    from scipy.special import chdtri

    assert state.terms is not None
    own = slices(state)[which]
    every = [i for i in range(state.terms.count) if not own.start <= i < own.stop]
    terms = state.terms.only([*every, *range(own.start, own.stop)])
    found = estimated(put_back(state.residual, state.terms, np.concatenate(state.theta)), terms, state.colours)
    theta, information = found.theta[len(every) :], found.beside(len(every))
    matrices = theta.reshape(-1, 3, 3)
    lost = beside_one_direction(matrices, information)
    freedom = 9 * len(matrices) - (3 * len(matrices) + 2)
    least = float(chdtri(freedom, CHANCE))
    return lost < max(least, A_FIFTH * left_by_chance(matrices, information) * float(theta @ information @ theta))


def beside_one_direction(matrices: Array, information: Array) -> float:
    """The sum of squares that matrices (S, 3, 3) explain beside the best k_s w' with one w for all of them.

    Parameters
    ----------
    information: (9 S, 9 S) on their entries.
    """
    rows, theta = 3 * len(matrices), matrices.ravel()
    by_entry = information.reshape(rows, 3, rows, 3)
    shown = (information @ theta).reshape(rows, 3)
    found = []
    w: Array
    for w in np.linalg.svd(matrices.reshape(-1, 3))[2]:
        for _ in range(_ROUNDS):
            k = _solved(w @ (by_entry @ w), shown @ w)
            before, w = w, _solved(k @ np.tensordot(k, by_entry, (0, 0)), k @ shown)
            w = np.asarray(w / max(float(np.linalg.norm(w)), 1e-300), dtype=float)
            if np.abs(w - before).max() < _STILL:
                break
        left = theta - np.outer(_solved(w @ (by_entry @ w), shown @ w), w).ravel()
        found.append(float(left @ information @ left))
    return min(found)


def _solved(normal: Array, shown: NDArray[np.floating[Any]]) -> Array:
    """The least of the solutions where the normal matrix leaves more than one."""
    return np.asarray(np.linalg.lstsq(normal, shown, rcond=1e-9)[0])


def left_by_chance(matrices: Array, information: Array) -> float:
    """The share of what they explain that matrices of random entries leave beside one direction, the sensors' (S, 3, 3)
    as much alike as the given ones: of one that all sensors have, one direction explains more. And so it does where the
    survey shows some entries far better than others.

    Parameters
    ----------
    information: (9 S, 9 S) on their entries.
    """
    flat = matrices.reshape(len(matrices), -1)
    squares, axes = np.linalg.eigh(flat @ flat.T)
    root = axes * np.sqrt(np.maximum(squares, 0.0))
    rng = np.random.default_rng(1)
    drawn = [(root @ rng.standard_normal(flat.shape)).reshape(matrices.shape) for _ in range(_DRAWS)]
    shares = [beside_one_direction(m, information) / float(m.ravel() @ information @ m.ravel()) for m in drawn]
    return float(np.mean(shares))
