"""The common rotation from the tensor alone: in the platform's frame it is symmetric and traceless (METHODS A4.4).

The differences of S calibrated sensors show P' G instead of G. With the field and the five components of G free at
every sample, b = (1 x P') D g + noise is a linear model for each P; what it leaves of b, whitened by the sensors'
noise, is the cost. It depends on the samples through their second moments only. The information about a rotation w
of a planar cross is the sum of (G_z . w)^2 over the samples, G_z the row of G along the array's normal: a survey in
which that row never leaves a plane, or a line, leaves a direction open. Errors of the calibration that are no common
rotation are unknowns too, with their covariance as what is known of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from magtensor.calibration.types import Array
from magtensor.errors import NotEnoughData
from magtensor.tensor.geometry import RANK_TOLERANCE, array_centre, array_design, array_radius

from .calibration_errors import CalibrationErrors
from .sources import TURNS, Slope, edges_of, excess

LEAST_SAMPLES = 10
_CURVED = 1e-3  # chance that noise passes for a field that is curved over the array


@dataclass(frozen=True)
class _Design:
    """The model at one P, whitened: a (3 S, 8), its inverse, what it leaves, and the derivatives with w."""

    left: Array  # (3 S, 3 S) projector
    inverse: Array  # (5, 3 S) to the tensor's components
    turned: Array  # (3, 3 S, 5) left-projected derivative of the tensor's columns

    @property
    def derivative(self) -> Array:
        """(3, 3 S, 3 S) of the projector with w."""
        one = self.turned @ self.inverse
        out: Array = -one - one.swapaxes(1, 2)
        return out


@dataclass(frozen=True)
class Symmetry:
    """Moments of a survey's calibrated fields; a `Source`.

    Attributes:
        position: (S, 3) m; noise: (S, 3) nT.
        moments: (K, 3 S + 4, 3 S + 4), of each block: contrasts, mean field, 1; weighted.
        counts: (K,) samples.
        errors: of the calibration that made the fields.
    """

    position: Array
    noise: Array
    moments: Array
    counts: Array
    errors: CalibrationErrors
    name: str = "symmetry"

    def cost(self, rotation: Array, spread: float) -> float:
        design = self._design(rotation)
        value = 0.5 * float(np.sum(design.left * self._white(self._total))) / spread
        by_error, curvature = self._error_slope(design, spread)
        return value - 0.5 * float(by_error @ np.linalg.solve(curvature, by_error))

    def slope(self, rotation: Array, spread: float) -> Slope:
        design = self._design(rotation)
        gram, count = self._white(self._total), float(self.counts.sum())
        seen = design.inverse @ gram @ design.inverse.T
        noise = design.inverse @ design.inverse.T
        products = np.einsum("kpa,lpb->klab", design.turned, design.turned)
        information: Array = np.einsum("klab,ab->kl", products, seen - count * noise) / spread
        by_noise = count * np.einsum("klab,ab->kl", products, noise) / spread
        gradient = self._gradient(design, gram) / spread
        response: Array = np.zeros((3, self.errors.root.shape[1]))
        if len(self.errors.field):
            by_error, curvature = self._error_slope(design, spread)
            mixed = self._mixed(design, self._total) / spread
            taken: Array = np.asarray(np.linalg.solve(curvature, mixed.T).T, dtype=np.float64)
            gradient = gradient - taken @ by_error
            response = -taken
            information = information - taken @ mixed.T
        values, vectors = np.linalg.eigh(information + by_noise - response @ response.T)
        scatter = (vectors * np.maximum(values, 0.0)) @ vectors.T
        response = response + information @ rotation @ self.errors.common
        return Slope(gradient, information, scatter, information + by_noise, response)

    def spread(self, rotation: Array) -> float:
        design = self._design(rotation)
        gradients = np.stack([self._gradient(design, self._white(m)) for m in self.moments])
        if len(self.errors.field):
            by_error = np.stack([self._by_error(design, m) for m in self.moments])
            _, curvature = self._error_slope(design, 1.0)
            mixed = self._mixed(design, self._total)
            gradients = gradients - by_error @ np.linalg.solve(curvature, mixed.T)
        return max(excess(gradients, self.slope(rotation, 1.0).scatter), 1.0)

    def gradient_size(self, rotation: Array) -> tuple[float, float]:
        """RMS in nT/m of a component of the survey's tensors, noise taken off, and of their noise."""
        design = self._design(rotation)
        inverse = design.inverse / self.noise.ravel()
        gram, count = self._total[: self.noise.size, : self.noise.size], self.counts.sum()
        noise = float(np.mean(np.diag(design.inverse @ design.inverse.T)))
        seen = float(np.mean(np.diag(inverse @ gram @ inverse.T))) / count
        return float(np.sqrt(max(seen - noise, 0.0))), float(np.sqrt(noise))

    def free_because(self, directions: Array) -> str:
        size, noise = self.gradient_size(np.eye(3))
        seen = (
            f"the tensors of its {int(self.counts.sum())} samples ({size:.3g} nT/m rms a component, noise {noise:.3g})"
        )
        if len(directions) == 3:
            return f"{seen} are too small or too few; fly nearer to a source, or use more of the survey"
        return (
            f"{seen} are alike in structure; pass the source on another side or in another direction, or use lines "
            "past several sources"
        )

    @cached_property
    def _total(self) -> Array:
        return np.asarray(self.moments.sum(axis=0))

    @cached_property
    def _columns(self) -> Array:
        """(S, 3, 8): the field of the sensors for 1 nT at the centre, and for 1 nT/m of each component."""
        scale = np.concatenate([np.ones(3), np.full(5, array_radius(self.position))])
        return (array_design(self.position, "gradient") * scale).reshape(len(self.noise), 3, 8)

    @cached_property
    def _own(self) -> Array:
        """(R, S, 3, 4): what the errors add to the contrasts, whitened."""
        return self.errors.own / self.noise[None, :, :, None]

    @cached_property
    def _pairs(self) -> Array:
        """(S, 4, S, 4): sums of (b_s, 1) (b_t, 1)'."""
        size, sensors = self.noise.size, len(self.noise)
        pick = np.zeros((sensors, 4, len(self._total)))
        for s in range(sensors):
            pick[s, :3, 3 * s : 3 * s + 3] = pick[s, :3, size : size + 3] = np.eye(3)
            pick[s, 3, -1] = 1.0
        out: Array = np.einsum("sam,mn,tcn->satc", pick, self._total, pick, optimize=True)
        return out

    def _design(self, rotation: Array) -> _Design:
        white, by_sensor = 1.0 / self.noise.ravel(), self._columns
        a: Array = np.einsum("ji,sjc->sic", rotation, by_sensor).reshape(-1, 8) * white[:, None]
        u, s, vt = np.linalg.svd(a, full_matrices=False)
        rank = int(np.sum(s > RANK_TOLERANCE * s[0]))
        left = np.eye(len(a)) - u[:, :rank] @ u[:, :rank].T
        inverse = (vt[:rank].T / s[:rank]) @ u[:, :rank].T
        turned = -np.einsum("ji,wjk,skc->wsic", rotation, TURNS, by_sensor[..., 3:]).reshape(3, -1, 5)
        return _Design(left, inverse[3:], left @ (turned * white[:, None]))

    def _white(self, moments: Array) -> Array:
        size, white = self.noise.size, 1.0 / self.noise.ravel()
        out: Array = moments[:size, :size] * np.outer(white, white)
        return out

    def _gradient(self, design: _Design, gram: Array) -> Array:
        out: Array = -np.einsum("kpa,aq,qp->k", design.turned, design.inverse, gram)
        return out

    def _with_each(self, moments: Array) -> Array:
        """(3 S, S, 4): whitened contrasts times (b_s, 1) of each sensor."""
        size, sensors = self.noise.size, len(self.noise)
        rows = moments[:size] / self.noise.ravel()[:, None]
        own = rows[:, :size].reshape(size, sensors, 3) + rows[:, None, size : size + 3]
        return np.concatenate([own, np.repeat(rows[:, None, -1:], sensors, axis=1)], axis=2)

    def _picked(self, operator: Array, moments: Array) -> Array:
        """(..., R): what the errors add to a sample's contrasts, times the operator (..., 3 S, 3 S), times those."""
        size, sensors = self.noise.size, len(self.noise)
        each = operator @ self._with_each(moments).reshape(size, -1)
        each = each.reshape(*operator.shape[:-2], sensors, 3, sensors, 4)
        own = np.einsum("...sisa->...sia", each).reshape(*operator.shape[:-2], -1)
        return own @ self._own.reshape(-1, own.shape[-1]).T

    def _by_error(self, design: _Design, moments: Array) -> Array:
        return -self._picked(design.left, moments)

    def _mixed(self, design: _Design, moments: Array) -> Array:
        return -self._picked(design.derivative, moments)

    def _error_slope(self, design: _Design, spread: float) -> tuple[Array, Array]:
        """Gradient (R,) of the cost with the errors at none, and its curvature (R, R), what is known included."""
        count, sensors = len(self._own), len(self.noise)
        if not count:
            return np.zeros(0), np.eye(0)
        left = design.left.reshape(sensors, 3, sensors, 3)
        whole = left[:, :, None, :, :, None] * self._pairs[:, None, :, :, None, :]
        flat = self._own.reshape(count, -1)
        curvature = flat @ whole.reshape(12 * sensors, -1) @ flat.T / spread + np.eye(count)
        return self._by_error(design, self._total) / spread, curvature


