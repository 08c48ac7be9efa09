"""Arrays, attitudes and surveys drawn here, without the product's simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.joint import calibrated, fit_joint, nearest_frame
from magtensor.calibration.types import ArrayCalibration

Array = NDArray[np.float64]

FIELD_NT = 50_000.0
BASELINE_M = 0.5


@dataclass(frozen=True)
class Drawn:
    """A survey in a uniform field.

    Attributes:
        forward: (S, 3, 3) and offset: (S, 3) nT, the truth of m = C b + o.
        field: (N, 3) nT, true, in the platform's frame; total_field: (N,) nT, without noise.
        raw: (N, S, 3) nT with noise.
    """

    forward: Array
    offset: Array
    field: Array
    total_field: Array
    raw: Array

    @property
    def clean(self) -> Array:
        return np.einsum("sij,nj->nsi", self.forward, self.field) + self.offset


def rotation(axis: int, angle: Array) -> Array:
    """(N, 3, 3) about a coordinate axis, rad."""
    c, s = np.cos(angle), np.sin(angle)
    out = np.zeros((len(angle), 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[:, axis, axis] = 1.0
    out[:, i, i], out[:, j, j] = c, c
    out[:, i, j], out[:, j, i] = -s, s
    return out


def directions(rng: np.random.Generator, count: int, tilt_deg: float | None) -> Array:
    """(count, 3) unit vectors of the Earth's field, 60 deg inclined, on the platform: any attitude at all, or any
    heading with roll and pitch up to `tilt_deg`."""
    if tilt_deg is None:
        u = rng.standard_normal((count, 3))
        return u / np.linalg.norm(u, axis=1, keepdims=True)
    roll, pitch = np.radians(rng.uniform(-tilt_deg, tilt_deg, (2, count)))
    heading = rng.uniform(0, 2 * np.pi, count)
    turn = rotation(0, roll) @ rotation(1, pitch) @ rotation(2, heading)
    earth = np.array([0.5, 0.0, np.sqrt(0.75)])
    return np.einsum("nij,j->ni", turn, earth)


def array(rng: np.random.Generator, sensors: int) -> tuple[Array, Array]:
    """C and o of sensors with 1 % of scale, 0.5 deg of non-orthogonality, 2 deg of misalignment, 100 nT of offset."""
    forward = np.empty((sensors, 3, 3))
    for s in range(sensors):
        a, b, c = np.radians(2.0) * rng.standard_normal(3)
        turn = (rotation(0, np.array([a])) @ rotation(1, np.array([b])) @ rotation(2, np.array([c])))[0]
        skewed = np.eye(3) + np.radians(0.5) * np.tril(rng.standard_normal((3, 3)), -1)
        forward[s] = np.diag(1 + 0.01 * rng.standard_normal(3)) @ skewed @ turn
    return forward, 100.0 * rng.standard_normal((sensors, 3))


def drawn(
    seed: int, count: int, *, sensors: int = 4, tilt_deg: float | None = None, noise_nT: float | Array = 1.0
) -> Drawn:
    """A survey with total field that varies by 20 nT."""
    rng = np.random.default_rng(seed)
    forward, offset = array(rng, sensors)
    total = FIELD_NT + 20.0 * np.sin(np.linspace(0, 5, count))
    field = directions(rng, count, tilt_deg) * total[:, None]
    raw = np.einsum("sij,nj->nsi", forward, field) + offset
    raw = raw + noise_nT * rng.standard_normal(raw.shape)
    return Drawn(forward, offset, field, total, raw)


def fitted(survey: Drawn, **options: object) -> ArrayCalibration:
    """The joint calibration with the smallest demands on coverage: some surveys here are poor on purpose."""
    fit = fit_joint(survey.raw, survey.total_field, worst_error=1.0, **options)  # type: ignore[arg-type]
    return calibrated(fit)


def truth(survey: Drawn) -> tuple[Array, Array]:
    """The true correction in the frame nearest to the raw axes, as the joint fit chooses it: matrix and offset."""
    forward = survey.forward @ nearest_frame(survey.forward)
    matrix: Array = np.asarray(np.linalg.inv(forward), dtype=np.float64)
    return matrix, survey.offset


def tensor_error(survey: Drawn, found: ArrayCalibration) -> float:
    """nT/m rms: what the calibration's own errors make of the five differences of Chi (2) in a uniform field."""
    b = np.einsum("sij,nsj->nsi", found.matrix, survey.clean - found.offset)
    x, y = (b[:, 0] - b[:, 2]) / BASELINE_M, (b[:, 1] - b[:, 3]) / BASELINE_M
    five = np.column_stack([x, y[:, 1], y[:, 2]])
    return float(np.sqrt(np.mean(five**2)))
