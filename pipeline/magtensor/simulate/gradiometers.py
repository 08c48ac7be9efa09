"""Elemental gradiometers: five instruments that measure xx, xy, xz, yy, yz each by itself, T = K G + O.

The error model of Sui 2017 (eqs. 3 to 8, Table 1): each has a sense direction and a baseline direction, and measures
sense . G . baseline. Two entries of the print are read as what they must be: the middle elements of M and L are
+ c c + s s s, so that zero angles give the identity; and W3 holds the angles of W2 and W5, which the text calls the
same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from magtensor.simulate.rotations import passive
from magtensor.simulate.sources import traceless_symmetric
from magtensor.simulate.spec import Array, Spec

COMPONENTS = ("xx", "xy", "xz", "yy", "yz")
PREFIX = "gradient_"


class GradiometersSpec(Spec):
    """Five elemental gradiometers at the array's centre; errors uniform within +- these bounds."""

    scale: float = Field(0.01, ge=0, lt=1, description="deviation of each scale factor from 1")
    non_orthogonality_deg: float = Field(1.0, ge=0, le=10, description="each of the six angles, deg")
    misalignment_deg: float = Field(3.0, ge=0, le=180, description="each of the six angles, deg")
    offset_nT_per_m: float = Field(15.0, ge=0, description="zero offset of each, nT/m")
    noise_nT_per_m: float = Field(0.1, ge=0, description="noise of each sample, uniform, nT/m")


@dataclass(frozen=True)
class Gradiometers:
    """As built: T5 = matrix G5 + offset, in the order xx, xy, xz, yy, yz.

    Attributes:
        matrix: K (5, 5); offset: O (5,) nT/m; noise: half width of the uniform noise, nT/m.
    """

    matrix: Array
    offset: Array
    noise: float

    def readings(self, tensor: Array, rng: np.random.Generator) -> dict[str, Array]:
        """Channels (n,) nT/m of true tensors (n, 3, 3) nT/m in the platform frame."""
        true = np.stack([tensor[:, "xyz".index(c[0]), "xyz".index(c[1])] for c in COMPONENTS], axis=1)
        measured = true @ self.matrix.T + self.offset + self.noise * rng.uniform(-1, 1, true.shape)
        return {f"{PREFIX}{c}": measured[:, i] for i, c in enumerate(COMPONENTS)}


def build_gradiometers(spec: GradiometersSpec, rng: np.random.Generator) -> Gradiometers:
    """Draw the errors."""
    baseline_turn, sense_turn = (_turned(np.deg2rad(spec.misalignment_deg) * rng.uniform(-1, 1, 3)) for _ in range(2))
    skew = np.deg2rad(spec.non_orthogonality_deg) * rng.uniform(-1, 1, 6)
    (alpha, beta, delta), (sense_alpha, sense_beta, sense_delta) = skew[:3], skew[3:]
    baseline = np.array([_x_row(alpha, beta, 1), _y_row(delta), [0.0, 0.0, 1.0]]) @ baseline_turn
    # the sensor on a skewed baseline turns with it (W2, W5) before its own error (W1, W4) comes on top
    along_x = _x_row(sense_alpha, sense_beta, 1) @ sense_turn @ _with_row(0, _x_row(alpha, beta, -1)) @ baseline_turn
    along_y = _y_row(sense_delta) @ sense_turn @ _with_row(1, _y_row(delta)) @ baseline_turn
    sense = {"x": along_x, "y": along_y}
    unit = np.array([traceless_symmetric(row.tolist()) for row in np.eye(5)])
    seen = [np.einsum("i,cij,j->c", sense[c[0]], unit, baseline["xyz".index(c[1])]) for c in COMPONENTS]
    scale = 1 + spec.scale * rng.uniform(-1, 1, 5)
    offset = spec.offset_nT_per_m * rng.uniform(-1, 1, 5)
    return Gradiometers(scale[:, None] * np.array(seen), offset, spec.noise_nT_per_m)


def _turned(angles: Array) -> Array:
    """M and L of eq. 4 from alpha, beta, gamma, rad."""
    alpha, beta, gamma = angles
    return passive("x", gamma) @ passive("y", beta) @ passive("z", alpha)


def _x_row(alpha: float, beta: float, sign: int) -> Array:
    """First row of W1 and W3 (sign 1) and of W2 (sign -1): x turned by beta about z and by alpha about y."""
    return np.array([np.cos(beta) * np.cos(alpha), np.sin(beta) * np.cos(alpha), sign * np.sin(alpha)])


def _y_row(delta: float) -> Array:
    """Second row of W3, W4 and W5: y turned by delta about x."""
    return np.array([0.0, np.cos(delta), np.sin(delta)])


def _with_row(index: int, row: Array) -> Array:
    out = np.eye(3)
    out[index] = row
    return out
