"""A calibration in the parameters of Chi 2017 and of Li 2018, with standard deviations.

Both papers write the sensor's response C, m = C b + o, as scale factors times a non-orthogonality matrix with
unit rows, times a rotation from the common frame into the sensor's. The triangular part is unique, so any C with
a positive determinant has these parameters: nine of the triangle and the offset, three of the rotation.

Chi (eqs. 3-5): C = S C_NO R1(gamma) R2(beta) R3(alpha). With soft iron the triangle found by a calibration is the
whole S C_NO (I + K) up to a rotation, and the parameters are those of that triangle, not of S and C_NO alone.

Li (eq. 3): C = C A A_alpha A_beta A_gamma. The names of two angles are swapped against Chi: Li's theta lies in the
plane xy, his phi out of it. By Li's eqs. 5-6 the rotation would be the inverse product and its angles have the
opposite sign; his simulation and his Table 3 have the sign used here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.errors import DataError

from .factors import rotation_and_upper
from .rotation import CHI_SEQUENCE, LI_SEQUENCE, sequence, sequence_angles, sequence_derivatives
from .types import PARAMETERS_PER_SENSOR, Array, ArrayCalibration, SensorCalibration


@dataclass(frozen=True)
class Convention:
    """How one paper names and orders the twelve parameters.

    Internally their order is fixed: the in-plane angle of x, the elevation of x, the angle of y (rad), three scale
    factors, three offsets (nT), and the three rotation angles (rad) in the order of `sequence`.
    """

    name: str
    names: tuple[str, ...]
    sequence: str


CHI = Convention(
    "Chi 2017",
    ("phi", "theta", "psi", "k_x", "k_y", "k_z", "b_x", "b_y", "b_z", "gamma", "beta", "alpha"),
    CHI_SEQUENCE,
)
LI = Convention(
    "Li 2018",
    ("theta", "phi", "psi", "c_x", "c_y", "c_z", "i_x", "i_y", "i_z", "alpha", "beta", "gamma"),
    LI_SEQUENCE,
)
UNITS = ("rad", "rad", "rad", "1", "1", "1", "nT", "nT", "nT", "rad", "rad", "rad")


@dataclass(frozen=True)
class Parameters:
    """Twelve parameters of one sensor in one paper's convention.

    Attributes:
        convention: `CHI` or `LI`.
        values: (12,) in the units of `UNITS`; angles in rad.
        covariance: (12, 12); NaN where the calibration has none, or at a rotation whose three angles are not
            defined (the middle one at 90 deg).
    """

    convention: Convention
    values: Array
    covariance: Array

    @property
    def std(self) -> Array:
        """Standard deviations (12,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def rows(self) -> list[tuple[str, float, float, str]]:
        """(name, value, standard deviation, unit) of each parameter; angles in rad."""
        return [
            (n, float(v), float(s), u)
            for n, v, s, u in zip(self.convention.names, self.values, self.std, UNITS, strict=True)
        ]

    def __getitem__(self, name: str) -> float:
        return float(self.values[self.convention.names.index(name)])


def response(values: Array, convention: Convention) -> tuple[Array, Array]:
    """Response C (3, 3) and offset (3,) nT of twelve parameters in the internal order of `Convention`."""
    rotation = sequence(convention.sequence, values[9:])
    return _triangle(values) @ rotation, values[6:9].copy()


def response_derivatives(values: Array, convention: Convention) -> Array:
    """Derivatives (12, 3, 3) of the response C; those of the three offsets are zero."""
    plane, elevation, psi = values[:3]
    scale = values[3:6]
    cp, sp, ce, se = np.cos(plane), np.sin(plane), np.cos(elevation), np.sin(elevation)
    out = np.zeros((PARAMETERS_PER_SENSOR, 3, 3))
    out[0, 0] = scale[0] * np.array([-sp * ce, cp * ce, 0.0])
    out[1, 0] = scale[0] * np.array([-cp * se, -sp * se, ce])
    out[2, 1] = scale[1] * np.array([0.0, -np.sin(psi), np.cos(psi)])
    unit_rows = _unit_rows(values)
    for k in range(3):
        out[3 + k, k] = unit_rows[k]
    rotation = sequence(convention.sequence, values[9:])
    out[:9] = out[:9] @ rotation
    out[9:] = _triangle(values) @ sequence_derivatives(convention.sequence, values[9:])
    return out


def parameters(matrix: Array, offset: Array, covariance: Array, convention: Convention) -> Parameters:
    """The parameters of one correction b = matrix @ (m - offset).

    Parameters
    ----------
    matrix: (3, 3), to the common frame; offset: (3,) nT.
    covariance: (12, 12) of the nine elements row by row and the offset.
    convention: `CHI` or `LI`.

    Raises
    ------
    DataError: the matrix mirrors (an inverted or swapped axis), which no rotation angle can express.
    """
    rotation, upper = rotation_and_upper(matrix)
    if np.linalg.det(rotation) < 0:
        raise DataError("the calibration mirrors its sensor", hint="an axis is inverted or two are swapped")
    triangle = np.linalg.inv(upper)
    scale = np.linalg.norm(triangle, axis=1)
    x, y = triangle[0] / scale[0], triangle[1] / scale[1]
    values = np.concatenate(
        [
            [np.arctan2(x[1], x[0]), np.arctan2(x[2], np.hypot(x[0], x[1])), np.arctan2(y[2], y[1])],
            scale,
            offset,
            sequence_angles(convention.sequence, rotation.T),
        ]
    )
    # the inverse map is the simple one: d matrix = -matrix dC matrix, so differentiate it and invert
    forward = np.zeros((PARAMETERS_PER_SENSOR, PARAMETERS_PER_SENSOR))
    forward[:9] = -(matrix @ response_derivatives(values, convention) @ matrix).reshape(12, 9).T
    forward[9:, 6:9] = np.eye(3)
    if np.linalg.cond(forward) > 1e12:
        return Parameters(convention, values, np.full_like(covariance, np.nan))
    backward = np.linalg.inv(forward)
    return Parameters(convention, values, backward @ covariance @ backward.T)


def sensor_parameters(calibration: SensorCalibration, convention: Convention) -> Parameters:
    """The parameters of one sensor; in the "cholesky" frame its three rotation angles are zero."""
    return parameters(calibration.matrix, calibration.offset, calibration.covariance, convention)


def array_parameters(calibration: ArrayCalibration, convention: Convention) -> list[Parameters]:
    """The parameters of each sensor of an array; the rotation angles lead from the common frame to the sensor."""
    n = PARAMETERS_PER_SENSOR
    return [
        parameters(m, o, calibration.covariance[n * k : n * (k + 1), n * k : n * (k + 1)], convention)
        for k, (m, o) in enumerate(zip(calibration.matrix, calibration.offset, strict=True))
    ]


def _unit_rows(values: Array) -> Array:
    plane, elevation, psi = values[:3]
    ce = np.cos(elevation)
    return np.array(
        [
            [np.cos(plane) * ce, np.sin(plane) * ce, np.sin(elevation)],
            [0.0, np.cos(psi), np.sin(psi)],
            [0.0, 0.0, 1.0],
        ]
    )


def _triangle(values: Array) -> Array:
    """Scale factors times the non-orthogonality matrix, Chi 2017 eq. 3, Li 2018 eq. 3."""
    out: Array = values[3:6, None] * _unit_rows(values)
    return out
