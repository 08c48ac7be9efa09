"""The orbit of a gradient tensor under rotation, seen through a linear instrument, and the foot points on it.

An array turned about its centre in a constant tensor G0 reads ``y_t = K S(Q_t) g0 + O + noise``: points near a
three-dimensional surface in the five-dimensional space of the components. The rotation Q_t is not known; the point of
the surface nearest to y_t, its foot, is the maximum-likelihood value of the true reading. Everything here is in
whitened components (unit noise covariance but for a factor) divided by the magnitude C_T.

The shape of G0 is an angle: its eigenvalues are sqrt(2/3) C_T cos(angle - (0, 2 pi/3, -2 pi/3)), in descending order
for 0 <= angle <= pi/3; cos(3 angle) is the normalised determinant. At both ends the source is axisymmetric.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.tensor.elements import FIVE_OF_NINE, GENERATORS, METRIC, full

Array = NDArray[np.float64]

COEFFICIENTS = 31  # K row by row, O, and the angle of the shape

_SECOND = np.stack([[(a @ b + b @ a) / 2 for b in GENERATORS] for a in GENERATORS])
"""(3, 3, 5, 5): second derivatives of S(Q) at the identity by the rotation vector."""

_CHUNK = 8192
_STEPS = 30
_FLAT = 1e-8  # of the largest stretch: a direction in which the surface has shrunk to nothing


@dataclass(frozen=True)
class Surface:
    """The instrument and the shape of the source: y = mixing @ S(Q) @ g0(angle) + offset.

    Attributes:
        mixing: (5, 5), of whitened readings by the components of the unit tensor.
        offset: (5,), whitened, in units of C_T.
        angle: rad, the shape of G0.
    """

    mixing: Array
    offset: Array
    angle: float

    def moved(self, step: Array) -> Surface:
        """After a change (31,) of the coefficients."""
        return Surface(self.mixing + step[:25].reshape(5, 5), self.offset + step[25:30], self.angle + float(step[30]))

    def gauge(self) -> Array:
        """(3, 31): the change of the coefficients that turns all tensors about x, y, z and moves no reading."""
        return np.stack([np.concatenate([(self.mixing @ k).ravel(), np.zeros(6)]) for k in GENERATORS])


@dataclass(frozen=True)
class Feet:
    """The nearest points of the surface.

    Attributes:
        rotation: (N, 3, 3), Q_t.
        g: (N, 5) components of the unit tensor there; across: (N, 5) their derivative by the angle of the shape.
        residual: (N, 5) reading less foot, orthogonal to the surface.
    """

    rotation: Array
    g: Array
    across: Array
    residual: Array

    @property
    def cost(self) -> float:
        """Sum of squared residuals."""
        return float(np.sum(self.residual**2))


def unit_eigenvalues(angle: float) -> tuple[Array, Array]:
    """Eigenvalues (3,) of the tensor of unit magnitude, and their derivative by the angle, of unit magnitude too."""
    phases = angle - np.array([0.0, 2.0, -2.0]) * np.pi / 3
    return np.sqrt(2 / 3) * np.cos(phases), -np.sqrt(2 / 3) * np.sin(phases)


def shape_angle(normalised_determinant: float) -> float:
    """The angle in [0, pi/3] of a normalised determinant."""
    return float(np.arccos(np.clip(normalised_determinant, -1, 1)) / 3)


def smallest_radius(angle: float) -> float:
    """Radius, in units of C_T, of the narrowest circle on the orbit; 0 for an axisymmetric source.

    Turning the plane of two eigenvectors moves the tensor on a circle of radius |difference of eigenvalues| / sqrt 2.
    """
    values = np.sort(unit_eigenvalues(angle)[0])
    return float(np.diff(values).min() / np.sqrt(2))


def feet(readings: Array, surface: Surface, start: Array | None = None) -> Feet:
    """The foot of every reading, by Newton's method.

    Parameters
    ----------
    readings : (N, 5) whitened, in units of C_T.
    start : (N, 3, 3) rotations near the feet; the eigenvectors of the corrected readings where not given.
    """
    values, slopes = unit_eigenvalues(surface.angle)
    if start is None:
        start = _with_the_eigenvectors_of(readings, surface, values)
    rotation = _descended(readings, surface, start, values)
    g = _turned(rotation, values)
    return Feet(rotation, g, _turned(rotation, slopes), readings - surface.offset - g @ surface.mixing.T)


def _with_the_eigenvectors_of(readings: Array, surface: Surface, values: Array) -> Array:
    corrected = (readings - surface.offset) @ np.linalg.inv(surface.mixing).T
    vectors = np.linalg.eigh(full(corrected))[1]
    rotation = vectors[:, :, np.argsort(np.argsort(values))]  # eigh ascends; the values need not descend
    rotation[:, :, 2] *= np.linalg.det(rotation)[:, None]
    return rotation


def _turned(rotation: Array, values: Array) -> Array:
    """(N, 5) components of Q diag(values) Q'."""
    nine = np.matmul(rotation * values, rotation.transpose(0, 2, 1)).reshape(-1, 9)
    out: Array = nine @ FIVE_OF_NINE.T
    return out


