"""The common rotation from the tensor alone: in the platform's frame it is symmetric and traceless (METHODS A4.4).

The differences of S calibrated sensors show P' G instead of G. With the five components of G free at every sample they
are a linear model for each P; what it leaves of them, whitened by the sensors' noise, is the cost. It depends on the
samples through their second moments only. The information about a rotation w that a planar cross gives is the sum of
(G_z . w)^2 over the samples, G_z the row of G along the array's normal: a survey in which that row never leaves a
plane, or a line, leaves a direction open. Errors of the calibration that are no common rotation are unknowns too, with
their covariance as what is known of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from magtensor.calibration.types import Array
from magtensor.errors import NotEnoughData
from magtensor.tensor.geometry import RANK_TOLERANCE, array_centre, array_radius, harmonic_design

from .calibration_errors import CalibrationErrors
from .sources import TURNS, Slope, edges_of, excess

LEAST_SAMPLES = 10
_CURVED = 1e-3  # chance that noise passes for a field that is curved over the array


@dataclass(frozen=True)
class _Design:
    """The model at one P, whitened.

    Attributes:
        left: (D, D) projector on what no tensor explains.
        inverse: (5, D), from the differences to the tensor.
        turned: (3, D, 5), derivative of the tensor's columns with a rotation vector, so projected.
    """

    left: Array
    inverse: Array
    turned: Array

    @property
    def derivative(self) -> Array:
        """(3, D, D) of the projector with a rotation vector."""
        one = self.turned @ self.inverse
        out: Array = -one - one.swapaxes(1, 2)
        return out


@dataclass(frozen=True)
class Symmetry:
    """Moments of a survey's calibrated fields; a `Source`.

    Differences are combinations of sensors that grow linearly along the array: two of a planar array, three of any
    other, with three components each; D numbers a sample.

    Attributes:
        columns: (D / 3, 3, 5), differences in nT for 1 nT/m of each component in the platform's frame.
        whitening: (D, D) 1/nT.
        moments: (K, D + 3 S + 1, same), of each block: whitened differences, fields of the sensors, 1; weighted.
        counts: (K,) samples.
        shares: (S, D / 3), of the sensors in the differences.
        errors: of the calibration that made the fields.
    """

    columns: Array
    whitening: Array
    moments: Array
    counts: Array
    shares: Array
    errors: CalibrationErrors
    name: str = "symmetry"

    def cost(self, rotation: Array, spread: float) -> float:
        design = self._design(rotation)
        value = 0.5 * float(np.sum(design.left * self._gram(self._total))) / spread
        by_error, curvature = self._error_slope(design, spread)
        return value - 0.5 * float(by_error @ np.linalg.solve(curvature, by_error))

    def slope(self, rotation: Array, spread: float) -> Slope:
        design = self._design(rotation)
        gram, count = self._gram(self._total), float(self.counts.sum())
        seen = design.inverse @ gram @ design.inverse.T
        noise = design.inverse @ design.inverse.T
        products = np.einsum("kpa,lpb->klab", design.turned, design.turned)
        information: Array = np.einsum("klab,ab->kl", products, seen - count * noise) / spread
        by_noise = count * np.einsum("klab,ab->kl", products, noise) / spread
        gradient = self._gradient(design, gram) / spread
        response: Array = np.zeros((3, self.errors.root.shape[1]))
        if len(self._own):
            by_error, curvature = self._error_slope(design, spread)
            mixed = -self._picked(design.derivative, self._total) / spread
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
        gradients = np.stack([self._gradient(design, self._gram(m)) for m in self.moments])
        if len(self._own):
            by_error = np.stack([-self._picked(design.left, m) for m in self.moments])
            _, curvature = self._error_slope(design, 1.0)
            mixed = -self._picked(design.derivative, self._total)
            gradients = gradients - by_error @ np.linalg.solve(curvature, mixed.T)
        return max(excess(gradients, self.slope(rotation, 1.0).scatter), 1.0)

    def gradient_size(self, rotation: Array) -> tuple[float, float]:
        """RMS in nT/m of a component of the survey's tensors, noise taken off, and of their noise."""
        design = self._design(rotation)
        noise = float(np.mean(np.sum(design.inverse**2, axis=1)))
        seen = np.einsum("ap,pq,aq->a", design.inverse, self._gram(self._total), design.inverse)
        return float(np.sqrt(max(np.mean(seen) / self.counts.sum() - noise, 0.0))), float(np.sqrt(noise))

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
    def _own(self) -> Array:
        """(R, D, 4 S): whitened differences that the errors make of (b_s, 1) of all sensors."""
        each = np.einsum("sd,rsia->rdisa", self.shares, self.errors.own)
        return self.whitening @ each.reshape(len(each), len(self.whitening), 4 * len(self.shares))

    @cached_property
    def _pick(self) -> Array:
        """(4 S, 3 S + 1): (b_s, 1) of all sensors from the fields and one 1."""
        sensors = len(self.shares)
        out = np.zeros((sensors, 4, 3 * sensors + 1))
        for s in range(sensors):
            out[s, :3, 3 * s : 3 * s + 3] = np.eye(3)
            out[s, 3, -1] = 1.0
        return out.reshape(4 * sensors, -1)

    @cached_property
    def _pairs(self) -> Array:
        """(4 S, 4 S) moments of (b_s, 1) of all sensors."""
        size = len(self.whitening)
        return np.asarray(self._pick @ self._total[size:, size:] @ self._pick.T)

    def _design(self, rotation: Array) -> _Design:
        a = self.whitening @ np.einsum("ji,djc->dic", rotation, self.columns).reshape(-1, 5)
        u, s, vt = np.linalg.svd(a, full_matrices=False)
        left = np.eye(len(a)) - u @ u.T
        turned = -np.einsum("ji,wjk,dkc->wdic", rotation, TURNS, self.columns).reshape(3, -1, 5)
        return _Design(left, (vt.T / s) @ u.T, left @ self.whitening @ turned)

    def _gram(self, moments: Array) -> Array:
        size = len(self.whitening)
        return moments[:size, :size]

    def _gradient(self, design: _Design, gram: Array) -> Array:
        out: Array = -np.einsum("kpa,aq,qp->k", design.turned, design.inverse, gram)
        return out

    def _picked(self, operator: Array, moments: Array) -> Array:
        """(..., R): differences made by the errors, times the operator (..., D, D), times the differences; summed."""
        size = len(self.whitening)
        each = operator @ (moments[:size, size:] @ self._pick.T)
        out: Array = np.einsum("rpm,...pm->...r", self._own, each)
        return out

    def _error_slope(self, design: _Design, spread: float) -> tuple[Array, Array]:
        """Gradient (R,) of the cost with the errors at none, and its curvature (R, R), what is known included."""
        count = len(self._own)
        if not count:
            return np.zeros(0), np.eye(0)
        seen = design.left @ self._own @ self._pairs
        curvature = self._own.reshape(count, -1) @ seen.reshape(count, -1).T / spread + np.eye(count)
        return -self._picked(design.left, self._total) / spread, curvature


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
    place = np.asarray(position, dtype=float) - array_centre(position)
    u, s, _ = np.linalg.svd(place, full_matrices=False)
    shares = u[:, s > RANK_TOLERANCE * s[0]]  # (S, D / 3), orthonormal, each of sum zero
    if shares.shape[1] < 2:
        raise NotEnoughData(
            "the symmetry of the tensor needs three sensors that do not lie on one line", where="position"
        )
    if len(b) < LEAST_SAMPLES:
        raise NotEnoughData(f"{len(b)} samples cannot tell the common rotation from the tensor's symmetry")
    if not (np.isfinite(noise).all() and (noise > 0).all()):
        raise NotEnoughData("the noise of the sensors is not known, so the tensor's asymmetry cannot be judged by it")
    radius = array_radius(position)
    gradient = (harmonic_design(place / radius, 2) * radius).reshape(len(place), 3, 5)
    covariance = np.einsum("sd,se,si,ij->diej", shares, shares, np.asarray(noise) ** 2, np.eye(3))
    size = 3 * shares.shape[1]
    whitening = np.linalg.inv(np.linalg.cholesky(covariance.reshape(size, size)))
    contrast = b - b.mean(axis=1, keepdims=True)
    differences = np.einsum("sd,nsi->ndi", shares, contrast)
    weight = _straightness(contrast, shares, differences, float(np.mean(noise**2)))
    rows = np.column_stack([differences.reshape(len(b), -1) @ whitening.T, b.reshape(len(b), -1), np.ones(len(b))])
    parts = edges_of(weight * np.sum(differences**2, axis=(1, 2)))
    return Symmetry(
        np.einsum("sd,sic->dic", shares, gradient),
        whitening,
        np.stack([(rows[p] * weight[p, None]).T @ rows[p] for p in parts]),
        np.array([p.stop - p.start for p in parts], dtype=float),
        shares,
        errors,
    )


def _straightness(contrast: Array, shares: Array, differences: Array, variance: float) -> Array:
    """(N,) weights of samples: below one where the field is so curved over the array that differences miss gradients.

    What no gradient makes of the contrasts is to what gradients make of them as the array's size to the distance of
    the source; the next order, which differences of opposite sensors take for a gradient, is that ratio smaller
    again. Arrays that see no curvature (three sensors, a tetrahedron) weigh all samples alike.
    """
    from scipy.special import chdtri

    sensors, linear = shares.shape
    freedom = 3 * (sensors - 1 - linear)
    if freedom == 0:
        return np.ones(len(contrast))
    curved = np.sum((contrast - np.einsum("sd,ndi->nsi", shares, differences)) ** 2, axis=(1, 2))
    gradient = np.sum(differences**2, axis=(1, 2))
    curved = np.where(curved > chdtri(freedom, _CURVED) * variance, curved - freedom * variance, 0.0)
    missed = curved**2 / np.maximum(gradient, 1e-300) / (3 * linear)
    out: Array = variance / (variance + missed)
    return out
