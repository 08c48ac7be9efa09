"""An attitude on another clock than the sensors: seen from the world, the field's direction then swings as the platform
turns.

No length and no difference between sensors shows it; all sensors may be late, or the attitude early.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array
from magtensor.golden import golden
from magtensor.misread import misfit

MOST_SAMPLES = 5000
LONGEST_STEPS = 64.0  # steps between samples: a longer delay is another mistake
MOST_LEFT = 0.5  # of the square of the misfit: with more, the delay is not what most of it is
ROUNDS = 24  # of the search between two neighbours of the grid


@dataclass(frozen=True)
class Delay:
    """By how much an attitude is late.

    Attributes:
        delay_s: above 0 the attitude is late, below 0 the sensors are.
        before, after: rad rms, what the best rotation leaves of the field's direction, as recorded and without it.
    """

    delay_s: float
    before: float
    after: float

    @property
    def words(self) -> str:
        """For the verdict."""
        late = "late" if self.delay_s > 0 else "early"
        return (
            f"the attitude is {abs(self.delay_s):.3g} s {late} against the sensors: without that the field keeps its "
            f"direction to {np.degrees(self.after):.2g} deg, as recorded to {np.degrees(self.before):.2g} deg"
        )


def attitude_delay(time: Array, quaternions: Array, b: Array, world: Array | None) -> Delay | None:
    """The delay that explains most of what the best rotation leaves; None where none does.

    Parameters
    ----------
    time: (N,) s. quaternions: (N, 4), platform to world, finite. b: (N, 3), calibrated, in one frame, finite.
    world: (3,) the field in the world frame, in any unit; None where it is unknown and constant.
    """
    if len(time) < 3:
        return None
    signs = np.cumprod(np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0, -1.0, 1.0))
    course = quaternions * np.concatenate([[1.0], signs])[:, None]
    step = float(np.median(np.diff(time)))
    reach = LONGEST_STEPS * step
    inside = np.flatnonzero((time >= time[0] + reach) & (time <= time[-1] - reach))
    some = inside[:: -(-max(len(inside), 1) // MOST_SAMPLES)]
    if len(some) < 10:
        return None
    toward = None if world is None else world / np.linalg.norm(world)
    direction = b[some] / np.linalg.norm(b[some], axis=1, keepdims=True)

    def left(delay: float) -> float:
        at = np.column_stack([np.interp(time[some] + delay, time, column) for column in course.T])
        return misfit(at / np.linalg.norm(at, axis=1, keepdims=True), direction, toward)

    steps = step * 2.0 ** np.arange(-2.0, np.log2(LONGEST_STEPS))
    grid = np.concatenate([-steps[::-1], [0.0], steps])
    found = [left(delay) for delay in grid]
    best = int(np.argmin(found))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    delay = golden(lambda delay: -left(delay), low, high, float(grid[best]), ROUNDS)
    before, after = left(0.0), left(delay)
    return Delay(delay, before, after) if after**2 < MOST_LEFT * before**2 else None