def _distance(readings: Array, surface: Surface, rotation: Array, values: Array) -> Array:
    apart = readings - surface.offset - _turned(rotation, values) @ surface.mixing.T
    out: Array = np.einsum("nc,nc->n", apart, apart)
    return out


def _descended(readings: Array, surface: Surface, rotation: Array, values: Array) -> Array:
    """Rotations at a minimum of the distance; a sample leaves the iteration when its step is at rounding."""
    found = rotation.copy()
    here = _distance(readings, surface, found, values)
    active = np.arange(len(readings))
    second = _second_derivatives(surface)
    for _ in range(_STEPS):
        y, q = readings[active], found[active]
        g = _turned(q, values)
        residual = y - surface.offset - g @ surface.mixing.T
        tangent = _tangents(surface, g)
        gram = np.matmul(tangent.transpose(0, 2, 1), tangent)
        slope = np.einsum("nca,nc->na", tangent, residual)
        bend = np.einsum("nke,ne->nk", (residual @ second).reshape(-1, 9, 5), g).reshape(-1, 3, 3)
        step = _newton_step(gram, bend, slope)
        trial = np.matmul(_rotations(step), q)
        there = _distance(y, surface, trial, values)
        for _ in range(8):
            worse = there > here[active] * (1 + 1e-12) + 1e-30
            if not worse.any():
                break
            step[worse] /= 4
            trial[worse] = np.matmul(_rotations(step[worse]), q[worse])
            there[worse] = _distance(y[worse], surface, trial[worse], values)
        better = there <= here[active]
        found[active[better]], here[active[better]] = trial[better], there[better]
        active = active[np.linalg.norm(step, axis=1) > 1e-9]
        if not len(active):
            break
    return found


def _second_derivatives(surface: Surface) -> Array:
    """(5, 45): of the readings by two rotations and the component of the unit tensor."""
    out: Array = np.einsum("cd,abde->cabe", surface.mixing, _SECOND).reshape(5, 45)
    return out


def _newton_step(gram: Array, bend: Array, slope: Array) -> Array:
    """Newton's step where the distance is convex, else Gauss-Newton's, a little damped; half a radian at most."""
    curved = gram - bend
    floor = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-300 * np.eye(3)
    raised = curved - floor
    minor = raised[:, 0, 0] * raised[:, 1, 1] - raised[:, 0, 1] * raised[:, 1, 0]
    convex = (raised[:, 0, 0] > 0) & (minor > 0) & (np.linalg.det(raised) > 0)
    matrix: Array = np.where(convex[:, None, None], curved, gram + 1e4 * floor)
    step = np.linalg.solve(matrix, slope[:, :, None])[:, :, 0]
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1, 0.5 / np.maximum(length, 1e-300)))


