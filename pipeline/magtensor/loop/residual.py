"""What a joint fit leaves over, independent of attitude and gauge, and how a disturbance would show in it.

With outputs divided by their noise, the residual of a sample has two parts (METHODS A2, projection P_t): 3 S - 3
values *across* the plane that the sensors share, and one *along* the field, |b| - F. A disturbance p (3 S) of the
outputs shows as Q p across, Q the projector off the plane, and as gain . p along. Changes of C and o, the fit's own
parameters, show as any affine function z = (b, 1) of the field across, and as twelve products along.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.joint import JointFit
from magtensor.calibration.nominal import least
from magtensor.calibration.types import Array
from magtensor.loop.terms import Terms
from magtensor.loop.turned import SlowModes


@dataclass(frozen=True)
class Residual:
    """The residual of N samples and its tangent space.

    Attributes:
        across: (N, 3 S) whitened, perpendicular to the plane; None for a single sensor.
        along: (N,) whitened; None without a total field.
        affine: (N, 4) (b, 1), b in units of the mean field: the fit's own freedom across.
        inner: (N, 12) the fit's own freedom along; its rank is 9.
        basis: (3 S, 3) of the plane, orthonormal.
        reference_gain: (N,) d along / d total field, 1/nT.
        noise: (3 S,) nT by which the outputs were divided.
        samples: (N,) their numbers in the survey.
        slow_modes: how slow noise of the sensors shows along.
    """

    across: Array | None
    along: Array | None
    affine: Array
    inner: Array
    basis: Array
    reference_gain: Array
    noise: Array
    samples: NDArray[np.int_]
    slow_modes: SlowModes

    @cached_property
    def gain(self) -> Array:
        """(N, 3 S) d along / d whitened output."""
        out: Array = self.slow_modes.response @ self.basis.T
        return out

    @cached_property
    def projector(self) -> Array:
        """(3 S, 3 S) off the plane."""
        out: Array = np.eye(len(self.basis)) - self.basis @ self.basis.T
        return out

    @cached_property
    def shown_along(self) -> Array:
        """(N, 3 S + 1) 1/nT, d along / d raw output, and last d along / d total field."""
        return np.column_stack([self.gain / self.noise, self.reference_gain])

    @property
    def freedom(self) -> int:
        """Values per sample."""
        size = len(self.noise)
        return (size - 3 if self.across is not None else 0) + (1 if self.along is not None else 0)

    @property
    def scale(self) -> float:
        """nT: what a whitened residual of one stands for, rms over outputs."""
        return float(np.sqrt(np.mean(self.noise**2)))

    def square(self) -> float:
        """Mean square of the whitened residual per value."""
        total = 0.0
        if self.across is not None:
            total += float(np.sum(self.across**2))
        if self.along is not None:
            total += float(np.sum(self.along**2))
        return total / max(len(self.affine) * self.freedom, 1)

    def smaller(self, keep: NDArray[np.int_]) -> Residual:
        """The same for some of the samples."""
        return replace(
            self,
            across=None if self.across is None else self.across[keep],
            along=None if self.along is None else self.along[keep],
            affine=self.affine[keep],
            inner=self.inner[keep],
            reference_gain=self.reference_gain[keep],
            samples=self.samples[keep],
            slow_modes=SlowModes(self.slow_modes.response[keep]),
        )


def residual_of(fit: JointFit, raw: Array, total_field: Array | None, reference_noise: float = 0.0) -> Residual:
    """The residual of a joint fit at the samples it kept.

    Parameters
    ----------
    raw: (N, S, 3) nT and total_field: (N,) nT, those the fit was made from (corrected for adopted effects).
    """
    keep = np.flatnonzero(fit.keep)
    used = raw[keep]
    plane, scalar = fit.plane, fit.scalar
    size = len(plane.noise)
    b = (plane.coordinates(used) - scalar.offset) @ scalar.matrix.T
    length = np.linalg.norm(b, axis=1)
    u = b / length[:, None] if fit.posterior is None else _direction(fit.posterior.field[keep])
    g = u @ scalar.matrix
    spread = np.sqrt(np.einsum("ni,ni->n", g, g) + reference_noise**2)
    unit = float(length.mean())
    affine = np.column_stack([b / unit, np.ones(len(b))])
    across = plane.residual(used) if size > 3 else None
    along = None if total_field is None else (length - total_field[keep]) / spread
    if fit.posterior is not None:
        # the prior holds C and o where the residual is not the least there is
        affine[:, :3] = fit.posterior.field[keep] / unit
        inner = np.einsum("ni,nj->nij", g / spread[:, None], affine).reshape(len(b), 12)
        along = None if along is None else least(along[:, None], inner)[:, 0]
        across = None if across is None else least(across, affine)
    return Residual(
        across=across,
        along=along,
        affine=affine,
        inner=np.einsum("ni,nj->nij", g / spread[:, None], affine).reshape(len(b), 12),
        basis=plane.basis,
        reference_gain=-1.0 / spread,
        noise=plane.noise,
        samples=keep,
        slow_modes=SlowModes(g / spread[:, None]),
    )


def _direction(field: Array) -> Array:
    out: Array = field / np.linalg.norm(field, axis=1, keepdims=True)
    return out


def taken_off(residual: Residual, terms: Terms, theta: Array) -> Residual:
    """The residual that is left when the terms have explained their part; the fit's own freedom fitted anew.

    Parameters
    ----------
    terms: with the residual's samples as rows; theta: (P,).
    """
    across, along = residual.across, residual.along
    raw = terms.contribution(theta, len(residual.noise)) / residual.noise
    if across is not None:
        across = across - raw @ residual.projector
        across = across - residual.affine @ np.linalg.lstsq(residual.affine, across, rcond=None)[0]
    if along is not None:
        along = along - np.einsum("no,no->n", residual.gain, raw)
        along = along - residual.reference_gain * terms.on_reference(theta)
        along = along - residual.inner @ np.linalg.lstsq(residual.inner, along, rcond=1e-9)[0]
    return replace(residual, across=across, along=along)
