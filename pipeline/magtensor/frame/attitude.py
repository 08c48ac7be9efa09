"""The common rotation from a logged attitude: seen from the world, the field keeps its direction.

A_n P v_n = h for unit vectors v_n of the calibrated field, A_n platform to world, h the direction of the field in the
world. With h unknown but constant the cost is that of a hand-eye problem; with h known it is Wahba's (1965).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from magtensor.calibration.rotation import angle_between
from magtensor.calibration.types import Array
from magtensor.errors import DataError, NotEnoughData

from .calibration_errors import CalibrationErrors, directions
from .sources import TURNS, TWICE, Slope, edges_of, excess

LEAST_SAMPLES = 10
HALF_TURN = float(np.radians(20.0))  # rad; sensors are seldom mounted worse than this to their platform
WORST_MISFIT = float(np.radians(10.0))  # rad rms; an attitude that errs more is not that of these sensors


@dataclass(frozen=True)
class Attitude:
    """Moments of directions and attitudes; a `Source` whose nominal noise is 1 rad.

    Attributes:
        turned: (K, 3, 3, 3), in each block the sum of A_n[i, j] v_n[a].
        square: (3, 3), sum of v v'.
        counts: (K,) samples.
        world: (3,) unit vector, None where it is unknown.
        along: (R, 3, 3), sum of dv v'; across: (R, 3, 3, 3), sum of A_n[i, j] dv_n[a]; per unit of each error of the
            calibration.
    """

    turned: Array
    square: Array
    counts: Array
    world: Array | None
    along: Array
    across: Array
    name: str = "attitude"

    def cost(self, rotation: Array, spread: float) -> float:
        return 0.5 * self._misfit(rotation) / spread

    def slope(self, rotation: Array, spread: float) -> Slope:
        moved = np.einsum("ija,kja->ik", self._total, TURNS @ rotation)
        seen = rotation @ self.square @ rotation.T
        information = np.trace(seen) * np.eye(3) - seen
        response = np.einsum("kia,ic,rca->kr", TURNS @ rotation, rotation, self.along)
        if self.world is None:
            count = self.counts.sum()
            information -= moved.T @ moved / count
            response -= moved.T @ np.einsum("rija,ja->ir", self.across, rotation) / count
        toward = self._toward(rotation)
        step = -np.einsum("i,ija,klja->kl", toward, self._total, TWICE @ rotation, optimize=True)
        if self.world is None:
            step -= moved.T @ moved / self.counts.sum()
        information = information / spread
        return Slope(-moved.T @ toward / spread, information, information, step / spread, response / spread)

    def spread(self, rotation: Array) -> float:
        count = float(self.counts.sum())
        freedom = 2 * count - (3 if self.world is not None else 5)
        variance = max(self._misfit(rotation) / max(freedom, 1.0), 1e-18)
        toward, moved = self._toward(rotation), self._moved(rotation)
        gradients = -np.einsum("i,nik->nk", toward, moved)
        if self.world is None:
            short = np.einsum("nija,ja->ni", self.turned, rotation) - self.counts[:, None] * toward
            gradients -= short @ moved.sum(axis=0) / count
        scatter = self.slope(rotation, 1.0).information * variance
        return variance * max(excess(gradients, scatter), 1.0)

    def misfit(self, rotation: Array) -> float:
        """rad rms, of the field's directions seen from the world."""
        return float(np.sqrt(self._misfit(rotation) / self.counts.sum()))

    def free_because(self, directions: Array) -> str:
        return "the attitudes hardly turn the platform about a second axis; tilt it as well as turning it"

    @cached_property
    def _total(self) -> Array:
        return np.asarray(self.turned.sum(axis=0))

    def _toward(self, rotation: Array) -> Array:
        """(3,) where the field points in the world."""
        if self.world is not None:
            return self.world
        out: Array = np.einsum("ija,ja->i", self._total, rotation) / self.counts.sum()
        return out

    def _moved(self, rotation: Array) -> Array:
        """(K, 3, 3): derivative of the sum of A P v (second index) with a rotation vector (third)."""
        out: Array = np.einsum("nija,kja->nik", self.turned, TURNS @ rotation)
        return out

    def _misfit(self, rotation: Array) -> float:
        """Sum of squared lengths of A P v - h."""
        count, length = float(self.counts.sum()), float(np.trace(self.square))
        total = np.einsum("ija,ja->i", self._total, rotation)
        if self.world is None:
            return max(length - float(total @ total) / count, 0.0)
        return max(length - 2 * float(total @ self.world) + count, 0.0)


