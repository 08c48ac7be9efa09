"""An attitude on another clock than the sensors: seen from the world, the field's direction then swings as the platform
turns.

No length and no difference between sensors shows it; all sensors may be late, or the attitude early.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.golden import golden
from magtensor.misread import misfit

MOST_SAMPLES = 5000
LONGEST_STEPS = 64.0  # steps between samples: a longer delay is another mistake
LONGEST = 0.1  # of the samples, that are left out at either end
MOST_LEFT = 0.5  # of the square of the misfit: with more, the delay is not what most of it is
PARTS = 4  # of the survey; the delay of the others has to serve in each, by the sum over them
ROUNDS = 24  # of the search between two neighbours of the grid
FEWER_ROUNDS = 10  # to a hundredth of what is between these


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
    longest = max(min(LONGEST_STEPS, LONGEST * len(time)), 1.0)
    reach = longest * step
    inside = np.flatnonzero((time >= time[0] + reach) & (time <= time[-1] - reach))
    some = inside[:: -(-max(len(inside), 1) // MOST_SAMPLES)]
    if len(some) < 10 * PARTS:
        return None
    toward = None if world is None else world / np.linalg.norm(world)
    direction = b / np.linalg.norm(b, axis=1, keepdims=True)
    steps = step * 2.0 ** np.arange(-2.0, np.log2(longest) + 1e-9)
    grid = np.concatenate([-steps[::-1], [0.0], steps])

    def left(delay: float, samples: NDArray[np.int_]) -> float:
        at = np.column_stack([np.interp(time[samples] + delay, time, column) for column in course.T])
        return misfit(at / np.linalg.norm(at, axis=1, keepdims=True), direction[samples], toward)

    best = int(np.argmin([left(delay, some) for delay in grid]))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]

    def likeliest(samples: NDArray[np.int_], rounds: int) -> float:
        return float(golden(lambda delay: -left(delay, samples), low, high, float(grid[best]), rounds))

    delay = likeliest(some, ROUNDS)
    before, after = left(0.0, some), left(delay, some)
    if after**2 >= MOST_LEFT * before**2:
        return None
    held_out = np.zeros(2)  # few samples of one motion: errors of the calibration may go with how the platform turns
    for part in np.array_split(some, PARTS):
        elsewhere = likeliest(np.setdiff1d(some, part), FEWER_ROUNDS)
        held_out += len(part) * np.array([left(0.0, part), left(elsewhere, part)]) ** 2
    return Delay(delay, before, after) if held_out[1] < MOST_LEFT * held_out[0] else None
