"""An attitude that was read the wrong way round: does it go with the field, and if not, how would it?

Seen from the world a uniform field keeps its direction, whatever rotation lies between the frame of the sensors and
the platform's. The best rotation for an attitude that goes with the field leaves its noise; for one that does not,
tens of degrees. A quaternion with its components moved round by one place is the inverse between two constant
rotations, so that where nobody knows the field in the world, the inverse and the scalar first go with the field alike.
"""

from __future__ import annotations

import numpy as np

from magtensor.attitude import FAR_BETTER, longest, right_angled, seen_from_world, to_world
from magtensor.calibration.types import Array
from magtensor.errors import DataError
from magtensor.frame.attitude import LEAST_SAMPLES, WORST_MISFIT

ALIKE = 1.5  # times: readings that leave no more than the best by this are named too
MOST_SAMPLES = 20_000  # enough for an angle of some degrees
READINGS = {
    "the inverse (`maps: world to platform`)": (np.array([0, 1, 2, 3]), np.array([-1.0, -1.0, -1.0, 1.0])),
    "one with the scalar first (`scalar: first`)": (np.array([1, 2, 3, 0]), np.ones(4)),
    "the inverse with the scalar first (`maps: world to platform`, `scalar: first`)": (
        np.array([1, 2, 3, 0]),
        np.array([-1.0, -1.0, -1.0, 1.0]),
    ),
}


def require_following(quaternions: Array, b: Array, world: Array | None) -> None:
    """Refuse an attitude that no rotation between sensors and platform brings to go with the field.

    Parameters
    ----------
    quaternions: (N, 4), scalar last, platform to world, finite.
    b: (N, 3), the field in the frame of the sensors, in any unit, finite.
    world: (3,), the field in the world frame; None where it is unknown and constant.

    Raises
    ------
    DataError: more than `WORST_MISFIT` is left; the message names the readings that go far better, if there are any.
    """
    if len(b) < LEAST_SAMPLES:
        return
    some = slice(None, None, -(-len(b) // MOST_SAMPLES))
    q, direction = quaternions[some], b[some] / np.linalg.norm(b[some], axis=1, keepdims=True)
    h = None if world is None else np.asarray(world, dtype=float) / np.linalg.norm(world)
    given = misfit(q, direction, h)
    if given <= WORST_MISFIT:
        return
    others = {words: misfit(q[:, order] * sign, direction, h) for words, (order, sign) in READINGS.items()}
    best = min(others.values())
    if FAR_BETTER * best < given:
        better = " or ".join(words for words, left in others.items() if left < ALIKE * best)
        hint = f"read as {better} it leaves {np.degrees(best):.2g} deg: it must be platform to world, scalar last"
    else:
        hint = (
            "is it of another clock, in another order of components (x, y, z, w), or of another platform? Neither the "
            "inverse nor the scalar first goes with the field"
        )
    raise DataError(
        f"the attitude does not go with the field: the best rotation leaves {np.degrees(given):.2g} deg rms",
        where="attitude",
        hint=hint,
    )


def misfit(quaternions: Array, direction: Array, world: Array | None) -> float:
    """rad rms, what the best rotation of directions (N, 3) leaves; a mirror counts as a rotation, as of an array whose
    axes are all inverted, which is another mistake."""
    mean = seen_from_world(to_world(quaternions), direction)
    if world is not None:
        together = float(np.linalg.svd(np.einsum("i,ija->ja", world, mean), compute_uv=False).sum())
        return float(np.sqrt(max(2.0 - 2.0 * together, 0.0)))
    length = max(longest(mean, start)[0] for start in right_angled())
    return float(np.sqrt(max(1.0 - length**2, 0.0)))
