"""Sui 2017's simulation: five elemental gradiometers with errors, rotated about their centre near a dipole.

Eqs. 3-9 and Table 1. Two entries are read as what they must be: with the angles at zero the matrices M and L are
to be the identity, so their middle element is + c c + s s s; and W3 holds the angles of W2 and W5, which its
text calls the same.
"""

from dataclasses import dataclass

import numpy as np
from dipole import dipole_tensor, random_rotations

from magtensor.tensor.elements import FIVE_OF_NINE, NINE_OF_FIVE, five

MOMENT = np.array([250000.0, 250000.0, -353553.39])  # A m^2
NOISE_STD = 0.1 / np.sqrt(3)  # uniform of half width 0.1 nT/m


def turned(alpha, beta, gamma):
    """M and L of eq. 4."""
    ca, cb, cg = np.cos([alpha, beta, gamma])
    sa, sb, sg = np.sin([alpha, beta, gamma])
    return np.array(
        [
            [cb * ca, sa * cb, -sb],
            [sg * sb * ca - cg * sa, sg * sb * sa + cg * ca, sg * cb],
            [cg * sb * ca + sg * sa, cg * sb * sa - sg * ca, cg * cb],
        ]
    )


def first_row(alpha, beta, sign):
    """W1 (sign +) and W2 (sign -): the x axis turned by beta about z and by alpha about y."""
    ca, cb, sa, sb = np.cos(alpha), np.cos(beta), np.sin(alpha), np.sin(beta)
    return np.array([[cb * ca, ca * sb, sign * sa], [0, 1, 0], [0, 0, 1]])


def second_row(delta):
    """W4 and W5: the y axis turned by delta about x."""
    return np.array([[1, 0, 0], [0, np.cos(delta), np.sin(delta)], [0, 0, 1]])


@dataclass(frozen=True)
class Gradiometer:
    """T = K G + O of eq. 8, with K (5, 5) in the order xx, xy, xz, yy, yz."""

    K: np.ndarray
    O: np.ndarray  # noqa: E741  the paper's name

    def measure(self, g, rng, noise=NOISE_STD):
        """(N, 5) of the true components (N, 5), with uniform noise."""
        half_width = noise * np.sqrt(3)
        return g @ self.K.T + self.O + rng.uniform(-half_width, half_width, g.shape)


def random_gradiometer(rng):
    """Errors uniform with the half widths of Table 1."""
    misaligned = np.radians(3.0) * rng.uniform(-1, 1, (2, 3))
    a3, b3, d3, a4, b4, d4 = np.radians(1.0) * rng.uniform(-1, 1, 6)
    m, sense = turned(*misaligned[0]), turned(*misaligned[1])
    baseline = m.T @ (first_row(a3, b3, +1) * [[1], [0], [0]] + second_row(d3) * [[0], [1], [1]]).T
    along_x = first_row(a4, b4, +1) @ sense @ first_row(a3, b3, -1) @ m
    along_y = second_row(d4) @ sense @ second_row(d3) @ m
    rows = [
        np.kron(sensing, baseline[:, column])
        for sensing, column in ((along_x[0], 0), (along_x[0], 1), (along_x[0], 2), (along_y[1], 1), (along_y[1], 2))
    ]
    scale = 1 + 0.01 * rng.uniform(-1, 1, 5)
    return Gradiometer(scale[:, None] * (np.array(rows) @ NINE_OF_FIVE), 15.0 * rng.uniform(-1, 1, 5))


def dipole_components(height, direction=(0.0, 0.0, 1.0)):
    """(5,) nT/m of the paper's dipole at `height` m; straight above it the moment is at 45 degrees."""
    return five(dipole_tensor(height * np.asarray(direction), MOMENT))


def rotated_components(g, rng, count, axis=None):
    """(count, 5): the components seen by an array turned at random about its centre, or about one axis."""
    from scipy.spatial.transform import Rotation

    if axis is None:
        turns = random_rotations(rng, count)
    else:
        angles = rng.uniform(0, 2 * np.pi, count)
        turns = Rotation.from_rotvec(angles[:, None] * np.asarray(axis) / np.linalg.norm(axis)).as_matrix()
    nine = np.einsum("nik,njl->nijkl", turns, turns).reshape(count, 9, 9)
    return nine @ NINE_OF_FIVE @ g @ FIVE_OF_NINE.T
