"""Which further postures would help a scalar calibration most.

Nine parameters are linear in the length of the field: a sample in direction u adds a a' to their information, with
a = (u_x^2, u_y^2, u_z^2, 2 u_y u_z, 2 u_x u_z, 2 u_x u_y, u_x, u_y, u_z). The direction that adds most to its
determinant is the one in which the length is predicted worst (Kiefer and Wolfowitz 1960: D- and G-optimal designs are
the same), so postures are chosen one after the other where the prediction is worst. Samples spread evenly over the
sphere are such a design; with n of them the variance of the length is 9 / n of that of one sample in every direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from .types import Array

ENOUGH = 2.0  # of the standard deviation that evenly spread samples would give: no further posture is chosen
MOST = 12  # nine determine the parameters, whatever is known before
NAMED = 4  # in a sentence
UNKNOWN = 1e4  # times what even samples give: noise alone says no less


@dataclass(frozen=True)
class Further:
    """Postures that would help most, in order, the first alone most of all.

    Attributes:
        directions: (K, 3) of the field, in the axes of the samples; none where the attitudes are spread well.
        worst: (K + 1,) standard deviation of the length in the worst direction of the sphere, without them and after
            each, as a multiple of what as many samples spread evenly would give; above `UNKNOWN` nothing is known.
        samples: how many there were; each: how many every posture adds.
    """

    directions: Array
    worst: Array
    samples: float
    each: float

    @property
    def error(self) -> Array:
        """(K + 1,) the same as a multiple of the noise of one sample; infinite where nothing is known."""
        count = self.samples + self.each * np.arange(len(self.worst))
        return np.where(self.worst < UNKNOWN, self.worst * 3.0 / np.sqrt(count), np.inf)

    def __str__(self) -> str:
        named = ", ".join(f"({x:+.2f}, {y:+.2f}, {z:+.2f})" for x, y, z in self.directions[:NAMED])
        if not named:
            return ""
        before, after = self.worst[0], self.worst[min(NAMED, len(self.directions))]
        gain = f", {before / after:.2g} times better in the worst direction" if before < UNKNOWN else ""
        return f"the field along {named}{gain}"


def attitude_design(unit: Array) -> Array:
    """Derivatives (N, 9) of |b|/F with respect to a symmetric change of the matrix and a shift, for directions."""
    x, y, z = unit.T
    return np.column_stack([x * x, y * y, z * z, 2 * y * z, 2 * x * z, 2 * x * y, x, y, z])


@cache
def sphere(count: int = 2000) -> Array:
    """Directions (count, 3) spread evenly over the sphere (golden spiral): gaps below 5 deg. Not to be written to."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    turn = np.pi * (1 + np.sqrt(5.0)) * k
    r = np.sqrt(1 - z**2)
    directions = np.column_stack([r * np.cos(turn), r * np.sin(turn), z])
    directions.flags.writeable = False
    return directions


def further_postures(information: Array, samples: float, each: float = 1.0) -> Further:
    """Choose postures for samples whose information (9, 9) is the sum of a a'.

    Parameters
    ----------
    samples: how many there are; each: how many a further posture would add.
    """
    return further_together(information[None], np.eye(3)[None], [samples], [each])[0]


def further_together(
    information: Array, turn: Array, samples: Sequence[float], each: Sequence[float]
) -> tuple[Further, ...]:
    """Choose postures for several sensors of one array, at each step for the one that knows its worst direction least.

    Parameters
    ----------
    information: (S, 9, 9), as for `further_postures`; samples, each: of every sensor.
    turn: (S, 3, 3) from common axes to those of each sensor.

    Returns
    -------
    The same postures for every sensor, each in its own axes.
    """
    grid = sphere()
    design = attitude_design(grid)
    # what nothing is known of is known a millionth as well as the rest: the sums stay finite and its directions first
    total = np.array([own + 1e-12 * np.trace(own) * np.eye(9) for own in information])
    count, more = np.array(samples, dtype=float), np.array(each, dtype=float)
    chosen: list[Array] = []
    found = [_worst(own, design, n) for own, n in zip(total, count, strict=True)]
    worst = [[size for _, size in found]]
    while max(worst[-1]) > ENOUGH and len(chosen) < MOST:
        s = int(np.argmax(worst[-1]))
        chosen.append(grid[found[s][0]] @ turn[s])
        a = attitude_design(turn @ chosen[-1])
        total, count = total + more[:, None, None] * (a[:, :, None] * a[:, None, :]), count + more
        found = [_worst(own, design, n) for own, n in zip(total, count, strict=True)]
        worst.append([size for _, size in found])
    directions = np.array(chosen).reshape(-1, 3)
    return tuple(
        Further(directions @ to.T, np.array(sizes), float(n), float(m))
        for to, sizes, n, m in zip(turn, zip(*worst, strict=True), samples, each, strict=True)
    )


def _worst(information: Array, design: Array, samples: float) -> tuple[int, float]:
    """The direction of the grid where the length is known worst, and how badly."""
    variance = np.sum(design * np.linalg.solve(information, design.T).T, axis=1)
    k = int(np.argmax(variance))
    return k, float(np.sqrt(samples * variance[k] / 9.0))
