"""What is left of a sensor that lies along the field it reads, or along its rate of change: noise of an output knows
neither.

A gain that changes as nobody logs adds a part of what is read, now more and now less; stamps that are now early and now
late add a part of its rate. No regressor follows either, but the squares and products of the axes of what is left do
follow those of what it would be a part of. Of noise, slow or not, they do not, whatever its covariance among the axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.fitting.model import State

ALPHA = 0.001  # for all sensors and laws together
BLOCKS = 20
LEAST_PER_BLOCK = 30
LEAST_SHARE = 0.25  # of the power of what is left of the sensor: laws of what is adopted leave less
ALIKE = 0.4  # of the worst sensor's, in each other: of three, one alone makes a quarter of it
CLEARLY = 1.3  # times the share of an earlier law: one gain of a sensor is three alike as well
EVERY, EACH_AXIS = np.ones((3, 3)), np.eye(3)
GAIN = "what it reads, as if its gain changed by {} rms, which follows no channel"
GAINS = "what each axis reads, as if its gain changed by {} rms, which follows no channel"
STAMPS = "how fast the field turns in it, as if its stamps were off by {} rms, now early and now late"


@dataclass(frozen=True)
class _Law:
    """What is left of a sensor as a part of a vector (N, 3), in its noise: the squares and products that follow."""

    words: str
    unit: str
    size: float
    vector: Array  # (N, S, 3), over the noise
    products: Array  # (3, 3), of those that are asked


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
    stamps: whether the rate is asked for.
    """
    from scipy.special import stdtrit

    residual, x = state.residual, state.excitation
    if residual.across is None or len(residual.across) < BLOCKS * LEAST_PER_BLOCK:
        return []
    noise, sensors = residual.noise.reshape(-1, 3), len(x.sensors)
    reads, rate = (x.sensed(v)[residual.samples] / noise for v in (x.field, x.rate))
    laws = [_Law(GAIN, "ppm", 1e6, reads, EVERY), _Law(GAINS, "ppm", 1e6, reads, EACH_AXIS)]
    laws += [_Law(STAMPS, "ms", 1e3, rate, EVERY)] if x.turns and stamps else []
    left = residual.across.reshape(-1, sensors, 3)
    least = float(stdtrit(BLOCKS - 1, 1.0 - ALPHA / (len(laws) * sensors)))
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
    amount = part * float(np.sqrt(np.mean(np.sum((law.vector[:, worst] * noise[worst]) ** 2, axis=1))))
    whose = "all sensors" if alike else x.sensors[worst] if sensors > 2 else " or ".join(x.sensors)
    follows = law.words.format(f"{law.size * part:.3g} {law.unit}")
    return [f"what is left of {whose} goes with {follows}: {amount:.3g} nT rms{' of each' * alike}"]


def _along(left: Array, law: _Law) -> _Found:
    """How surely and how much what is left (N, S, 3) is a part of the vector of a law.

    Judged are directions, nothing being louder than usual, by contiguous blocks; the amount is that of the whole.
    """
    own, by = (_centred(_soft(v), law.products)[0] for v in (left, law.vector))
    each = np.array([part.sum(axis=0) for part in np.array_split(np.sum(own * by, axis=(2, 3)), BLOCKS)])
    t = each.mean(axis=0) / np.maximum(each.std(axis=0, ddof=1) / np.sqrt(BLOCKS), 1e-300)
    (own, power), (by, size) = (_centred(v, law.products) for v in (left, law.vector))
    part = np.sum(own * by, axis=(0, 2, 3)) / np.maximum(np.sum(by**2, axis=(0, 2, 3)), 1e-300)
    return _Found(t, part * size / np.maximum(power, 1e-300), np.maximum(part, 0.0))


def _soft(vectors: Array) -> Array:
    """(N, S, 3), none longer than one: half as long as that where they are of their usual size."""
    square = np.sum(vectors**2, axis=2, keepdims=True)
    out: Array = vectors / np.sqrt(np.maximum(square + np.median(square, axis=0), 1e-300))
    return out


def _centred(vectors: Array, products: Array) -> tuple[Array, Array]:
    """(N, S, 3, 3) the products of the axes that are asked, less their means; (S,) the mean square of the vectors."""
    square = vectors[..., :, None] * vectors[..., None, :] * products
    mean = square.mean(axis=0)
    return square - mean, np.trace(mean, axis1=1, axis2=2)
