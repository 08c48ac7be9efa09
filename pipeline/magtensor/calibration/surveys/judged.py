"""Do the attitudes of several surveys together determine one matrix and a centre for each?

The two questions of `magtensor.calibration.coverage`, with what is free here: every centre its own three linear terms
of the quadric, every unknown constant of the field its own constant term; and the error of |b| in the worst direction
of the sphere, predicted for every centre. With known directions one quadric is not asked for: a regression has no
second solution, and its predicted error is that of the whole vector.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magtensor.calibration.coverage import RESOLUTION, Coverage, coverage, required_ratio
from magtensor.calibration.postures import attitude_design, sphere
from magtensor.calibration.quadric import design, design_derivative
from magtensor.calibration.types import Array

from .sums import SYMMETRIC, Found, InPlane

LEAST_SIGHTED = 9  # samples of known direction: the attitude's own error is found from what they leave,
LEAST_SIGHTED_ALONE = 12  # and the sensor's noise too where no neighbour tells it
LEAST_ATTITUDES_SIGHTED = 5  # four determine a matrix and an offset
_PICKED = 20_000  # samples that the words are found from


def judged(data: InPlane, found: Found, worst_error: float, sensors: int) -> Coverage:
    """What the attitudes of so many sensors determine, in the plane's own axes turned as the fit has turned them."""
    b, total_field = data.fields(found.matrix, found.centres), found.sums.total_field
    some = slice(None, None, max(1, len(b) // _PICKED))
    seen = coverage(
        b[some], total_field[some], matrix=np.eye(3), offset=np.zeros(3), worst_error=worst_error, stands_for=len(b)
    )
    second, required = (np.inf, 0.0) if data.sighting is not None else _second_distance(data, b, total_field)
    worst = _worst_error(data, found, float(np.mean(total_field)))
    if data.sighting is not None:
        least = LEAST_SIGHTED if sensors > 1 else LEAST_SIGHTED_ALONE
        seen = replace(seen, least_samples=least, least_attitudes=LEAST_ATTITUDES_SIGHTED)
    return replace(seen, second_distance=second, required_distance=required, worst_error=worst)


def _second_distance(data: InPlane, b: Array, total_field: Array) -> tuple[float, float]:
    """nT: the second smallest of Taubin's distances, and what it has to exceed."""
    from scipy.linalg import eigh

    size = SYMMETRIC + 3 * data.centres
    constants = np.zeros(len(b), dtype=int) if data.level is None else data.level
    count = int(constants.max()) + 1
    gram, slopes, sums = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, count))
    weight = np.bincount(constants, minlength=count).astype(float)
    for k, part in data.parts():
        at = np.concatenate([np.arange(SYMMETRIC), SYMMETRIC + 3 * k + np.arange(3)])
        x = b[part] / total_field[part][:, None]
        rows = design(x)[:, :9]
        gram[np.ix_(at, at)] += rows.T @ rows
        for axis in range(3):
            g = design_derivative(x, axis)[:, :9]
            slopes[np.ix_(at, at)] += g.T @ g
        sums[at] += np.stack([np.bincount(constants[part], c, minlength=count) for c in rows.T])
    centred = gram - (sums / np.maximum(weight, 1.0)) @ sums.T
    floor = 1e-13 * np.trace(slopes) * np.eye(size)
    values = np.sqrt(np.maximum(eigh(centred, slopes + floor, eigvals_only=True)[:2], 0.0))
    field = float(np.mean(total_field))
    free = size - 1 + count
    level = max(float(values[0]) * np.sqrt(len(b) / max(len(b) - free, 1)), RESOLUTION)
    return float(values[1]) * field, required_ratio(len(b) - (free - 9)) * level * field


def _worst_error(data: InPlane, found: Found, field: float) -> float:
    """nT: the predicted error of |b|, of b where directions are known, in the worst direction at the worst centre."""
    from scipy.special import chdtri

    sums, free = found.sums, data.free
    parameters = len(sums.gradient) + max(data.level.max() if data.level is not None else 0, 0)
    # with a known direction a sample tells three values, of which that along the field has its share of the parameters
    freedom = len(data.y) - (parameters if data.sighting is None else parameters / 3.0)
    if freedom < 1:
        return float("inf")
    # an attitude's standard deviation was found from what it leaves; that of the rest is in what the rest leaves
    normal = sums.along_normal / max(sums.along / freedom, 1e-300) + sums.across_normal
    scale = np.sqrt(np.diag(normal))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        return float("inf")
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    if values[0] <= 1e-14 * values[-1]:
        return float("inf")
    root = (vectors / np.sqrt(values)) / scale[:, None] * np.sqrt(freedom / chdtri(freedom, 0.95))
    worst = 0.0
    u = sphere()
    length = attitude_design(u) * np.concatenate([np.full(SYMMETRIC, field), np.ones(3)])
    for k in range(data.centres):
        own = root[np.concatenate([np.arange(free), free + 3 * k + np.arange(3)])]
        if free == SYMMETRIC:
            error = np.sum((length @ own) ** 2, axis=1)
        else:
            turned = field * np.einsum("nj,ijr->nir", u, own[:9].reshape(3, 3, -1)) + own[9:]
            error = np.sum(turned**2, axis=(1, 2))
        worst = max(worst, float(np.sqrt(error.max())))
    return worst
