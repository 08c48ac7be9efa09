"""What is already known of the platform's frame: the calibration's own tie to it, as one source beside others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.calibration.rotation import to_vector
from magtensor.calibration.types import Array

from .calibration_errors import CalibrationErrors
from .sources import Slope


@dataclass(frozen=True)
class Earlier:
    """The calibration's frame is the platform's but for a rotation of this covariance; a `Source`.

    Attributes:
        information: (3, 3) 1/rad^2.
        errors: of the calibration; their common rotation is what the covariance is of, and so answers for itself.
    """

    information: Array
    errors: CalibrationErrors
    name: str = "stored frame"

    def cost(self, rotation: Array, spread: float) -> float:
        w = to_vector(rotation)
        return 0.5 * float(w @ self.information @ w) / spread

    def slope(self, rotation: Array, spread: float) -> Slope:
        information = self.information / spread
        none = np.zeros((3, self.errors.root.shape[1]))
        return Slope(information @ to_vector(rotation), information, 0 * information, information, none)

    def spread(self, rotation: Array) -> float:
        return 1.0

    def free_because(self, directions: Array) -> str:
        return "the calibration's own frame is no better known"


def earlier(errors: CalibrationErrors) -> Earlier:
    """The tie that the covariance of a calibration in the platform's frame holds."""
    covariance = errors.common @ errors.common.T
    return Earlier(np.asarray(np.linalg.pinv(covariance, rcond=1e-12), dtype=np.float64), errors)
