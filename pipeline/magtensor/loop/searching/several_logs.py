"""Several logs of one cause: two loggers of a current, or the current and the voltage that sags under it.

What acts is the cause and no log of it. The log with less noise explains more, whichever quantity acts; and once one
is adopted, its noise is in the data, of which the other knows something. It shows in the vectors: another log of the
same cause has those of the first, and a further effect has vectors of its own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.terms import Terms
from magtensor.loop.evidence.estimate import Estimate
from magtensor.loop.fitting.log_noise import brought_in, would_bring_in
from magtensor.loop.fitting.model import Adopted, State
from magtensor.loop.searching.contribution import happens_once, slices
from magtensor.loop.searching.gates import Candidate, gained_of_a_log

OUTSIDE = 0.01  # of what coefficients explain, that vectors which are the same may miss: a tenth of their size
CHANCE = 1e-3  # that noise makes them miss more


def of_another_log(state: State, model: Adopted, terms: Terms, estimate: Estimate) -> float:
    """Sum of squares that the noise of the logs of adopted models lets a model gain, which follows another log of the
    same causes; 0 for one that does not.

    Where effects of two currents are corrected with their noisy logs, the voltage that sags under both knows something
    of that noise. All that it explains of it, by whatever function of itself, lies along the currents' own vectors.

    Parameters
    ----------
    estimate: of the adopted terms and then the model's.
    """
    x = state.excitation
    if state.terms is None or not model.channels(x):
        return 0.0
    vectors = {
        which: _vectors(state.terms.only(range(part.start, part.stop)), state.theta[which], terms)
        for which, part in enumerate(slices(state))
        if state.adopted[which].channels(x)
    }
    alike = [which for which, several in vectors.items() if several]
    first = state.terms.count
    patterns = np.array([vector for which in alike for vector in vectors[which]]).T
    if not alike or not _along(estimate.theta[first:], estimate.beside(first), patterns):
        return 0.0
    return brought_in(state, set().union(*(state.adopted[which].channels(x) for which in alike)))


def worse_log(best: Candidate, other: Candidate, behind: float, state: State) -> bool:
    """Whether a model has the vectors of a better one, and the noise of its log explains what it is behind by.

    The better one follows another log, or none: what was switched on once did so without noise.

    Parameters
    ----------
    behind: twice the log likelihood ratio on held-out folds.
    """
    x = state.excitation
    if not other.model.channels(x) or not (best.model.channels(x) or happens_once(best.model)):
        return False
    first = len(best.assessment.estimate.theta) - best.terms.count
    own, its = best.assessment.estimate.theta[first:], other.assessment.estimate.theta[first:]
    pattern = _vector(other.terms, its, best.terms)[:, None]
    if not pattern.any() or not _along(own, best.assessment.estimate.beside(first), pattern):
        return False
    return behind <= gained_of_a_log(would_bring_in(state, other.model, its), other.assessment.estimate.rank)


def _along(theta: Array, information: Array, patterns: Array) -> bool:
    """Whether coefficients (P,) are a combination of patterns (P, M) but for noise and a tenth of their size."""
    from scipy.special import chdtri

    size = np.linalg.norm(patterns, axis=0)
    basis = patterns / np.where(size > 0, size, 1.0)
    within = basis @ np.linalg.lstsq(basis.T @ information @ basis, basis.T @ information @ theta, rcond=1e-9)[0]
    outside, whole = theta - within, float(theta @ information @ theta)
    free = len(theta) - basis.shape[1]
    return free > 0 and float(outside @ information @ outside) <= OUTSIDE * whole + float(chdtri(free, CHANCE))


def _vector(own: Terms, theta: Array, like: Terms) -> Array:
    """The coefficients of a model in the places of another's that act on the same axes in the same way, 0 elsewhere."""
    place = {label: float(value) for label, value in zip(_labels(own), theta, strict=True)}
    return np.array([place.get(label, 0.0) for label in _labels(like)])


def _vectors(own: Terms, theta: Array, like: Terms) -> list[Array]:
    """The same, of each function of its channel that another model has: the model's own first function in the places of
    that, where it acts there at all."""
    functions = [name.rpartition(" ")[0] for name in like.names]
    axes = [name.rpartition(" ")[2] for name in like.names]
    found = []
    for each in dict.fromkeys(functions):
        names = tuple(axis if f == each else "" for axis, f in zip(axes, functions, strict=True))
        vector = _vector(own, theta, replace(like, names=names))
        if vector.any():
            found.append(vector)
    return found


def _labels(terms: Terms) -> list[tuple[str, str, str]]:
    """Sensor, axis, and what the coefficients are of: nT or ppm."""
    units = (unit.split("/")[0] for unit in terms.units)
    return list(zip(terms.sensors, terms.names, units, strict=True))
