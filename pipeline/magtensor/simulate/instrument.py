"""The array as built: positions, and the linear error of each sensor, m = C b + o.

C = S N (I + K) R and o = S N hard_iron + bias (Chi 2017 eq. 3 to 5), with scale factors S, non-orthogonality N, soft
iron K and misalignment R (platform to sensor axes).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from magtensor.errors import UsageError
from magtensor.simulate.geometry import ArraySpec, names, positions
from magtensor.simulate.gradiometers import Gradiometers, GradiometersSpec, build_gradiometers
from magtensor.simulate.noise import NoiseSpec
from magtensor.simulate.rotations import passive
from magtensor.simulate.spec import Array, Matrix3, Spec, Vector3, stream


class ChiAngles(Spec):
    """Chi 2017: N of eq. 3, R = Ry(gamma) Rx(beta) Rz(alpha) of eq. 4."""

    convention: Literal["chi2017"]
    psi_rad: float = Field(0.0, description="between the y axis and its ideal, in the yz plane, rad")
    phi_rad: float = Field(0.0, description="between the ideal x axis and the x axis's projection on the xy plane, rad")
    theta_rad: float = Field(0.0, description="between the x axis and the xy plane, rad")
    alpha_rad: float = Field(0.0, description="misalignment about z, rad")
    beta_rad: float = Field(0.0, description="misalignment about x, rad")
    gamma_rad: float = Field(0.0, description="misalignment about y, rad")

    def matrices(self) -> tuple[Array, Array]:
        """N and R, each (3, 3)."""
        rotation = passive("y", self.gamma_rad) @ passive("x", self.beta_rad) @ passive("z", self.alpha_rad)
        return _sensed_axes(self.psi_rad, in_plane=self.phi_rad, out_of_plane=self.theta_rad), rotation


class LiAngles(Spec):
    """Li 2018: A of eq. 3; the rotation is A_alpha A_beta A_gamma, about x, y, z.

    By Li's eq. 6 the angles would have the other sign; the paper's Tables 1 and 2 come out only with this one.
    """

    convention: Literal["li2018"]
    theta_deg: float = Field(
        0.0, description="between the ideal x axis and the x axis's projection on the xy plane, deg"
    )
    phi_deg: float = Field(0.0, description="between the x axis and the xy plane, deg")
    psi_deg: float = Field(0.0, description="between the y axis and its ideal, in the yz plane, deg")
    alpha_deg: float = Field(0.0, description="misalignment about x, deg")
    beta_deg: float = Field(0.0, description="misalignment about y, deg")
    gamma_deg: float = Field(0.0, description="misalignment about z, deg")

    def matrices(self) -> tuple[Array, Array]:
        """N and R, each (3, 3)."""
        theta, phi, psi = np.deg2rad([self.theta_deg, self.phi_deg, self.psi_deg])
        alpha, beta, gamma = np.deg2rad([self.alpha_deg, self.beta_deg, self.gamma_deg])
        rotation = passive("x", alpha) @ passive("y", beta) @ passive("z", gamma)
        return _sensed_axes(psi, in_plane=theta, out_of_plane=phi), rotation


def _sensed_axes(psi: float, *, in_plane: float, out_of_plane: float) -> Array:
    """Rows are the sensed axes in the ideal frame that shares the z axis and the yz plane with them."""
    return np.array(
        [
            [
                np.cos(out_of_plane) * np.cos(in_plane),
                np.cos(out_of_plane) * np.sin(in_plane),
                np.sin(out_of_plane),
            ],
            [0.0, np.cos(psi), np.sin(psi)],
            [0.0, 0.0, 1.0],
        ]
    )


class SensorErrorsSpec(Spec):
    """The linear error of one sensor."""

    scale: Vector3 = Field(default=[1.0, 1.0, 1.0], description="scale factors of x, y, z")
    angles: Annotated[ChiAngles | LiAngles, Field(discriminator="convention")] = Field(
        default=ChiAngles(convention="chi2017"),
        description="non-orthogonality and misalignment in one paper's angles",
    )
    soft_iron: Matrix3 | None = Field(None, description="soft-iron matrix K; none where null")
    hard_iron_nT: Vector3 = Field(
        default=[0.0, 0.0, 0.0], description="field of permanent magnetisation at the sensor, nT"
    )
    bias_nT: Vector3 = Field(default=[0.0, 0.0, 0.0], description="zero offset of the electronics, nT")

    def linear(self) -> tuple[Array, Array]:
        """C (3, 3) and o (3,) nT."""
        non_orthogonality, rotation = self.angles.matrices()
        sensing = np.diag(self.scale) @ non_orthogonality
        soft_iron = np.zeros((3, 3)) if self.soft_iron is None else np.array(self.soft_iron)
        return sensing @ (np.eye(3) + soft_iron) @ rotation, sensing @ self.hard_iron_nT + np.array(self.bias_nT)


class RandomErrorsSpec(Spec):
    """Errors drawn for each sensor, uniform within +- these bounds, from the instrument's seed."""

    scale: float = Field(0.01, ge=0, lt=1, description="deviation of the scale factors from 1")
    non_orthogonality_deg: float = Field(0.5, ge=0, le=10, description="each of the three angles, deg")
    misalignment_deg: float = Field(1.0, ge=0, le=180, description="each of the three angles, deg")
    soft_iron: float = Field(0.0, ge=0, lt=1, description="each element of the soft-iron matrix")
    hard_iron_nT: float = Field(0.0, ge=0, description="each component, nT")
    bias_nT: float = Field(100.0, ge=0, description="each component, nT")

    def drawn(self, rng: np.random.Generator) -> SensorErrorsSpec:
        """One sensor's errors."""
        angles = rng.uniform(-1, 1, 6) * np.deg2rad([self.non_orthogonality_deg] * 3 + [self.misalignment_deg] * 3)
        psi, phi, theta, alpha, beta, gamma = angles.tolist()
        return SensorErrorsSpec(
            scale=(1 + self.scale * rng.uniform(-1, 1, 3)).tolist(),
            angles=ChiAngles(
                convention="chi2017",
                psi_rad=psi,
                phi_rad=phi,
                theta_rad=theta,
                alpha_rad=alpha,
                beta_rad=beta,
                gamma_rad=gamma,
            ),
            soft_iron=(self.soft_iron * rng.uniform(-1, 1, (3, 3))).tolist(),
            hard_iron_nT=(self.hard_iron_nT * rng.uniform(-1, 1, 3)).tolist(),
            bias_nT=(self.bias_nT * rng.uniform(-1, 1, 3)).tolist(),
        )