def symmetry(b: Array, position: Array, noise: Array, errors: CalibrationErrors) -> Symmetry:
    """Read a survey for what its tensors say of the common rotation.

    Parameters
    ----------
    b: (N, S, 3) nT, calibrated to one common frame, finite, in the order of time.
    position: (S, 3) m in the platform frame.
    noise: (S, 3) nT, white, of b.
    errors: of the calibration that made b.

    Raises
    ------
    NotEnoughData: fewer than three sensors off one line, too few samples, or the noise is not known.
    """
    sensors = b.shape[1]
    line = np.column_stack([np.ones(sensors), position - array_centre(position)])
    u, s, _ = np.linalg.svd(line, full_matrices=False)
    basis = u[:, s > RANK_TOLERANCE * s[0]]
    if basis.shape[1] < 3:
        raise NotEnoughData(
            "the symmetry of the tensor needs three sensors that do not lie on one line", where="position"
        )
    if len(b) < LEAST_SAMPLES:
        raise NotEnoughData(f"{len(b)} samples cannot tell the common rotation from the tensor's symmetry")
    if not (np.isfinite(noise).all() and (noise > 0).all()):
        raise NotEnoughData("the noise of the sensors is not known, so the tensor's asymmetry cannot be judged by it")
    mean = b.mean(axis=1)
    contrast = b - mean[:, None]
    weight = _straightness(contrast, basis, float(np.mean(noise**2)))
    rows = np.column_stack([contrast.reshape(len(b), -1), mean, np.ones(len(b))])
    parts = edges_of(weight * np.sum(contrast**2, axis=(1, 2)))
    return Symmetry(
        np.asarray(position, dtype=float),
        np.asarray(noise, dtype=float),
        np.stack([(rows[p] * weight[p, None]).T @ rows[p] for p in parts]),
        np.array([p.stop - p.start for p in parts], dtype=float),
        errors,
    )


def _straightness(contrast: Array, basis: Array, variance: float) -> Array:
    """(N,) weights of samples: below one where the field is so curved over the array that differences miss gradients.

    What no gradient makes of the contrasts is to what gradients make of them as the array's size to the distance of
    the source; the next order, which differences of opposite sensors take for a gradient, is that ratio smaller
    again. Arrays that see no curvature (three sensors, a tetrahedron) weigh all samples alike.
    """
    from scipy.stats import chi2

    sensors, rank = basis.shape
    if sensors == rank:
        return np.ones(len(contrast))
    linear = np.einsum("sp,tp,nti->nsi", basis, basis, contrast, optimize=True)
    curved = np.sum((contrast - linear) ** 2, axis=(1, 2))
    gradient = np.sum(linear**2, axis=(1, 2))
    freedom = 3 * (sensors - rank)
    curved = np.where(curved > chi2.isf(_CURVED, freedom) * variance, curved - freedom * variance, 0.0)
    missed = curved**2 / np.maximum(gradient, 1e-300) / (3 * (rank - 1))
    out: Array = variance / (variance + missed)
    return out


