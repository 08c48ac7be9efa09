"""Which further postures would help a scalar calibration most.

Nine parameters are linear in the length of the field: a sample in direction u adds a a' to their information, with
a = (u_x^2, u_y^2, u_z^2, 2 u_y u_z, 2 u_x u_z, 2 u_x u_y, u_x, u_y, u_z). The direction that adds most to its
determinant is the one in which the length is predicted worst (Kiefer and Wolfowitz 1960: D- and G-optimal designs are
the same), so postures are chosen one after the other where the prediction is worst. Samples spread evenly over the
sphere are such a design; with n of them the variance of the length is 9 / n of that of one sample in every direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .types import Array

ENOUGH = 2.0  # of the standard deviation that evenly spread samples would give: no further posture is named
MOST = 4


@dataclass(frozen=True)
class Further:
    """Postures that would help most, in order.

    Attributes:
        directions: (K, 3) of the field, in the axes of the samples; none where the attitudes are spread well.
        before, after: standard deviation of the length in the worst direction of the sphere, without them and with
            them, as a multiple of what as many samples spread evenly would give; infinite where nothing is known.
    """

    directions: Array
    before: float
    after: float

    def __str__(self) -> str:
        named = ", ".join(f"({x:+.2f}, {y:+.2f}, {z:+.2f})" for x, y, z in self.directions)
        if not named:
            return ""
        gain = f", {self.before / self.after:.2g} times better in the worst direction" if self.before < 1e6 else ""
        return f"the field along {named}{gain}"


def attitude_design(unit: Array) -> Array:
    """Derivatives (N, 9) of |b|/F with respect to a symmetric change of the matrix and a shift, for directions."""
    x, y, z = unit.T
    return np.column_stack([x * x, y * y, z * z, 2 * y * z, 2 * x * z, 2 * x * y, x, y, z])


def sphere(count: int = 2000) -> Array:
    """Directions (count, 3) spread evenly over the sphere (golden spiral): gaps below 5 deg."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    turn = np.pi * (1 + np.sqrt(5.0)) * k
    r = np.sqrt(1 - z**2)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


def further_postures(information: Array, samples: float, each: float = 1.0) -> Further:
    """Choose postures for samples whose information (9, 9) is the sum of a a'.

    Parameters
    ----------
    samples: how many there are; each: how many a further posture would add.
    """
    grid = sphere()
    design = attitude_design(grid)
    # what nothing is known of is known a millionth as well as the rest: the sums stay finite and its directions first
    total = information + 1e-12 * np.trace(information) * np.eye(9)
    count = samples
    chosen: list[Array] = []
    before = worst = _worst(total, design, count)
    while worst[1] > ENOUGH and len(chosen) < MOST:
        a = design[worst[0]]
        chosen.append(grid[worst[0]])
        total, count = total + each * np.outer(a, a), count + each
        worst = _worst(total, design, count)
    return Further(np.array(chosen).reshape(-1, 3), before[1], worst[1])


def _worst(information: Array, design: Array, samples: float) -> tuple[int, float]:
    """The direction of the grid where the length is known worst, and how badly."""
    variance = np.sum(design * np.linalg.solve(information, design.T).T, axis=1)
    k = int(np.argmax(variance))
    return k, float(np.sqrt(samples * variance[k] / 9.0))
