"""Steps to the most probable parameters of sensors near nominal (`nominal`), and what these make of the samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.errors import NotEnoughData

from .common_field import CommonField
from .maximum_likelihood import along, products_of
from .types import Array

BLOCKS = (120, 30, 12)
ELSEWHERE = 0.1  # of the field's variance: samples whose neighbours differ by more do not follow each other
ROUNDING = 1e-13
CLOSE = 0.01  # standard deviations of what is fitted: of the last step
ASTRAY = 10.0  # the same: no step leads to a fit, as of outputs that an effect which ran away has been taken off
DIVERGES, HINT = "the fit near nominal does not converge", "look for disturbed samples"
_STEPS, _SLOW_STEPS = 20, 100
_FARTHEST_STEP = 1.0  # standard deviations of the prior
_DAMPING, _HARDER, _SOFTER, _HARDEST = 0.1, 4.0, 3.0, 1e6  # beside the prior: at first, each time, and at most


@dataclass(frozen=True)
class Here:
    """Where the fit stands, at parameters rows (3 S, 4).

    Attributes:
        plane, matrix, offset: of these parameters, as in `CommonField` and `ScalarFit`.
        field: (N, 3) nT; direction: (N, 3).
        across: (N, 3 S) and along: (N,), whitened residuals; inverse_std: (N,) 1/nT, of |b| - F.
    """

    rows: Array
    plane: CommonField
    matrix: Array
    offset: Array
    field: Array
    direction: Array
    across: Array
    along: Array
    inverse_std: Array

    def inner(self, direction: Array, z: Array) -> Array:
        """(12, N) change of the residual along with each coordinate of the plane times z (4, N), for directions (N, 3)
        of the field."""
        gain = self.matrix.T @ (direction * self.inverse_std[:, None]).T
        return np.asarray((gain[:, None] * z).reshape(12, -1))


@dataclass(frozen=True)
class NominalData:
    """Samples that are believed: x (N, 3 S) nT, total field (N,) nT with its mean unit, noise (3 S,) nT."""

    x: Array
    total_field: Array
    unit: float
    noise: Array
    reference_noise: float

    def at(self, rows: Array) -> Here:
        """Field and residuals at given parameters."""
        scaled = rows * (self.unit / self.noise)[:, None]
        basis, triangle = np.linalg.qr(scaled[:, :3] / self.unit)
        plane = CommonField(self.noise, basis, scaled[:, 3], len(self.x), float("nan"))
        matrix, offset = np.asarray(np.linalg.inv(triangle), dtype=np.float64), basis.T @ scaled[:, 3]
        y = plane.coordinates(self.x)
        seen = along(matrix, offset, y.T, self.total_field, self.reference_noise)
        field = (seen.unit * seen.length).T
        across = plane.residual(self.x)
        return Here(rows, plane, matrix, offset, field, seen.unit.T, across, seen.residual, seen.inverse_std)

    def basis(self, here: Here) -> Array:
        """(4, 4) T: the parameters of an output times T belong to series that have nothing in common.

        A field that hardly turns is nearly a constant, and of products of the two rounding leaves little.
        """
        return np.asarray(np.linalg.qr(self._seen(here), mode="r") / np.sqrt(len(here.field)))

    def _seen(self, here: Here) -> Array:
        """(N, 4): the field, and what an offset is multiplied by."""
        return np.column_stack([here.field / self.unit, np.ones(len(here.field))])

    def equations(self, here: Here, weights: tuple[float, float], basis: Array) -> tuple[Array, Array, Array]:
        """Scores (12 S,), their change with the parameters in a basis (12 S, 12 S), and their covariance.

        A residual times what the field of the neighbouring samples would make it: their noise is not in the residual.
        """
        across, inside = weights
        apart = np.asarray(np.linalg.inv(basis), dtype=np.float64)
        z: Array = apart.T @ self._seen(here).T
        towards = _neighbours(here.field)
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        other: Array = apart.T @ np.vstack([towards.T * (self.total_field / self.unit), np.ones(len(towards))])
        scale = self.unit / self.noise
        off = (np.eye(len(scale)) - here.plane.basis @ here.plane.basis.T) * np.outer(scale, scale)
        score = across * ((here.across * scale).T @ other.T).ravel()
        change = across * np.kron(off, other @ z.T)
        covariance = across * np.kron(off, other @ other.T)
        rows = np.vstack([here.inner(towards, other), here.inner(here.direction, z), here.along])
        sums = products_of(rows, 12, 0, rows.shape[1])
        into = np.kron(here.plane.basis.T * scale, np.eye(4))
        score = score + inside * into.T @ sums[:, 24]
        change = change + inside * into.T @ sums[:, 12:24] @ into
        covariance = covariance + inside * into.T @ sums[:, :12] @ into
        return np.asarray(score), np.asarray(change), np.asarray(covariance)

    def misfit(self, here: Here) -> tuple[Array | None, Array]:
        """Residual across (N, 3 S), None for one sensor, and along (N, 1), less what C and o could still explain."""
        z = np.column_stack([here.direction * (self.total_field / self.unit)[:, None], np.ones(len(here.field))])
        inside = least(here.along[:, None], here.inner(here.direction, z.T).T)
        return (least(here.across, z) if len(self.noise) > 3 else None), inside


def least(values: Array, columns: Array) -> Array:
    """Values (N, K) less what columns (N, M), of any rank, explain of them."""
    out: Array = values - columns @ np.linalg.lstsq(columns, values, rcond=1e-9)[0]
    return out


def _neighbours(field: Array) -> Array:
    """(N, 3) the mean of the samples before and after; the field (N, 3) itself where these lie elsewhere (postures)."""
    padded = np.concatenate([field[1:2], field, field[-2:-1]])
    out: Array = (padded[:-2] + padded[2:]) / 2.0
    far = np.mean((out - field) ** 2) > ELSEWHERE * np.mean((field - field.mean(axis=0)) ** 2)
    return field.copy() if far else out


def weights_of(data: NominalData, here: Here) -> tuple[float, float]:
    """How far samples are believed, across and along: one over what the misfit is beyond white noise."""
    across, inside = data.misfit(here)
    return 1.0 / _long_run(across) if across is not None else 1.0, 1.0 / _long_run(inside)


def _long_run(series: Array) -> float:
    """The largest variance that means over blocks have, times the length of the block: 1 for white noise, whatever
    correlation in time does to a mean for other series (N, K)."""
    n, k = series.shape
    worst = 1.0
    for blocks in (n, *BLOCKS):
        if blocks > n:
            continue
        edges = np.linspace(0, n, blocks, endpoint=False).round().astype(int)
        lengths = np.diff([*edges, n])
        sums = np.add.reduceat(series, edges, axis=0) / np.sqrt(lengths)[:, None]
        top = float(np.linalg.eigvalsh(sums.T @ sums / blocks)[-1])
        chance = (1.0 + np.sqrt(k / blocks)) ** 2  # edge of the spectrum of white noise (Marchenko and Pastur 1967)
        worst = max(worst, top / chance)
    return worst


def settled(data: NominalData, rows: Array, weights: tuple[float, float], std: Array) -> tuple[Here, Array, float]:
    """The parameters most probable for given weights, their covariance (12 S, 12 S), and the last step in its standard
    deviations.

    The scores are a linear function of the parameters with noise of known covariance: beside the prior the best linear
    estimate, and again from there.
    """
    nominal = np.tile(np.eye(3, 4), (len(rows) // 3, 1))
    here, size = data.at(rows), np.inf
    for _ in range(_STEPS):
        shown, said, away = _system(data, here, weights, std, nominal)
        left, known, right = np.linalg.svd(shown, full_matrices=False)
        moved = left.T @ said / known
        moved /= max(1.0, float(np.max(np.abs(right.T @ moved))) / _FARTHEST_STEP)
        here = data.at(nominal + ((away + right.T @ moved) * std).reshape(rows.shape))
        size = float(np.linalg.norm(known * moved))
        if size < CLOSE:
            break
    root_covariance = std[:, None] * right.T / known
    return here, np.asarray(root_covariance @ root_covariance.T), size


def settled_slowly(
    data: NominalData, rows: Array, weights: tuple[float, float], std: Array
) -> tuple[Here, Array, float]:
    """The same by damped steps, each of which makes the parameters more probable.

    Where sensors hardly turn, what the samples tell is a narrow valley that bends: of a step along it that is a tenth
    of the prior long, the bend makes thousands of standard deviations of a noise that is far smaller than the changes
    of the field, and the next step runs after these. There a sample's own field does as well as its neighbours', and
    the sum of squares is what has its least at the end.
    """
    nominal = np.tile(np.eye(3, 4), (len(rows) // 3, 1))
    here, size, damping = data.at(rows), 0.0, _DAMPING
    shown, said, away = _system(data, here, weights, std, nominal)
    before = _improbability(here, weights, away)
    for _ in range(_SLOW_STEPS):
        held = np.vstack([shown, damping * np.eye(shown.shape[1])])
        moved = np.linalg.lstsq(held, np.concatenate([said, np.zeros(shown.shape[1])]), rcond=None)[0]
        moved /= max(1.0, float(np.max(np.abs(moved))) / _FARTHEST_STEP)
        there = data.at(nominal + ((away + moved) * std).reshape(rows.shape))
        now = _improbability(there, weights, away + moved)
        if not now < before:
            damping *= _HARDER
            if damping > _HARDEST:
                break
            continue
        size = float(np.sqrt(before - now))
        here, before, damping = there, now, damping / _SOFTER
        shown, said, away = _system(data, here, weights, std, nominal)
        if size < CLOSE:
            break
    _, known, right = np.linalg.svd(shown, full_matrices=False)
    root_covariance = std[:, None] * right.T / known
    return here, np.asarray(root_covariance @ root_covariance.T), size


def _improbability(here: Here, weights: tuple[float, float], away: Array) -> float:
    """Twice the negative logarithm of the probability but for a constant."""
    across, inside = weights
    return across * float(np.sum(here.across**2)) + inside * float(np.sum(here.along**2)) + float(away @ away)


def _system(
    data: NominalData, here: Here, weights: tuple[float, float], std: Array, nominal: Array
) -> tuple[Array, Array, Array]:
    """What a step of the parameters (12 S) in standard deviations of the prior changes of the whitened scores and of
    the prior's own, what these say, and how far the parameters are from nominal."""
    basis = data.basis(here)
    into = np.kron(np.eye(len(here.rows)), basis) * std
    score, change, covariance = data.equations(here, weights, basis)
    away = (here.rows - nominal).ravel() / std
    root = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    with np.errstate(over="ignore", invalid="ignore"):
        correlation = covariance / np.outer(root, root)
    if not np.isfinite(correlation).all():
        raise NotEnoughData(DIVERGES, hint=HINT)
    values, vectors = np.linalg.eigh(correlation)
    real = values > ROUNDING * values[-1]
    whiten = vectors.T[real] / np.sqrt(values[real])[:, None] / root
    # no products of these: what the samples know beside the prior differs by fourteen orders of magnitude
    shown = np.vstack([whiten @ change @ into, np.eye(len(root))])
    said = np.concatenate([whiten @ score, -away])
    if not (np.isfinite(shown).all() and np.isfinite(said).all()):
        raise NotEnoughData(DIVERGES, hint=HINT)
    return shown, said, away
