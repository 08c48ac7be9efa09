"""What several sensors have in common: the field, and nothing else.

Sensors that see one field b(t) give raw outputs x = C b + o + noise in 3 S dimensions: a three-dimensional plane
with noise around it. The plane is found from second moments alone, without the attitude, the total field or any
start value: with the noise of every axis made equal, it is spanned by the three leading principal axes, which is
the maximum-likelihood answer. What is left perpendicular to it, 3 S - 3 values a sample, is what METHODS A2 calls
the residual after the unknown field has been projected off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import MissingAttitudes

from .types import Array, Mask

LEAST_SAMPLES_PER_AXIS = 20  # below this the noise is taken as equal on all axes of the array
LEAST_SHARE = 0.05  # of its sensor's mean noise variance: a smaller estimate is a Heywood case, not a quiet axis
QUIETEST = 1e-4  # the same of a sensor among all: noise levels differ by factors of 30, and one of zero weighs all
NOISELESS = 1e-9  # of the outputs: less noise is the rounding of what was computed, and no sensor's
_ALIKE = 0.98  # cosine of the largest angle between two planes
_CHUNK = 65536


@dataclass(frozen=True)
class CommonField:
    """The plane that raw outputs share, in outputs divided by their noise.

    Attributes:
        noise: (3 S,) nT, standard deviation of each output.
        basis: (3 S, 3), orthonormal, spans the plane.
        mean: (3 S,) of the whitened outputs; a point of the plane.
        samples: how many were used.
        chi2: mean square of the whitened residual per degree of freedom; 1 where the noise was estimated here.
    """

    noise: Array
    basis: Array
    mean: Array
    samples: int
    chi2: float

    def coordinates(self, raw: Array) -> Array:
        """(N, 3) coordinates in the plane of raw (N, S, 3) nT; their noise has unit variance."""
        out: Array = (raw.reshape(len(raw), -1) / self.noise) @ self.basis
        return out

    def residual(self, raw: Array) -> Array:
        """(N, 3 S) whitened residual perpendicular to the plane."""
        x = raw.reshape(len(raw), -1) / self.noise - self.mean
        out: Array = x - (x @ self.basis) @ self.basis.T
        return out


def common_field(raw: Array, noise: Array | None = None, keep: Mask | None = None) -> CommonField:
    """Find the plane, and the noise of each output unless it is given.

    Parameters
    ----------
    raw: (N, S, 3) nT, finite.
    noise: (S, 3) nT; estimated from the residual itself when None (needs at least two sensors).
    keep: (N,) samples to use.

    Raises
    ------
    MissingAttitudes: fewer than five samples, or the field never left a plane through the outputs.
    """
    used = raw if keep is None else raw[keep]
    count, size = len(used), 3 * raw.shape[1]
    if count < 5:
        raise MissingAttitudes(
            f"{count} samples cannot tell the field from the sensors", hint="five attitudes are the least"
        )
    mean, factor = _factor(used)
    sd = np.ones(size) if noise is None else np.asarray(noise, dtype=float).ravel()
    if size == 3:
        basis, own = np.eye(3), np.zeros((3, 3))
    elif noise is not None:
        basis, own = _plane(factor / sd)
    else:
        sd, basis, own = _with_noise(factor, count)
    if size > 3:
        freedom = (size - 3) * (count - 4) / count  # three coordinates a sample, and the plane's own parameters
        chi2 = float(np.trace(own) / max(freedom, 1e-9)) if count > 4 else float("nan")
    else:
        chi2 = float("nan")
    return CommonField(sd, _handed(basis), mean / sd, count, chi2)


def output_noise(raw: Array, keep: Mask | None = None, run: NDArray[np.int_] | None = None) -> Array:
    """White noise (S, 3) nT of every output, from what second differences in time have in common and have not.

    Second differences (over sqrt 6) of the outputs share a plane as the outputs do, and hold nothing slower than a
    few samples: slow effects that no model knows yet cannot pass for noise. Where the field hardly moves from one
    sample to the next, those three directions would be noise of the worst sensor, and what is left too quiet: then it
    is the plane of the outputs themselves that is projected off. Needs at least two sensors.

    Parameters
    ----------
    raw: (N, S, 3) nT, finite.
    keep: (N,) samples to use; a difference that touches another one is left out where enough of them remain.
    run: (N,) which samples follow each other in time; so is a difference of different runs.

    Raises
    ------
    MissingAttitudes: as in `common_field`.
    """
    least = NOISELESS * float(np.sqrt(np.mean(raw**2)))
    among = None if keep is None else keep[:-2] & keep[1:-1] & keep[2:]
    if run is not None:
        within = run[2:] == run[:-2]
        among = within if among is None else among & within
    if among is not None and among.sum() < LEAST_SAMPLES_PER_AXIS:
        among = None
    second = np.diff(raw, n=2, axis=0) / np.sqrt(6.0)
    found = common_field(second, keep=among)
    own, outputs = np.linalg.qr(found.noise[:, None] * found.basis)[0], _widest(raw if keep is None else raw[keep])
    if np.linalg.svd(own.T @ outputs)[1].min() < _ALIKE:
        moves = second if among is None else second[among]
        return np.maximum(_with_noise(_factor(moves)[1], len(moves), outputs)[0].reshape(raw.shape[1], 3), least)
    return np.maximum(found.noise.reshape(raw.shape[1], 3), least)


def _widest(raw: Array) -> Array:
    """(3 S, 3) orthonormal: in which directions raw outputs (N, S, 3) nT move most."""
    flat = raw.reshape(len(raw), -1)
    flat = flat - flat.mean(axis=0)
    return np.asarray(np.linalg.eigh(flat.T @ flat)[1][:, -3:])


def _handed(basis: Array) -> Array:
    """The same plane with the coordinates as right-handed as most sensors are."""
    determinants = np.linalg.det(basis.reshape(-1, 3, 3))
    flip = 1.0 if determinants.sum() >= 0 else -1.0
    return basis * np.array([flip, 1.0, 1.0])


def _factor(raw: Array) -> tuple[Array, Array]:
    """Mean (3 S,) of raw outputs and a factor R (min(N, 3 S), 3 S) of their covariance R' R, in chunks.

    The covariance itself, of a field a million times the noise, would hold the noise with four digits.
    """
    flat = raw.reshape(len(raw), -1)
    chunks = range(0, len(flat), _CHUNK)
    centre = flat[0]
    mean = centre + sum((flat[i : i + _CHUNK] - centre).sum(axis=0) for i in chunks) / len(flat)
    factor = np.zeros((0, flat.shape[1]))
    for i in chunks:
        rows = np.concatenate([factor, flat[i : i + _CHUNK] - mean])
        factor = np.asarray(np.linalg.qr(rows, mode="r"), dtype=float)
    return mean, factor / np.sqrt(len(flat))


def _plane(factor: Array) -> tuple[Array, Array]:
    """The three leading axes (n, 3) of whitened outputs, from a factor of their moments, and the moments perpendicular
    to them."""
    _, size, axes = np.linalg.svd(factor, full_matrices=False)
    if size[2] <= 1e-6 * size[0]:
        raise MissingAttitudes(
            "the outputs never leave a plane: the field was never turned about a second axis",
            hint="turn the array about more than one axis",
        )
    across = size[3:, None] * axes[3:]
    return axes[:3].T, across.T @ across


def _off(factor: Array, plane: Array) -> tuple[Array, Array]:
    """As `_plane`, the plane (n, 3) being known."""
    basis = np.linalg.qr(plane)[0]
    across = factor - (factor @ basis) @ basis.T
    return basis, across.T @ across


def _with_noise(factor: Array, count: int, known: Array | None = None) -> tuple[Array, Array, Array]:
    """Noise of each output, plane and perpendicular moments, by alternating between the two, or that off a known plane
    (3 S, 3) of the outputs in nT.

    Below `LEAST_SAMPLES_PER_AXIS` samples an axis, and with two sensors (whose axes share one residual), all
    outputs are given the same noise.
    """
    size = factor.shape[1]
    sd = np.ones(size)

    def split() -> tuple[Array, Array]:
        return _plane(factor / sd) if known is None else _off(factor / sd, known / sd[:, None])

    basis, own = split()
    sd = sd * np.sqrt(max(np.trace(own), 1e-300) * count / (max(count - 4, 1) * (size - 3)))
    if size <= 6 or count < LEAST_SAMPLES_PER_AXIS * size:
        basis, own = split()
        return sd, basis, own
    for _ in range(200):
        basis, own = split()
        share = 1.0 - np.sum(basis**2, axis=1)
        variance = np.diag(own) / np.maximum(share, 1e-6) * count / (count - 4)
        step = np.sqrt(np.clip(variance, 0.1, 10.0))
        before, sd = sd, np.maximum(sd * step, _least(sd))
        if np.max(np.abs(sd / before - 1)) < 1e-6:
            break
    basis, own = split()
    return sd, basis, own


def _least(sd: Array) -> Array:
    """(3 S,), the least noise that outputs of noise (3 S,) are believed to have."""
    own = np.mean(sd.reshape(-1, 3) ** 2, axis=1)
    return np.sqrt(np.repeat(np.maximum(LEAST_SHARE * own, QUIETEST * own.mean()), 3))
