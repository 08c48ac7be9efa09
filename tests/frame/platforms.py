"""Instruments, attitudes and dipoles for the tests of the common rotation, by formulas of their own."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from magtensor.calibration.joint import calibrated, fit_joint
from magtensor.calibration.types import ArrayCalibration

CROSS = 0.25 * np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
EARTH = np.array([2000.0, 18000.0, -45000.0])


def dipole_field(at: np.ndarray, moment: np.ndarray) -> np.ndarray:
    """nT at places (..., 3) m from a dipole of moment (3,) A m2 at the origin."""
    r = np.linalg.norm(at, axis=-1, keepdims=True)
    along = np.sum(at * moment, axis=-1, keepdims=True)
    return 100.0 * (3 * along * at / r**5 - moment / r**3)


def dipole_tensor(at: np.ndarray, moment: np.ndarray, step: float = 1e-3) -> np.ndarray:
    """nT/m (..., 3, 3), dB_i/dx_j, by central differences of the field."""
    columns = [(dipole_field(at + d, moment) - dipole_field(at - d, moment)) / (2 * step) for d in step * np.eye(3)]
    return np.stack(columns, axis=-1)


class Platform:
    """A rigid array whose sensors err by some per cent and degrees, all turned together by one rotation."""

    def __init__(self, rng: np.random.Generator, position: np.ndarray = CROSS, common_deg: float = 10.0) -> None:
        self.position, self.noise, s = position, 0.15, len(position)
        self.common = Rotation.from_rotvec(np.radians(common_deg) * _direction(rng)).as_matrix()
        own = Rotation.from_rotvec(np.radians(1.0) * rng.normal(size=(s, 3))).as_matrix()
        self.response = (np.eye(3) + 0.01 * rng.normal(size=(s, 3, 3))) @ own @ self.common
        self.offset = 100.0 * rng.normal(size=(s, 3))
        self.rng = rng

    def measured(self, field: np.ndarray) -> np.ndarray:
        """(N, S, 3) nT raw outputs of fields (N, S, 3) in the platform frame."""
        clean = np.einsum("sij,nsj->nsi", self.response, field) + self.offset
        return clean + self.noise * self.rng.normal(size=field.shape)

    def uniform(self, attitude: np.ndarray, world: np.ndarray = EARTH) -> np.ndarray:
        """Raw outputs in the Earth's field alone, attitude (N, 3, 3) platform to world."""
        field = np.einsum("nij,i->nj", attitude, world)
        return self.measured(np.repeat(field[:, None], len(self.position), axis=1))

    def near_dipole(self, attitude: np.ndarray, centre: np.ndarray, moment: np.ndarray) -> np.ndarray:
        """Raw outputs with the array's centre at places (N, 3) m from a dipole, all in the world frame."""
        places = centre[:, None] + np.einsum("nij,sj->nsi", attitude, self.position)
        world = dipole_field(places, moment) + EARTH
        return self.measured(np.einsum("nij,nsi->nsj", attitude, world))

    def in_gradients(self, tensors: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Raw outputs in fields (N, 3) nT with tensors (N, 3, 3) nT/m, both in the platform frame."""
        return self.measured(field[:, None] + np.einsum("nij,sj->nsi", tensors, self.position))

    def calibration(self, samples: int = 600) -> ArrayCalibration:
        """The joint calibration of a survey in all attitudes: its frame is not the platform's."""
        raw, size = self.uniform(Rotation.random(samples, random_state=self.rng).as_matrix()), np.linalg.norm(EARTH)
        return calibrated(fit_joint(raw, np.full(samples, size)))


def _direction(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def level(rng: np.random.Generator, samples: int, heading: float = 0.3, wobble_deg: float = 3.0) -> np.ndarray:
    """(N, 3, 3) attitudes of a platform carried along a line, platform to world, with a slow wobble."""
    time = np.arange(samples)[:, None] / 20.0
    phase, rate = rng.uniform(0, 6.28, (1, 3)), rng.uniform(0.5, 1.5, (1, 3))
    angles = np.radians(wobble_deg) * np.sin(rate * time + phase)
    return (Rotation.from_euler("z", heading) * Rotation.from_rotvec(angles)).as_matrix()


def passes(samples: int, offsets: tuple[float, ...], height: float = 2.0, length: float = 16.0) -> np.ndarray:
    """(N, 3) m: centres along parallel lines past the origin, at these distances to the side."""
    along = np.linspace(-length / 2, length / 2, samples // len(offsets))
    lines = [np.column_stack([along, np.full_like(along, y), np.full_like(along, height)]) for y in offsets]
    return np.vstack(lines)


def random_tensors(rng: np.random.Generator, samples: int, size: float) -> np.ndarray:
    """(N, 3, 3) nT/m: five independent normal components of standard deviation `size`."""
    c = size * rng.normal(size=(5, samples))
    rows = [[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], -c[0] - c[3]]]
    return np.moveaxis(np.array(rows), -1, 0)