def attitude(b: Array, to_world: Array, errors: CalibrationErrors, world: Array | None = None) -> Attitude:
    """Read a survey for what its attitude says of the common rotation.

    Parameters
    ----------
    b: (N, S, 3) nT, calibrated to one common frame, finite, in the order of time.
    to_world: (N, 3, 3), platform to world.
    errors: of the calibration that made b.
    world: (3,), the field in the world frame, in any unit; None where it is unknown and constant.

    Raises
    ------
    NotEnoughData: too few samples.
    """
    if len(b) < LEAST_SAMPLES:
        raise NotEnoughData(f"{len(b)} samples with an attitude cannot tell the common rotation")
    direction, rows = directions(b)
    parts = edges_of(np.ones(len(b)))
    return Attitude(
        np.stack([np.einsum("nij,na->ija", to_world[p], direction[p]) for p in parts]),
        direction.T @ direction,
        np.array([p.stop - p.start for p in parts], dtype=float),
        None if world is None else np.asarray(world, dtype=float) / np.linalg.norm(world),
        errors.of_mean @ (rows.T @ direction),
        np.einsum("ijq,raq->rija", np.einsum("nij,nq->ijq", to_world, rows), errors.of_mean),
    )


def require_unmirrored(source: Attitude) -> None:
    """Refuse a field that follows a known world field as a mirror of it, which no rotation does.

    Raises
    ------
    DataError: an odd number of axes is inverted in all sensors.
    """
    if source.world is None:
        return
    u, s, vt = np.linalg.svd(np.einsum("i,ija->ja", source.world, source._total))
    nearest = np.asarray(u @ vt)
    count = float(source.counts.sum())
    left, proper = (float(np.trace(source.square)) + count - 2 * float(s @ [1, 1, sign]) for sign in (1, -1))
    if np.linalg.det(nearest) > 0 or left > count * WORST_MISFIT**2 or proper <= count * WORST_MISFIT**2:
        return
    axis = mirrored_axis(-nearest)
    which = "one axis or all three" if axis is None else f"axis {axis}"
    raise DataError(
        f"seen from the world the field is mirrored: {which} of every sensor is inverted",
        where="attitude",
        hint="correct the sign when loading the survey (`columns`, or the instrument's axes)",
    )


def mirrored_axis(rotation: Array) -> str | None:
    """The axis about which a rotation (3, 3) is half a turn, to within `HALF_TURN`; None where it is not of an axis.

    Half a turn about x and the inversion of all signs are together the mirror that inverts x.
    """
    for k, name in enumerate("xyz"):
        half = -np.eye(3)
        half[k, k] = 1.0
        if angle_between(rotation, half) < HALF_TURN:
            return name
    return None


def require_consistent(source: Attitude, rotation: Array) -> None:
    """Refuse an attitude that the field does not follow.

    Raises
    ------
    DataError: the field's direction in the world scatters by more than `WORST_MISFIT`.
    """
    misfit = source.misfit(rotation)
    if misfit > WORST_MISFIT:
        raise DataError(
            f"seen from the world the field turns by {np.degrees(misfit):.3g} deg rms: the attitude is not that of "
            "the sensors",
            where="attitude",
            hint="it must be platform to world, scalar last, on the time base of the samples",
        )
