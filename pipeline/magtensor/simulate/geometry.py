"""Where the sensors sit in the platform frame."""

from __future__ import annotations

from itertools import product
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from magtensor.simulate.spec import Array, Spec, Vector3

Shape = Literal["cross", "square", "triangle", "tetrahedron", "hexahedron", "cube"]


class ArraySpec(Spec):
    """A named shape with its baseline, or the position of each sensor."""

    shape: Shape | None = Field(
        None,
        description=(
            "cross: sensors 1 to 4 on +x, +y, -x, -y (Chi 2017); square, triangle: in the xy plane; "
            "tetrahedron; hexahedron: six, on the axes; cube: eight corners"
        ),
    )
    baseline_m: float | None = Field(
        None,
        gt=0,
        description=("distance of two opposite sensors (cross, hexahedron) or of two neighbours (other shapes), m"),
    )
    positions_m: list[Vector3] | None = Field(
        None, min_length=1, description="position of each sensor in the platform frame, m; instead of a shape"
    )
    names: list[str] | None = Field(None, description="names of the sensors; S1, S2, ... where null")

    @model_validator(mode="after")
    def _one_way(self) -> ArraySpec:
        if (self.shape is None) == (self.positions_m is None):
            raise ValueError("give either shape (with baseline_m) or positions_m")
        if (self.shape is None) != (self.baseline_m is None):
            raise ValueError("baseline_m belongs to a shape")
        count = len(positions(self))
        if self.names is not None and (len(self.names) != count or len(set(self.names)) != count):
            raise ValueError(f"names needs {count} different names")
        return self


def positions(spec: ArraySpec) -> Array:
    """(S, 3) m. The named shapes have their centroid at the origin."""
    if spec.positions_m is not None:
        return np.array(spec.positions_m, dtype=float)
    d = float(spec.baseline_m or 0.0)
    if spec.shape == "cross":
        return d / 2 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=float)
    if spec.shape == "square":
        return d / 2 * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], dtype=float)
    if spec.shape == "triangle":
        angle = np.pi / 2 + 2 * np.pi / 3 * np.arange(3)
        return d / np.sqrt(3) * np.stack([np.cos(angle), np.sin(angle), np.zeros(3)], axis=-1)
    if spec.shape == "tetrahedron":
        corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
        return d / np.sqrt(8) * corners
    if spec.shape == "hexahedron":
        return d / 2 * np.concatenate([np.eye(3), -np.eye(3)])
    return d / 2 * np.array(list(product([-1.0, 1.0], repeat=3)))


def names(spec: ArraySpec) -> list[str]:
    """The sensors' names, S1, S2, ... by default."""
    return spec.names or [f"S{i + 1}" for i in range(len(positions(spec)))]
