"""What a calibration is: the correction of each sensor, its covariance, and the frame it leads to."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PARAMETERS_PER_SENSOR = 12  # nine of the matrix, row by row, then three of the offset


@dataclass(frozen=True)
class SensorCalibration:
    """The correction of one sensor, ``b = matrix @ (m - offset)``.

    Attributes:
        matrix: (3, 3), dimensionless; C^-1 of Chi 2017 eq. 6.
        offset: (3,) nT, in raw output; b of Chi 2017 eq. 6.
        covariance: (12, 12) of the nine matrix elements row by row and the three offsets; NaN where the
            method gives none. Singular in the directions that the frame convention fixes.
        frame: what `b` is expressed in: "cholesky" (z along the sensed z axis, Chi), "polar" (nearest to the
            raw axes, Yin), "platform" (tied to something outside the sensor).
        residual_rms: nT, of |b| - F over the samples used.
        diagnostics: further figures a method wants to report (condition number, iterations, ...).
        unobservable: words for what the data leave free, beyond the rotation that no scalar data determine.
    """

    matrix: Array
    offset: Array
    covariance: Array
    frame: str
    residual_rms: float
    diagnostics: dict[str, float | str] = field(default_factory=dict)
    unobservable: tuple[str, ...] = ()

    def apply(self, m: Array) -> Array:
        """Raw output (..., 3) nT to calibrated field (..., 3) nT in `frame`."""
        out: Array = (m - self.offset) @ self.matrix.T
        return out

    def rotated(self, rotation: Array, frame: str) -> SensorCalibration:
        """The same correction seen in another frame, b' = rotation @ b, covariance carried along."""
        jacobian = np.eye(PARAMETERS_PER_SENSOR)
        jacobian[:9, :9] = np.kron(rotation, np.eye(3))
        return SensorCalibration(
            rotation @ self.matrix,
            self.offset,
            jacobian @ self.covariance @ jacobian.T,
            frame,
            self.residual_rms,
            self.diagnostics,
            self.unobservable,
        )


@dataclass(frozen=True)
class ArrayCalibration:
    """The corrections of S sensors that lead to one common frame.

    Attributes:
        matrix: (S, 3, 3); offset: (S, 3) nT; as in SensorCalibration.
        covariance: (12 S, 12 S), sensor after sensor, each as in SensorCalibration.
        frame: "sensor <name>", "platform", or "artificial platform" (Li 2018).
        unobservable: words for each direction that the data leave free (the gauge).
        diagnostics: further figures to report.
    """

    matrix: Array
    offset: Array
    covariance: Array
    frame: str
    unobservable: tuple[str, ...] = ()
    diagnostics: dict[str, float | str] = field(default_factory=dict)

    def apply(self, m: Array) -> Array:
        """Raw output (..., S, 3) nT to calibrated field (..., S, 3) nT in `frame`."""
        out: Array = np.einsum("sij,...sj->...si", self.matrix, m - self.offset)
        return out
