"""Pang 2013: alignment of an array to one of its sensors by three misalignment angles each."""

from __future__ import annotations

from collections.abc import Sequence

from magtensor import method
from magtensor.calibration.types import Array, ArrayCalibration, SensorCalibration


@method("align", source="Pang et al. 2013 after Li et al. 2018, sections 3.2.1 and 5")
def pang2013(b: Array, calibrations: Sequence[SensorCalibration], reference: int) -> ArrayCalibration:
    """Nonlinear least squares over three misalignment angles, from a start at zero.

    Minimises what Procrustes minimises and ends at the same rotation where the misalignment is moderate.

    Parameters
    ----------
    b: (N, S, 3) nT, scalar-calibrated; calibrations: (S,); reference: index of the sensor.

    Raises
    ------
    DataError: a mirrored sensor, with the axis; or no convergence.
    """
    from magtensor.calibration import alignment

    return alignment.align(b, calibrations, reference, alignment.three_angles)