def _rotations(vectors: Array) -> Array:
    """(N, 3, 3) of rotation vectors (N, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=1)
    x, y, z = vectors.T
    cross = np.zeros((len(vectors), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross[:, 1, 0], cross[:, 2, 0], cross[:, 2, 1] = z, -y, x
    first = np.sinc(angle / np.pi)[:, None, None]
    second = (np.sinc(angle / (2 * np.pi)) ** 2 / 2)[:, None, None]
    out: Array = np.eye(3) + first * cross + second * np.matmul(cross, cross)
    return out


def _tangents(surface: Surface, g: Array) -> Array:
    """(N, 5, 3): how the foot moves with a small rotation about x, y, z."""
    return np.stack([g @ (surface.mixing @ k).T for k in GENERATORS], axis=2)


def normals(surface: Surface, found: Feet) -> Array:
    """(N, 5, 2): orthonormal directions off the surface.

    The gradients of both invariants, that is, all tensors with the same eigenvectors: they stay apart where two
    eigenvalues coincide.
    """
    forth = METRIC @ np.linalg.inv(surface.mixing)
    one, two = found.g @ forth, found.across @ forth
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    two -= np.einsum("nc,nc->n", one, two)[:, None] * one
    two /= np.linalg.norm(two, axis=1, keepdims=True)
    return np.stack([one, two], axis=2)


def derivatives(surface: Surface, found: Feet, normal: Array) -> Array:
    """(2 N, 31): how the surface moves along its normals with the coefficients, the rotations left free."""
    return _rows(normal, found.g, 1.0, found.across @ surface.mixing.T)


def _rows(direction: Array, g: Array, one: float, by_angle: Array) -> Array:
    """direction' (dK g + dO one + by_angle dangle), (2 N, 31)."""
    count = len(g)
    out = np.empty((count, 2, COEFFICIENTS))
    across = direction.transpose(0, 2, 1)
    out[:, :, :25] = (across[:, :, :, None] * g[:, None, None, :]).reshape(count, 2, 25)
    out[:, :, 25:30] = one * across
    out[:, :, 30] = np.einsum("nkc,nc->nk", across, by_angle)
    return out.reshape(2 * count, COEFFICIENTS)


def bent(surface: Surface, found: Feet, normal: Array) -> tuple[Array, Array, Array]:
    """Tangents (N, 5, 3), a root of the inverse of their Gram matrix (N, 3, 3), curvature along the normals
    (N, 2, 3, 3)."""
    tangent = _tangents(surface, found.g)
    _, stretch, turned = np.linalg.svd(tangent, full_matrices=False)
    stretch = np.maximum(stretch, _FLAT * stretch[:, :1])
    root = turned.transpose(0, 2, 1) / stretch[:, None, :]
    second = np.matmul(normal.transpose(0, 2, 1), _second_derivatives(surface)).reshape(-1, 2, 9, 5)
    curvature = np.matmul(second, found.g[:, None, :, None]).reshape(-1, 2, 3, 3)
    return tangent, root, curvature


def curvature_pull(surface: Surface, found: Feet, normal: Array) -> Array:
    """(N, 2): the mean of the residual along the normals per unit of noise variance, which the surface's bend causes.

    Noise along a bent surface leaves it on the outer side: E[n' r] = -1/2 tr((J'J)^-1 n' f'') sigma^2.
    """
    _, root, curvature = bent(surface, found, normal)
    out: Array = -0.5 * np.einsum("nab,nkab->nk", np.matmul(root, root.transpose(0, 2, 1)), curvature)
    return out


def noise_information(surface: Surface, found: Feet, normal: Array) -> Array:
    """(31, 31): the part of the information about the coefficients that noise alone makes, per unit of its variance.

    Noise along the surface moves each foot, and with it the row of `derivatives`. In a direction of coefficients that
    the true tensors leave empty, the information found is this times the variance; in one they fill, much more.
    """
    out = np.zeros((COEFFICIENTS, COEFFICIENTS))
    for start in range(0, len(found.g), _CHUNK):
        part = slice(start, start + _CHUNK)
        piece = Feet(found.rotation[part], found.g[part], found.across[part], found.residual[part])
        tangent, root, curvature = bent(surface, piece, normal[part])
        inverse = np.matmul(root, root.transpose(0, 2, 1))
        drawn = np.matmul(np.matmul(tangent, inverse), curvature.transpose(0, 2, 1, 3).reshape(-1, 3, 6))
        drawn = drawn.reshape(-1, 5, 2, 3)
        by_angle = piece.across @ surface.mixing.T
        moved = [
            _rows(normal[part], piece.g @ k.T, 0.0, piece.across @ (surface.mixing @ k).T)
            - _rows(drawn[..., d], piece.g, 1.0, by_angle)
            for d, k in enumerate(GENERATORS)
        ]
        for column in range(3):
            rows = sum(np.repeat(root[:, d, column], 2)[:, None] * moved[d] for d in range(3))
            out += np.asarray(rows).T @ np.asarray(rows)
    return out