class InstrumentSpec(Spec):
    """The array and its sensors. Two scenarios with equal instrument sections have the same instrument."""

    seed: int = Field(0, ge=0, description="seed of everything that belongs to the instrument, random errors above all")
    array: ArraySpec = Field(description="geometry")
    errors: RandomErrorsSpec | list[SensorErrorsSpec] = Field(
        default=[],
        description="bounds of random errors, or the errors of each sensor; an empty list: perfect sensors",
    )
    noise: NoiseSpec = Field(default=NoiseSpec(), description="noise of the vector sensors")
    gradiometers: GradiometersSpec | None = Field(
        None, description="elemental gradiometers, logged as channels gradient_xx, ... gradient_yz; none where null"
    )
    resolution_nT: float = Field(0.0, ge=0, description="step of the digitiser, nT; 0: none")
    range_nT: float | None = Field(None, gt=0, description="output saturates at +- this, nT")


@dataclass(frozen=True)
class Instrument:
    """The array as built.

    Attributes:
        names: S names; positions: (S, 3) m; matrix: C (S, 3, 3); offset: o (S, 3) nT.
        gradiometers: None where there are none.
    """

    names: list[str]
    positions: Array
    matrix: Array
    offset: Array
    gradiometers: Gradiometers | None = None


def build_instrument(spec: InstrumentSpec) -> Instrument:
    """Draw or read the errors of each sensor.

    Raises:
        UsageError: the number of error sets is not the number of sensors.
    """
    sensors = names(spec.array)
    if isinstance(spec.errors, RandomErrorsSpec):
        errors = [spec.errors.drawn(stream(spec.seed, "sensor", str(i))) for i in range(len(sensors))]
    else:
        errors = list(spec.errors) or [SensorErrorsSpec()] * len(sensors)
        if len(errors) != len(sensors):
            raise UsageError(f"instrument.errors has {len(errors)} entries; the array has {len(sensors)} sensors")
    linear = [e.linear() for e in errors]
    return Instrument(
        sensors,
        positions(spec.array),
        np.array([c for c, _ in linear]),
        np.array([o for _, o in linear]),
        None if spec.gradiometers is None else build_gradiometers(spec.gradiometers, stream(spec.seed, "gradiometers")),
    )
