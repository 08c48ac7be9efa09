"""What is left of a sensor that lies along the field it reads, across it, or along its rate of change: noise of an
output knows none of these.

A gain that changes as nobody logs adds a part of what is read, now more and now less; stamps that are now early and now
late add a part of its rate; a mount that swings adds what is across it. No regressor follows any of them, but the
squares and products of the axes of what is left do follow those of what it would be a part of. Of noise, slow or not,
they do not, whatever its covariance among the axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.by_blocks import BLOCKS, least_t, t_of
from magtensor.loop.fitting.model import State

ALPHA = 0.001  # for all sensors and laws together
LEAST_PER_BLOCK = 30
LEAST_SHARE = 0.25  # of the power of what is left of the sensor: laws of what is adopted leave less
ALIKE = 0.4  # of the worst sensor's, in each other: of three, one alone makes a quarter of it
CLEARLY = 1.3  # times the share of an earlier law: one gain of a sensor is three alike as well
EVERY, EACH_AXIS = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0]), np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
GAIN = "what it reads, as if its gain changed by {} rms, which follows no channel"
GAINS = "what each axis reads, as if its gain changed by {} rms, which follows no channel"
SWINGS = "what it reads, across that, as if it turned to and fro by {} rms, which follows no channel"
STAMPS = "how fast the field turns in it, as if its stamps were off by {} rms, now early and now late"


@dataclass(frozen=True)
class _Law:
    """What is left of a sensor as a part of a vector, and which squares and products of axes follow then."""

    words: str
    unit: str
    size: float
    vectors: Array  # (K, N, S, 3), over the noise: of any of which it is a part
    weights: Array  # (6,) of the squares, and of the products, each of which is there twice


@dataclass(frozen=True)
class _Found:
    t: Array  # (S,)
    share: Array  # (S,) of the power of what is left
    part: Array  # (S,) of the vector, mean square


def with_the_field(state: State, *, stamps: bool) -> list[str]:
    """The sensor what is left of which lies along the field or its rate, by how much; all, where all have as much of
    it; nothing where noise may have made it, and of a single sensor, whose gain shows as any error of the total field.

    Parameters
    ----------
    stamps: whether the rate, and a turn, are asked for.
    """
    residual, x = state.residual, state.excitation
    if residual.across is None or len(residual.across) < BLOCKS * LEAST_PER_BLOCK:
        return []
    noise, sensors = residual.noise.reshape(-1, 3), len(x.sensors)
    reads, rate = (x.sensed(v)[residual.samples] / noise for v in (x.field, x.rate))
    left = residual.across.reshape(-1, sensors, 3)
    laws = [_Law(GAIN, "ppm", 1e6, reads[None], EVERY), _Law(GAINS, "ppm", 1e6, reads[None], EACH_AXIS)]
    laws += [_Law(STAMPS, "ms", 1e3, rate[None], EVERY)] if x.turns and stamps else []
    laws += [_Law(SWINGS, "mrad", 1e3, _turned(left, reads, noise), EVERY)] if stamps else []
    least = least_t(ALPHA / (len(laws) * sensors))
    best: tuple[float, _Law, _Found] | None = None
    for law in laws:
        found = _along(left, law)
        share = float(np.max(np.where(found.t > least, found.share, 0.0)))
        if share > max(LEAST_SHARE, CLEARLY * best[0] if best else 0.0):
            best = share, law, found
    if best is None:
        return []
    _, law, found = best
    seen = np.diagonal(residual.projector).reshape(-1, 3).mean(axis=1)
    worst = int(np.argmax(np.where(found.t > least, found.part, 0.0)))
    alike = sensors > 2 and bool(np.all(found.part > ALIKE * found.part[worst]))
    part = float(np.sqrt(found.part[worst])) / (seen[worst] ** 0.5 if alike else seen[worst])
    amount = part * float(np.sqrt(np.mean(_square(law.vectors[:, :, worst] * noise[worst]))))
    whose = "all sensors" if alike else x.sensors[worst] if sensors > 2 else " or ".join(x.sensors)
    follows = law.words.format(f"{law.size * part:.3g} {law.unit}")
    return [f"what is left of {whose} goes with {follows}: {amount:.3g} nT rms{' of each' * alike}"]


def _along(left: Array, law: _Law) -> _Found:
    """How surely and how much what is left (N, S, 3) is a part of the vector of a law.

    Judged are directions, nothing being louder than usual, by contiguous blocks; the amount is that of the whole.
    """
    each = [_along_one(left[:, s], law.vectors[:, :, s], law.weights) for s in range(left.shape[1])]
    t, share, part = np.transpose(each)
    return _Found(t, share, np.maximum(part, 0.0))


def _along_one(left: Array, vectors: Array, weights: Array) -> tuple[float, float, float]:
    """The same of one sensor (N, 3), of vectors (K, N, 3): t, the share of its power, and the mean square as a part of
    them."""
    own, by = (_products(_soft(v)) for v in (left[None], vectors))
    each = np.array([part.sum() for part in np.array_split((own * by) @ weights, BLOCKS)])
    t = float(t_of(each))
    own, by = _products(left[None]), _products(vectors)
    part = float(np.sum((own * by) @ weights) / max(float(np.sum(by**2 @ weights)), 1e-300))
    return t, part * float(np.mean(_square(vectors)) / max(float(np.mean(_square(left[None]))), 1e-300)), part


def _turned(left: Array, reads: Array, noise: Array) -> Array:
    """(3, N, S, 3) what small turns about three axes of each sensor would add, times how much it turns about each: in
    every other block as what is left (N, S, 3) in the rest says.

    Parameters
    ----------
    reads: (N, S, 3), over the noise (S, 3).
    """
    out = np.zeros((3, *left.shape))
    block = np.arange(len(left)) * BLOCKS // len(left)
    for s in range(left.shape[1]):
        about = np.cross(np.eye(3)[:, None], reads[:, s] * noise[s]) / noise[s]  # (3, N, 3)
        alone = [_products(each[None]) for each in about]
        made = [alone[k] if k == m else _products((about[k] + about[m])[None]) - alone[k] - alone[m] for k, m in _PAIRS]
        own = _products(_soft(left[None, :, s]))
        for side in (0, 1):
            told, asked = block % 2 == side, block % 2 != side
            shape = np.column_stack([(m[told] - m[told].mean(axis=0)).ravel() for m in made])
            found = np.linalg.lstsq(shape, (own[told] - own[told].mean(axis=0)).ravel(), rcond=None)[0]
            spread = np.zeros((3, 3))
            for (k, m), value in zip(_PAIRS, found, strict=True):
                spread[k, m] = spread[m, k] = value
            strength, axes = np.linalg.eigh(spread)
            strength = np.maximum(strength, 0.0) / max(float(np.maximum(strength, 0.0).sum()), 1e-300)
            out[:, asked, s] = np.einsum("k,ak,anj->knj", np.sqrt(strength), axes, about[:, asked])
    return out


def _soft(vectors: Array) -> Array:
    """(K, N, 3), at no time longer than one: half as long as that where they are of their usual size."""
    square = _square(vectors)
    out: Array = vectors / np.sqrt(np.maximum(square + np.median(square), 1e-300))[:, None]
    return out


def _square(vectors: Array) -> Array:
    """(N,) sum of squares of vectors (K, N, 3)."""
    return np.asarray(np.sum(vectors**2, axis=(0, 2)))


def _products(vectors: Array) -> Array:
    """(N, 6) the squares of the axes of vectors (K, N, 3), and the products of each with the next, summed, less their
    means."""
    out = np.hstack([np.sum(vectors**2, axis=0), np.sum(vectors * np.roll(vectors, -1, axis=2), axis=0)])
    return np.asarray(out - out.mean(axis=0))
