"""The scale that all sensors share, where no total field was measured: only a convention can name it.

|b| of unknown constant size leaves b -> a b free. Either the size is declared, as a model's value is, and a is then as
wrong as that; or the mean sensitivity is taken as nominal: the determinants of the corrections have the geometric mean
one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .types import Array, ArrayCalibration

COMMON_SCALE = "one scale that all sensors share"  # how the words begin that name the scale as unobservable
UNMEASURED = "no total field was measured"
ASIDE = "the measured total field was put aside, as asked"  # by somebody who distrusts the reference
UNKNOWN = f"{COMMON_SCALE}: the mean sensitivity was taken as nominal"
DECLARED = f"{COMMON_SCALE}: the total field was declared"


@dataclass(frozen=True)
class Nominal:
    """What makes the mean sensitivity of corrections (S, 3, 3) nominal.

    Attributes:
        factor: of all corrections, and of the field.
        slope: (9 S,), of its logarithm with their elements, sensor after sensor, row by row.
        jacobian: (9 S, 9 S), of the corrections made nominal with the elements before.
    """

    factor: float
    slope: Array
    jacobian: Array


def nominal(matrix: Array) -> Nominal:
    """The common factor that gives the determinants of corrections (S, 3, 3) the geometric mean one.

    Raises
    ------
    numpy.linalg.LinAlgError: a correction is singular.
    """
    sensors = len(matrix)
    factor = float(np.exp(-np.mean(np.log(np.abs(np.linalg.det(matrix)))) / 3.0))
    # d log factor = -sum_s tr(M_s^-1 dM_s) / 3 S
    inverse = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    slope: Array = -inverse.transpose(0, 2, 1).ravel() / (3.0 * sensors)
    return Nominal(factor, slope, factor * (np.eye(9 * sensors) + np.outer(matrix.ravel(), slope)))


def nominal_scale(calibration: ArrayCalibration) -> tuple[ArrayCalibration, float, float]:
    """The same calibration with nominal mean sensitivity; its covariance no longer holds an error of the scale.

    Returns
    -------
    The calibration, the factor that its fields were multiplied by, and that factor's standard deviation.
    """
    sensors = len(calibration.matrix)
    found = nominal(calibration.matrix)
    at = np.concatenate([12 * s + np.arange(9) for s in range(sensors)])
    jacobian = np.eye(12 * sensors)
    jacobian[np.ix_(at, at)] = found.jacobian
    covariance: Array = jacobian @ calibration.covariance @ jacobian.T
    variance = float(found.slope @ calibration.covariance[np.ix_(at, at)] @ found.slope)
    scaled = replace(
        calibration,
        matrix=calibration.matrix * found.factor,
        covariance=covariance,
        unobservable=(*calibration.unobservable, UNKNOWN),
    )
    return scaled, found.factor, found.factor * float(np.sqrt(max(variance, 0.0)))
