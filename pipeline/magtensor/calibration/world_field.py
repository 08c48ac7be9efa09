"""The direction of a constant world field, from sensors whose attitude is known.

m = C R' B + o is linear in C and o for a given B, and in B for given C and o. With the attitude R known in more than
one tilt, only the product of the size of C and that of B stays open: |B| is given, the direction is not needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from magtensor.errors import NotEnoughData

from .types import Array

BLOCKS = 10
LEAST_PER_BLOCK = 5
WORST_DIRECTION = 0.05  # rad, accepted standard deviation of the direction
_STARTS = 60
_STEP = 3e-3  # rad: smaller ones drown in rounding


@dataclass(frozen=True)
class WorldField:
    """A unit vector (3,) in the world frame, and the standard deviation of its direction in its worst sense, rad."""

    direction: Array
    std: float


def world_direction(raw: Array, to_platform: Array, total_field: Array) -> WorldField:
    """The direction of the field in the world.

    Parameters
    ----------
    raw: (N, S, 3) nT, finite.
    to_platform: (N, 3, 3), world vectors to the platform frame.
    total_field: (N,) nT.

    Raises
    ------
    NotEnoughData: the attitudes do not tell the direction from an offset, as when the platform only turned about the
        vertical.
    """
    from scipy.optimize import minimize

    if len(raw) < BLOCKS * LEAST_PER_BLOCK:
        raise NotEnoughData(f"{len(raw)} samples cannot tell the direction of the world field")
    unit = float(np.mean(total_field))
    # columns: the field in the platform, were B along x, y or z of the world; and a constant
    columns = [to_platform[:, :, k] * (total_field / unit)[:, None] for k in range(3)]
    z = np.column_stack([*columns, np.ones(len(raw))])
    y = raw.reshape(len(raw), -1) / unit
    edges = np.linspace(0, len(raw), BLOCKS + 1).round().astype(int)
    parts = [_Moments.of(z[a:b], y[a:b]) for a, b in pairwise(edges)]
    whole = _Moments.sum(parts)

    def nearest(moments: _Moments, start: Array) -> Array:
        frame = _tangent(start)
        found = minimize(lambda p: moments.misfit(_moved(start, frame, p)), np.zeros(2), method="Nelder-Mead",
                         options={"xatol": 1e-7, "fatol": 1e-12 * moments.misfit(start)})  # fmt: skip
        return _moved(start, frame, found.x)

    sphere = _directions(_STARTS)
    start = sphere[int(np.argmin([whole.misfit(d) for d in sphere]))]
    best = nearest(whole, start)
    if whole.handedness(best) < 0:  # B and -B fit alike; a sensor is not a mirror
        best = -best
    frame = _tangent(best)
    curvature = _curvature(whole, best, frame)
    flat = bool(np.linalg.eigvalsh(curvature)[0] <= 1e-9 * whole.yy)
    scatter = 2.0 * whole.misfit(best) / whole.freedom * np.linalg.pinv(curvature, rcond=1e-9)
    others = np.stack([nearest(_Moments.sum(parts[:k] + parts[k + 1 :]), best) @ frame for k in range(BLOCKS)])
    jackknife = (BLOCKS - 1) / BLOCKS * (others - others.mean(axis=0)).T @ (others - others.mean(axis=0))
    std = float("inf") if flat else float(np.sqrt(max(np.linalg.eigvalsh(m)[-1] for m in (scatter, jackknife))))
    if std > WORST_DIRECTION:
        raise NotEnoughData(
            "the attitudes do not tell the direction of the world field from an offset of the sensor: "
            + ("nothing depends on it" if flat else f"its standard deviation is {np.degrees(std):.3g} deg"),
            hint="tilt the platform as well as turning it, or give the world field in the recipe",
        )
    return WorldField(best, std)


@dataclass(frozen=True)
class _Moments:
    """Second moments of the columns (10) and the outputs (3 S)."""

    zz: Array
    zy: Array
    yy: float
    freedom: int

    @classmethod
    def of(cls, z: Array, y: Array) -> _Moments:
        return cls(z.T @ z, z.T @ y, float(np.sum(y**2)), y.size)

    @classmethod
    def sum(cls, parts: list[_Moments]) -> _Moments:
        zz: Array = np.sum([p.zz for p in parts], axis=0)
        zy: Array = np.sum([p.zy for p in parts], axis=0)
        return cls(zz, zy, sum(p.yy for p in parts), sum(p.freedom for p in parts))

    def _solved(self, direction: Array) -> tuple[Array, Array]:
        pick = np.zeros((10, 4))
        for k in range(3):
            pick[3 * k : 3 * k + 3, :3] = direction[k] * np.eye(3)
        pick[9, 3] = 1.0
        right = pick.T @ self.zy
        solution: Array = np.asarray(np.linalg.lstsq(pick.T @ self.zz @ pick, right, rcond=1e-12)[0], dtype=np.float64)
        return solution, right

    def misfit(self, direction: Array) -> float:
        """Sum of squares that the best C and o leave."""
        solution, right = self._solved(direction)
        return self.yy - float(np.sum(solution * right))

    def handedness(self, direction: Array) -> float:
        c = self._solved(direction)[0][:3].T.reshape(-1, 3, 3)
        return float(np.linalg.det(c).sum())


def _directions(count: int) -> Array:
    k = np.arange(count) + 0.5
    height = 1 - k / count  # half a sphere: B and -B are alike
    turn = np.pi * (1 + np.sqrt(5.0)) * k
    r = np.sqrt(1 - height**2)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), height])


def _tangent(direction: Array) -> Array:
    """(3, 2) orthonormal, perpendicular to a unit vector."""
    return np.asarray(np.linalg.svd(direction[None, :])[2][1:].T, dtype=np.float64)


def _moved(direction: Array, frame: Array, by: Array) -> Array:
    out = direction + frame @ by
    moved: Array = out / np.linalg.norm(out)
    return moved


def _curvature(moments: _Moments, at: Array, frame: Array) -> Array:
    """(2, 2) second derivatives of the misfit with the direction, by differences."""
    steps = _STEP * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1], [1, 0], [-1, 0], [0, 1], [0, -1], [0, 0]])
    f = [moments.misfit(_moved(at, frame, s)) for s in steps]
    xx, yy = f[4] + f[5] - 2 * f[8], f[6] + f[7] - 2 * f[8]
    xy = (f[0] - f[1] - f[2] + f[3]) / 4
    return np.array([[xx, xy], [xy, yy]]) / _STEP**2
