"""Where the sensors sit, how a source-free field looks there, and what of it they can determine.

Between the sources and the array B = grad(Phi) with Phi harmonic. About the array's centre Phi is a sum of
homogeneous harmonic polynomials: degree 1 is the field at the centre, degree 2 the gradient tensor, degrees 3
and 4 the second and third gradients. Each coefficient used here is a derivative: `xxz` of degree 3 is
d^2 B_x / dx dz at the centre in nT/m^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement
from math import factorial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError, UsageError, did_you_mean
from magtensor.tensor.elements import AXES, COMPONENTS

Array = NDArray[np.float64]
Order = Literal["gradient", "second", "third"]
Polynomial = dict[tuple[int, int, int], float]

DEGREE_OF_ORDER: dict[str, int] = {"gradient": 2, "second": 3, "third": 4}
RANK_TOLERANCE = 1e-6  # of the largest singular value of the scaled design; a 1 um slip in a metre


def standard_geometry(name: str, baseline: float) -> Array:
    """Positions (S, 3) in m of a common array, centred on the origin.

    Parameters
    ----------
    name : one of `STANDARD_GEOMETRIES`:
        ``cross`` four sensors on +x, +y, -x, -y (numbered 1 to 4 as in Chi 2017 and Li 2018);
        ``square`` the corners of a square in the plane z = 0, from the first quadrant anticlockwise;
        ``triangle`` equilateral in the plane z = 0, the first sensor on +x;
        ``tetrahedron`` regular, the first sensor on +z;
        ``hexahedron`` six sensors in the centres of a cube's faces: +x, +y, +z, -x, -y, -z;
        ``cube`` eight sensors at a cube's corners.
    baseline : m; between opposite sensors of the cross and the hexahedron, the edge of the others.

    Raises
    ------
    UsageError : unknown name, or a baseline that is not a positive number.
    """
    if name not in STANDARD_GEOMETRIES:
        raise UsageError(f"unknown geometry {name!r}{did_you_mean(name, STANDARD_GEOMETRIES)}")
    if not (np.isfinite(baseline) and baseline > 0):
        raise UsageError(f"the baseline must be a positive length in m, not {baseline!r}")
    out: Array = baseline * _unit_geometry(name)
    return out


STANDARD_GEOMETRIES = ("cross", "square", "triangle", "tetrahedron", "hexahedron", "cube")


def _unit_geometry(name: str) -> Array:
    """Positions for a baseline of 1 m."""
    turn = 2 * np.pi * np.arange(4) / 4
    if name == "cross":
        return np.round(np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])) / 2
    if name == "square":
        return np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) / 2
    third = 2 * np.pi * np.arange(3) / 3
    ring = np.column_stack([np.cos(third), np.sin(third), 0 * third]) / np.sqrt(3)
    if name == "triangle":
        return ring
    if name == "tetrahedron":
        height = np.sqrt(2 / 3)
        return np.vstack([[0, 0, 0.75 * height], ring - [0, 0, 0.25 * height]])
    if name == "hexahedron":
        return np.vstack([np.eye(3), -np.eye(3)]) / 2
    corners = np.array(np.meshgrid([1, -1], [1, -1], [1, -1], indexing="ij"), dtype=float)
    return corners.reshape(3, 8).T / 2


def checked_positions(position: Array) -> Array:
    """The positions as float64 (S, 3).

    Raises
    ------
    DataError : another shape, or a position that is not finite.
    """
    r = np.asarray(position, dtype=float)
    if r.ndim != 2 or r.shape[1] != 3 or len(r) == 0:
        raise DataError(
            f"sensor positions have shape {r.shape}",
            where="position",
            hint="one row x, y, z in m per sensor is right",
        )
    bad = np.flatnonzero(~np.isfinite(r).all(axis=1))
    if bad.size:
        numbers = ", ".join(str(i + 1) for i in bad)
        raise DataError(f"the position of sensor {numbers} is not a finite number", where="position")
    return r


def term_names(degree: int) -> tuple[str, ...]:
    """The 2 degree + 1 independent derivatives of degree `degree`: those with at most one z.

    Each further pair of z follows from Laplace's equation: ``..zz = -..xx - ..yy``.
    """
    words = ("".join(w) for w in combinations_with_replacement(AXES, degree))
    return tuple(w for w in words if w.count("z") <= 1)


@cache
def field_polynomials(name: str) -> tuple[Polynomial, Polynomial, Polynomial]:
    """B_x, B_y, B_z of the potential whose derivative `name` is 1 and whose others of `term_names` are 0.

    The potential is the harmonic continuation of its values (no z in the name) or of its normal derivative
    (one z) on the plane z = 0: ``sum_k (-1)^k z^(2k+c)/(2k+c)! Lap_xy^k [x^a y^b/(a! b!)]``.
    """
    a, b, c = (name.count(axis) for axis in AXES)
    plane: Polynomial = {(a, b, 0): 1.0 / (factorial(a) * factorial(b))}
    potential: Polynomial = {}
    power, sign = c, 1.0
    while plane:
        for (i, j, _), value in plane.items():
            potential[(i, j, power)] = sign * value / factorial(power)
        plane = _sum(_derivative(_derivative(plane, 0), 0), _derivative(_derivative(plane, 1), 1))
        power, sign = power + 2, -sign
    return _derivative(potential, 0), _derivative(potential, 1), _derivative(potential, 2)


def _derivative(polynomial: Polynomial, axis: int) -> Polynomial:
    out: Polynomial = {}
    for powers, value in polynomial.items():
        if powers[axis]:
            lower = list(powers)
            lower[axis] -= 1
            out[(lower[0], lower[1], lower[2])] = value * powers[axis]
    return out


def _sum(p: Polynomial, q: Polynomial) -> Polynomial:
    return {powers: p.get(powers, 0.0) + q.get(powers, 0.0) for powers in p.keys() | q.keys()}


def harmonic_design(displacement: Array, degree: int) -> Array:
    """The field of each harmonic term of one degree at each sensor.

    Parameters
    ----------
    displacement : (S, 3) m, from the point about which the field is expanded.
    degree : of the potential; 1 the field there (nT), 2 the tensor (nT/m), 3 and 4 its gradients.

    Returns
    -------
    (3 S, 2 degree + 1): row 3 s + i is B_i at sensor s, columns in the order of `term_names`.
    """
    columns = []
    for name in term_names(degree):
        field = np.zeros((len(displacement), 3))
        for i, polynomial in enumerate(field_polynomials(name)):
            for powers, value in polynomial.items():
                field[:, i] += value * np.prod(displacement ** np.array(powers), axis=1)
        columns.append(field.ravel())
    return np.column_stack(columns)


def array_centre(position: Array) -> Array:
    """(3,) m: the mean of the sensor positions, about which every expansion is made."""
    out: Array = np.mean(position, axis=0)
    return out


def array_radius(position: Array) -> float:
    """Root-mean-square distance of the sensors from the centre, m."""
    return float(np.sqrt(np.mean(np.sum((position - array_centre(position)) ** 2, axis=1))))


def array_design(position: Array, highest_order: Order) -> Array:
    """The scaled design (3 S, 8 | 15 | 24) of all degrees up to `highest_order`, about the array's centre.

    The columns of degree l are divided by radius^(l-1), so that they are numbers of order one: the unknowns
    are then the derivatives times radius^(l-1), all in nT.
    """
    displacement = position - array_centre(position)
    radius = array_radius(position) or 1.0
    degrees = range(1, DEGREE_OF_ORDER[highest_order] + 1)
    return np.hstack([harmonic_design(displacement / radius, degree) for degree in degrees])


@dataclass(frozen=True)
class Determination:
    """What of the tensor a geometry determines.

    Attributes:
        undetermined: the components, as "Gxz", that cannot be estimated on their own; empty when all can.
        combinations: the combinations that can, as "Gxx", "Gxy + Gyy".
        reason: why not all of them can, in words; empty when all can.
        field: whether the field at the centre can be separated from the other terms.
    """

    undetermined: tuple[str, ...]
    combinations: tuple[str, ...]
    reason: str
    field: bool


def determination(position: Array, highest_order: Order = "gradient") -> Determination:
    """Which of the five components the sensors determine when terms up to `highest_order` are unknown too.

    A combination of unknowns can be estimated if it is orthogonal to the null space of the design; the null
    space is that of the singular values below `RANK_TOLERANCE` of the largest.
    """
    r = checked_positions(position)
    design = array_design(r, highest_order)
    _, s, vt = np.linalg.svd(design, full_matrices=True)
    rank = int(np.sum(s > RANK_TOLERANCE * s[0]))
    null = vt[rank:].T
    free_field, free = null[:3], null[3:8]
    undetermined = tuple(
        f"G{c}" for c, row in zip(COMPONENTS, free, strict=True) if np.linalg.norm(row) > RANK_TOLERANCE
    )
    u, values, _ = np.linalg.svd(free, full_matrices=True)
    determined = u[:, int(np.sum(values > RANK_TOLERANCE)) :].T
    return Determination(
        undetermined,
        tuple(_in_words(row) for row in _reduced_rows(determined)),
        _reason(r, highest_order) if undetermined else "",
        bool(np.linalg.norm(free_field) <= RANK_TOLERANCE),
    )


def _reason(position: Array, highest_order: Order) -> str:
    displacement = position - array_centre(position)
    _, s, vt = np.linalg.svd(displacement, full_matrices=True)
    if len(position) == 1:
        return "there is only one sensor"
    if s[0] <= RANK_TOLERANCE * np.abs(position).max():
        return f"the {len(position)} sensors are all at one place"
    if len(s) < 2 or s[1] <= RANK_TOLERANCE * s[0]:
        along = np.flatnonzero(np.abs(vt[0]) > RANK_TOLERANCE)
        if along.size == 1:
            still = " or ".join(AXES[i] for i in range(3) if i not in along)
            return f"the {len(position)} sensors lie on one line: no two of them differ along {still}"
        direction = ", ".join(f"{x:.3g}" for x in vt[0] * np.sign(vt[0][along[0]]))
        return f"the {len(position)} sensors lie on one line, along ({direction})"
    terms = "second-gradient" if highest_order == "second" else "second- and third-gradient"
    return f"the {terms} terms cannot be told from them by {len(position)} sensors so placed"


def _reduced_rows(rows: Array) -> Array:
    """Reduced row echelon form, so that a basis reads in few components."""
    m = rows.copy()
    lead = 0
    for column in range(m.shape[1]):
        if lead == len(m):
            break
        pivot = lead + int(np.argmax(np.abs(m[lead:, column])))
        if abs(m[pivot, column]) < RANK_TOLERANCE:
            continue
        m[[lead, pivot]] = m[[pivot, lead]]
        m[lead] /= m[lead, column]
        others = np.arange(len(m)) != lead
        m[others] -= np.outer(m[others, column], m[lead])
        lead += 1
    return m


def _in_words(row: Array) -> str:
    words = ""
    for component, value in zip(COMPONENTS, row, strict=True):
        if abs(value) < 1e3 * RANK_TOLERANCE:
            continue
        size = "" if abs(abs(value) - 1) < 1e3 * RANK_TOLERANCE else f"{abs(value):.3g} "
        sign = ("-" if value < 0 else "") if not words else (" - " if value < 0 else " + ")
        words += f"{sign}{size}G{component}"
    return words
