"""The common rotation from a sensor, or one axis of it, that points along the platform's axes by construction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.calibration.rotation import nearest_orthogonal
from magtensor.calibration.types import Array, ArrayCalibration

from .calibration_errors import CalibrationErrors
from .sources import TURNS, Slope

AXES = "xyz"


@dataclass(frozen=True)
class Mounting:
    """Directions that a sensor's axes have in the common frame, and those they must have; a `Source`.

    Attributes:
        directions: (A, 3) unit vectors in the common frame; targets: (A, 3) in the platform.
        tolerance: rad, standard deviation of the declaration about any axis.
        response: (R, 3) rad, rotation of the directions (common frame) per unit of each error of the calibration.
        name: "sensor S1" or "axis z of S1".
    """

    directions: Array
    targets: Array
    tolerance: float
    response: Array
    name: str

    def cost(self, rotation: Array, spread: float) -> float:
        misses = 0.5 * float(np.sum((self.directions @ rotation.T - self.targets) ** 2))
        return misses * self._weight / spread

    def slope(self, rotation: Array, spread: float) -> Slope:
        turned = self.directions @ rotation.T
        weight = self._weight / spread
        gradient = -np.einsum("ai,kij,aj->k", self.targets, TURNS, turned) * weight
        product = self.targets.T @ turned
        information = (np.trace(product) * np.eye(3) - 0.5 * (product + product.T)) * weight
        step = len(turned) * np.eye(3) * weight
        response = information @ rotation @ self.response.T
        return Slope(gradient, information, information, step, response)

    def spread(self, rotation: Array) -> float:
        return 1.0

    def free_because(self, directions: Array) -> str:
        if len(self.directions) == 3:
            return f"{self.name} is declared to {np.degrees(self.tolerance):.3g} deg only; measure its mounting better"
        return f"{self.name} leaves the rotation about that axis open; declare the whole sensor, or add a source"

    @property
    def _weight(self) -> float:
        """Per squared length: three orthogonal axes miss by twice the squared angle, one by the squared angle."""
        return 1.0 / self.tolerance**2 / (2.0 if len(self.directions) == 3 else 1.0)


def mounting(
    calibration: ArrayCalibration, errors: CalibrationErrors, sensor: int, axis: str | None, tolerance: float, name: str
) -> Mounting:
    """A declared sensor, or its axis.

    All three axes: the sensor's orthogonal part (the rotation nearest to its response) is the platform's, so that its
    own non-orthogonality and soft iron turn nothing. One axis: the direction that this output senses is the platform
    axis of the same name; the rotation about it stays free.

    Parameters
    ----------
    sensor: number from 0; axis: "x", "y", "z", or None for the whole sensor.
    tolerance: rad, how well it is mounted.
    name: to report it by.
    """
    matrix = calibration.matrix[sensor]

    def sensed(correction: Array) -> Array:
        forward: Array = np.asarray(np.linalg.inv(correction), dtype=np.float64)
        if axis is None:
            return nearest_orthogonal(forward, 1)
        row = forward[AXES.index(axis)]
        return np.asarray(row / np.linalg.norm(row))[None]

    directions = sensed(matrix)
    targets = np.eye(3) if axis is None else np.eye(3)[[AXES.index(axis)]]
    own = errors.root[12 * sensor : 12 * sensor + 9].T.reshape(-1, 3, 3)
    turns = []
    for error in own:
        step = 1e-4 / max(float(np.abs(error).max()), 1e-300)
        change = (sensed(matrix + step * error) - sensed(matrix - step * error)) / (2 * step)
        turn = np.cross(directions, change).sum(axis=0)
        turns.append(turn / 2 if axis is None else turn)
    response = np.array(turns).reshape(-1, 3)
    return Mounting(directions, targets, tolerance, response, name)
