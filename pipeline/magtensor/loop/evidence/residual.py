"""What a joint fit leaves over, independent of attitude and gauge, and how a disturbance would show in it.

With outputs divided by their noise, the residual of a sample has two parts (METHODS A2, projection P_t): 3 S - 3
values *across* the plane that the sensors share, and one *along* the field, |b| - F. A disturbance p (3 S) of the
outputs shows as Q p across, Q the projector off the plane, and as gain . p along. Changes of C and o, the fit's own
parameters, show as any affine function z = (b, 1) of the field across, and as twelve products along.

Of several surveys with offsets of their own z has a constant for each. Known directions of the field add two values a
sample, *sighted*, in which the same products show; a total field that is an unknown constant takes off its part along.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.joint import JointFit
from magtensor.calibration.nominal_steps import least
from magtensor.calibration.types import Array
from magtensor.error_models.terms import Terms
from magtensor.loop.evidence.quick_length import quick_length
from magtensor.loop.evidence.turned import SlowModes

NOTHING_BETWEEN = (
    1e-4  # mean square of what is left between sensors: none has so little noise, and rounding says nothing
)
_INNER_RANK = 1e-9  # of the largest singular value


@dataclass(frozen=True)
class Sighted:
    """Directions of the field against known ones, two rows for each of N samples.

    Attributes:
        residual: (2 N,) whitened; inner: (2 N, 3 A) the fit's own freedom in it.
        response: (2 N, 3) derivative with the whitened outputs in the plane.
        reference_gain: (2 N,) 1/nT, derivative with the total field.
    """

    residual: Array
    inner: Array
    response: Array
    reference_gain: Array


@dataclass(frozen=True)
class Levels:
    """Unknown constants of the total field.

    Attributes:
        number: (N,) of the constant at each sample; response: (N,) d along / d constant, 1/nT.
    """

    number: NDArray[np.int_]
    response: Array

    def off(self, columns: Array) -> Array:
        """(N,) or (N, Q) without what the constants can explain."""
        each = columns.reshape(len(columns), -1)
        squares = np.bincount(self.number, self.response**2)
        sums = np.column_stack([np.bincount(self.number, self.response * c) for c in each.T])
        best = sums / np.where(squares > 0, squares, 1.0)[:, None]
        out: Array = (each - self.response[:, None] * best[self.number]).reshape(columns.shape)
        return out


@dataclass(frozen=True)
class Residual:
    """The residual of N samples and its tangent space.

    Attributes:
        across: (N, 3 S) whitened, perpendicular to the plane; None for a single sensor, and where outputs that were
            computed without noise leave nothing between the sensors.
        along: (N,) whitened; None without a total field.
        unit: nT, the mean field; affine: (N, A) (b, 1), b in that unit: the fit's own freedom across; A is 4, more
            where surveys have constants of their own.
        inner: (N, 3 A) the fit's own freedom along; its rank is 3 A - 3, 3 A with known directions.
        basis: (3 S, 3) of the plane, orthonormal.
        reference_gain: (N,) d along / d total field, 1/nT.
        noise: (3 S,) nT by which the outputs were divided.
        samples: (N,) their numbers in the survey.
        slow_modes: how slow noise of the sensors shows along.
        sighted: known directions; levels: unknown constants, which `along` and `inner` have been freed of.
        time: (N,) s of the samples, where they are of one survey.
        reading_s: s between readings of the base station; 0 where they are not known.
    """

    across: Array | None
    along: Array | None
    unit: float
    affine: Array
    inner: Array
    basis: Array
    reference_gain: Array
    noise: Array
    samples: NDArray[np.int_]
    slow_modes: SlowModes
    sighted: Sighted | None = None
    levels: Levels | None = None
    time: Array | None = None
    reading_s: float = 0.0

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
    def free_across(self) -> Array:
        """(N, A) orthonormal: what the fit's own freedom can explain of each output across."""
        return np.asarray(np.linalg.qr(self.affine)[0])

    @cached_property
    def free_along(self) -> Array:
        """(N, 3 A - 3) orthonormal: the same along; with known directions (3 N, 3 A), theirs after it."""
        rows = self.inner if self.sighted is None else np.concatenate([self.inner, self.sighted.inner])
        basis, size, _ = np.linalg.svd(rows, full_matrices=False)
        out: Array = basis[:, size > _INNER_RANK * size[0]]
        return out

    @cached_property
    def shown_along(self) -> Array:
        """(3 S + 1, N) 1/nT, d along / d raw output, and last d along / d total field."""
        return np.vstack([(self.gain / self.noise).T, self.reference_gain])

    @cached_property
    def shown_sighted(self) -> Array:
        """(3 S + 1, 2 N) 1/nT, the same of known directions."""
        assert self.sighted is not None
        gain = self.sighted.response @ self.basis.T
        return np.vstack([(gain / self.noise).T, self.sighted.reference_gain])

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
        """The same for some of the samples of one survey with a measured total field."""
        assert self.sighted is None and self.levels is None
        return replace(
            self,
            across=None if self.across is None else self.across[keep],
            along=None if self.along is None else self.along[keep],
            affine=self.affine[keep],
            inner=self.inner[keep],
            reference_gain=self.reference_gain[keep],
            samples=self.samples[keep],
            time=None if self.time is None else self.time[keep],
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
    seen_along = affine
    if total_field is not None:  # of the length that is known: a sample's own noise along u is the residual itself
        seen_along = np.column_stack([u * (total_field[keep] / unit)[:, None], affine[:, 3]])
    across = plane.residual(used) if size > 3 else None
    if across is not None and np.mean(across**2) < NOTHING_BETWEEN:
        across = None
    along = None if total_field is None else (length - total_field[keep]) / spread
    if fit.posterior is not None:
        # the prior holds C and o where the residual is not the least there is
        affine[:, :3] = fit.posterior.field[keep] / unit
        seen_along = affine
        inner = np.einsum("ni,nj->nij", g / spread[:, None], affine).reshape(len(b), 12)
        along = None if along is None else least(along[:, None], inner)[:, 0]
        across = None if across is None else least(across, affine)
    return Residual(
        across=across,
        along=along,
        unit=unit,
        affine=affine,
        inner=np.einsum("ni,nj->nij", g / spread[:, None], seen_along).reshape(len(b), 12),
        basis=plane.basis,
        reference_gain=-1.0 / spread,
        noise=plane.noise,
        samples=keep,
        slow_modes=SlowModes(g / spread[:, None]),
    )


def quick(residual: Residual) -> Residual:
    """The residual without the last of its samples, as few of them as make its transforms quick (`quick_length`)."""
    length = quick_length(len(residual.samples))
    return residual if length == len(residual.samples) else residual.smaller(np.arange(length))


def _direction(field: Array) -> Array:
    out: Array = field / np.linalg.norm(field, axis=1, keepdims=True)
    return out


def taken_off(residual: Residual, terms: Terms, theta: Array) -> Residual:
    """The residual that is left when the terms have explained their part; the fit's own freedom fitted anew.

    Parameters
    ----------
    terms: with the residual's samples as rows; theta: (P,).
    """
    across, along, sighted = residual.across, residual.along, residual.sighted
    raw = terms.contribution(theta, len(residual.noise)) / residual.noise
    if across is not None:
        across = across - raw @ residual.projector
        across = across - residual.free_across @ (residual.free_across.T @ across)
    if along is not None:
        on_reference = terms.on_reference(theta)
        moved = np.einsum("no,no->n", residual.gain, raw) + residual.reference_gain * on_reference
        off = along - (moved if residual.levels is None else residual.levels.off(moved))
        if sighted is not None:
            turned = np.einsum("nj,nj->n", sighted.response, np.repeat(raw @ residual.basis, 2, axis=0))
            turned += sighted.reference_gain * np.repeat(on_reference, 2)
            off = np.concatenate([off, sighted.residual - turned])
        off = off - residual.free_along @ (residual.free_along.T @ off)
        along = off[: len(along)]
        sighted = None if sighted is None else replace(sighted, residual=off[len(along) :])
    return replace(residual, across=across, along=along, sighted=sighted)
