"""The difference formulas of the planar cross: Chi 2017 eq. 2 and Li 2018 eq. 2."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magtensor import DataError, method
from magtensor.tensor.assembly import NOT_SYMMETRISED, Assembly, assembly_from_gain
from magtensor.tensor.geometry import array_centre, checked_positions, standard_geometry

Array = NDArray[np.float64]

POSITION_TOLERANCE = 0.01  # of the baseline; the tensor is then wrong by about the same fraction

X, Y, Z = 0, 1, 2


@method("assemble_tensor", source="Chi et al. 2017, eq. 2")
def chi2017_cross(position: Array, noise_covariance: Array | None) -> Assembly:
    """Chi's cross: differences of sensors 1 - 3 and of sensors 2 - 4, Bxy and Byx kept apart.

    Bxx, Byx, Bxz come from sensors 1 - 3, Bxy, Byy, Byz from 2 - 4, and Bzz is -(Bxx + Byy): the tensor is
    traceless but not symmetric.

    Parameters
    ----------
    position : (4, 3) m; sensors 1 to 4 on +x, +y, -x, -y of their centre, one baseline for both pairs.
    noise_covariance : not used, the formula has fixed weights.

    Raises
    ------
    DataError : the positions are not such a cross.
    """
    return _cross("chi2017_cross", position)


@method("assemble_tensor", source="Li et al. 2018, eq. 2")
def li2018_cross(
    position: Array,
    noise_covariance: Array | None,
    *,
    average: Annotated[bool, Field(description="average Bxy and Byx; false keeps both")] = True,
) -> Assembly:
    """Li's cross: the differences of Chi's, with Bxy and Byx averaged where the tensor itself is wanted.

    Li's matrix has the derivative along the row; here as everywhere tensor[i, j] = dB_i/dx_j, so that Bxy is
    (B_x of sensor 2 - B_x of sensor 4)/d. That is also what Li's Table 2 calls Bxy.

    Parameters
    ----------
    position : (4, 3) m; sensors 1 to 4 on +x, +y, -x, -y of their centre, one baseline for both pairs.
    noise_covariance : not used, the formula has fixed weights.

    Raises
    ------
    DataError : the positions are not such a cross.
    """
    assembly = _cross("li2018_cross", position)
    return assembly.symmetrised() if average else assembly


def _cross(name: str, position: Array) -> Assembly:
    r, baseline = _checked_cross(name, position)
    first, second = np.zeros((4, 1)), np.zeros((4, 1))
    first[[0, 2], 0] = second[[1, 3], 0] = np.array([1.0, -1.0]) / baseline
    along_x, along_y = first * np.eye(3)[:, None], second * np.eye(3)[:, None]  # (component, sensor, axis)
    gain = np.array(
        [
            [along_x[X], along_y[X], along_x[Z]],
            [along_x[Y], along_y[Y], along_y[Z]],
            [along_x[Z], along_y[Z], -along_x[X] - along_y[Y]],
        ]
    )
    field_gain = np.repeat(np.eye(3)[:, None], 4, axis=1) / 4
    return assembly_from_gain(name, gain, field_gain, r, (NOT_SYMMETRISED,))


def _checked_cross(name: str, position: Array) -> tuple[Array, float]:
    """The positions and the baseline d in m, which both formulas take to be one."""
    r = checked_positions(position)
    right = "sensors 1 to 4 on +x, +y, -x, -y at one distance are right; least_squares takes any geometry"
    if len(r) != 4:
        what = f"{name} is for a cross of four sensors, this array has {len(r)}"
        raise DataError(what, where="position", hint=right)
    displacement = r - array_centre(r)
    baseline = float(np.linalg.norm(r[0] - r[2]) + np.linalg.norm(r[1] - r[3])) / 2
    ideal = standard_geometry("cross", baseline) if baseline > 0 else np.zeros((4, 3))
    off = np.linalg.norm(displacement - ideal, axis=1)
    worst = int(np.argmax(off))
    if not off[worst] <= POSITION_TOLERANCE * baseline or baseline == 0:
        raise DataError(
            f"the array is not the cross that {name} assumes: sensor {worst + 1} lies at "
            f"{_words(displacement[worst])} m from the centre, not at {_words(ideal[worst])} m",
            where="position",
            hint=right,
        )
    return r, baseline


def _words(point: Array) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in point + 0.0) + ")"
