"""Magnetic sources in the world: dipoles at rest or passing by, and a uniform gradient.

World frame: x east, y north, z up. Field in nT, moments in A m^2, gradients in nT/m.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from pydantic import Field

from magtensor.simulate.spec import Array, Spec, Vector3

MU0_OVER_4PI = 100.0  # nT m^3 / (A m^2)


class DipoleSpec(Spec):
    """A magnetic dipole at rest."""

    position_m: Vector3 = Field(description="east, north, up, m")
    moment_Am2: Vector3 = Field(description="east, north, up, A m^2")


class Source(Protocol):
    """A real field beside the Earth's. Times (n,) s, points (n, S, 3) m or (n, 3) m."""

    def field(self, t: Array, x: Array) -> Array:
        """(n, S, 3) nT at points (n, S, 3)."""

    def gradient(self, t: Array, x: Array) -> Array:
        """(n, 3, 3) nT/m at points (n, 3); [i, j] = dB_i / dx_j."""

    def scaled(self, factor: float) -> Source:
        """The same source, stronger by a factor."""


def dipole_field(moment: Array, r: Array) -> Array:
    """Field (..., 3) nT at r (..., 3) m from a dipole of moment (..., 3) A m^2."""
    r2 = r[..., 0] ** 2 + r[..., 1] ** 2 + r[..., 2] ** 2
    along = moment[..., 0] * r[..., 0] + moment[..., 1] * r[..., 1] + moment[..., 2] * r[..., 2]
    out: Array = MU0_OVER_4PI * (3 * (along / r2)[..., None] * r - moment) / (r2 * np.sqrt(r2))[..., None]
    return out


def dipole_gradient(moment: Array, r: Array) -> Array:
    """Gradient (..., 3, 3) nT/m of `dipole_field`: symmetric and traceless."""
    r2 = (r**2).sum(axis=-1)[..., None, None]
    along = (moment * r).sum(axis=-1)[..., None, None]
    outer = moment[..., :, None] * r[..., None, :]
    rr = r[..., :, None] * r[..., None, :]
    symmetric = outer + np.swapaxes(outer, -1, -2)
    out: Array = 3 * MU0_OVER_4PI * (symmetric + along * np.eye(3) - 5 * along / r2 * rr) / r2**2.5
    return out


class Dipole:
    """A dipole at rest, or moving steadily through `position` at `time_s`."""

    def __init__(self, position: Array, moment: Array, velocity: Array | None = None, time_s: float = 0.0) -> None:
        self.position, self.moment, self.time_s = (
            np.asarray(position, float),
            np.asarray(moment, float),
            time_s,
        )
        self.velocity = np.zeros(3) if velocity is None else np.asarray(velocity, float)

    def _place(self, t: Array) -> Array:
        out: Array = self.position + (t - self.time_s)[:, None] * self.velocity
        return out

    def field(self, t: Array, x: Array) -> Array:
        return dipole_field(self.moment, x - self._place(t)[:, None])

    def gradient(self, t: Array, x: Array) -> Array:
        return dipole_gradient(self.moment, x - self._place(t))

    def scaled(self, factor: float) -> Dipole:
        return Dipole(self.position, factor * self.moment, self.velocity, self.time_s)


class UniformGradient:
    """B = G x, with G (3, 3) nT/m symmetric and traceless."""

    def __init__(self, gradient: Array) -> None:
        self.tensor = np.asarray(gradient, float)

    def field(self, t: Array, x: Array) -> Array:
        return np.stack([(self.tensor[i] * x).sum(axis=-1) for i in range(3)], axis=-1)

    def gradient(self, t: Array, x: Array) -> Array:
        return np.broadcast_to(self.tensor, (len(t), 3, 3))

    def scaled(self, factor: float) -> UniformGradient:
        return UniformGradient(factor * self.tensor)


def traceless_symmetric(five: list[float]) -> Array:
    """(3, 3) from xx, xy, xz, yy, yz."""
    xx, xy, xz, yy, yz = five
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, -xx - yy]])
