"""The common rotation from one source or several, with its covariance, its ambiguities, and what stays free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magtensor.attitude import right_angled
from magtensor.calibration.rotation import angle_between, from_vector, to_vector
from magtensor.calibration.types import PARAMETERS_PER_SENSOR, Array, ArrayCalibration
from magtensor.errors import NotEnoughData

from .calibration_errors import CalibrationErrors, tilt
from .sources import Slope, Source

WORST = float(np.radians(2.0))  # rad, standard deviation about any axis: 3 % of a tensor
_SAME = 1e-3  # chance that the true rotation fits as much worse than the best as one that is still considered
_ROUGH, _SETTLED = 1e-3, 1e-9  # rad, last step of a search and of the result
_STEPS = 100
_APART = float(np.radians(5.0))  # minima nearer to each other are one
_NOTHING = 1e-12  # of the information about the best known axis: rounding, and no information


@dataclass(frozen=True)
class CommonRotation:
    """The rotation P (3, 3) of b_platform = P b.

    Attributes:
        rotation: (3, 3).
        covariance: (3, 3) rad^2 of what turns the new frame against the platform, errors of the calibration included.
        scatter: (3, 3) rad^2, the part of it that the survey's noise causes.
        response: (3, R) rad, per unit of each independent error of the calibration.
        sources: names of what determined it; shares: of each, its part of the information, in sum 1.
        spreads: of each, see `Source`.
        alternatives: rotation vectors (rad, platform frame) to others that fit as well, farther from the prior frame.
    """

    rotation: Array
    covariance: Array
    scatter: Array
    response: Array
    sources: tuple[str, ...]
    shares: tuple[float, ...]
    spreads: tuple[float, ...]
    alternatives: tuple[Array, ...] = ()

    @property
    def vector(self) -> Array:
        """(3,) rad, of the rotation."""
        return to_vector(self.rotation)

    @property
    def angle(self) -> float:
        """rad."""
        return float(np.linalg.norm(self.vector))

    @property
    def std(self) -> Array:
        """(3,) rad about the platform's axes."""
        out: Array = np.sqrt(np.diag(self.covariance))
        return out

    @property
    def significance(self) -> float:
        """P value of no rotation at all."""
        from scipy.special import chdtrc

        return float(chdtrc(3, self.vector @ np.linalg.solve(self.covariance, self.vector)))


def common_rotation(sources: Sequence[Source], errors: CalibrationErrors, *, worst: float = WORST) -> CommonRotation:
    """Find the rotation into the platform's frame that all sources together determine.

    The minimum is sought from all right-angled turns of the prior frame (that of the calibration). Of minima that the
    data do not tell apart, the one nearest to the prior frame is taken and the others are reported.

    Parameters
    ----------
    sources: at least one; each weighs what its own noise, found from what it leaves, makes it worth.
    errors: of the calibration; every source's response refers to them.
    worst: rad, accepted standard deviation about any axis.

    Raises
    ------
    NotEnoughData: some rotation stays free; the message says about which axis, and why.
    """
    from scipy.special import chdtri

    spreads = [s.spread(np.eye(3)) for s in sources]
    starts = right_angled()
    minima: list[tuple[float, Array]] = []
    for _ in range(2):
        minima = _minima(sources, spreads, starts)
        spreads = [s.spread(minima[0][1]) for s in sources]
        starts = [p for _, p in minima]
    limit = 0.5 * float(chdtri(3, _SAME))
    minima = _minima(sources, spreads, starts, _SETTLED)
    close = sorted((p for c, p in minima if c - minima[0][0] <= limit), key=lambda p: angle_between(np.eye(3), p))
    spreads = [s.spread(close[0]) for s in sources]
    best, _ = _descended(sources, spreads, close[0], _SETTLED)
    slopes = [s.slope(best, spread) for s, spread in zip(sources, spreads, strict=True)]
    total = _sum(slopes)
    scatter, response = _uncertainty(total)
    left = response + best @ errors.common  # what a source does not correct of the calibration's own rotation
    covariance = scatter + left @ left.T
    _require_determined(sources, total, covariance, worst)
    return CommonRotation(
        best,
        covariance,
        scatter,
        response,
        tuple(s.name for s in sources),
        _shares(slopes, total),
        tuple(spreads),
        tuple(to_vector(p @ best.T) for p in close[1:] if angle_between(best, p) > _APART),
    )


def carried(
    calibration: ArrayCalibration, errors: CalibrationErrors, found: CommonRotation, frame: str
) -> ArrayCalibration:
    """The calibration turned into the platform's frame, the rotation's uncertainty in its covariance.

    Parameters
    ----------
    errors: of this calibration, as `common_rotation` was given them.
    frame: its new name.
    """
    turned = np.einsum("ij,sjk->sik", found.rotation, calibration.matrix)
    each = errors.root.reshape(len(turned), PARAMETERS_PER_SENSOR, -1).copy()
    matrices = each[:, :9].reshape(len(turned), 3, 3, -1)
    each[:, :9] = np.einsum("ij,sjkr->sikr", found.rotation, matrices).reshape(len(turned), 9, -1)
    moved = tilt(turned)
    root = each.reshape(errors.root.shape) + moved @ found.response
    covariance = root @ root.T + moved @ found.scatter @ moved.T
    if not np.isfinite(calibration.covariance).all():
        covariance = np.full_like(calibration.covariance, np.nan)
    return replace(calibration, matrix=turned, covariance=covariance, frame=frame)


def in_words(vector: Array) -> str:
    """A rotation vector as `28.3 deg about (0.1, 0.2, 0.97)`, or about z where it is an axis."""
    angle = float(np.linalg.norm(vector))
    return f"{np.degrees(angle):.3g} deg about {axis_in_words(vector / angle if angle else np.array([0.0, 0, 1]))}"


def axis_in_words(direction: Array) -> str:
    """`z`, `-z`, or `(0.1, 0.2, 0.97)`."""
    k = int(np.argmax(np.abs(direction)))
    if abs(direction[k]) > np.cos(np.radians(3.0)):
        return f"{'-' if direction[k] < 0 else ''}{'xyz'[k]}"
    return f"({', '.join(f'{v:.2f}' for v in direction)})"


def _sum(slopes: Sequence[Slope]) -> Slope:
    parts = (
        np.sum([getattr(s, name) for s in slopes], axis=0)
        for name in ("gradient", "information", "scatter", "step", "response")
    )
    return Slope(*parts)


def _descended(
    sources: Sequence[Source], spreads: Sequence[float], start: Array, settled: float
) -> tuple[Array, float]:
    """The minimum that damped Newton steps reach, and its cost."""

    def cost(at: Array) -> float:
        return sum(s.cost(at, spread) for s, spread in zip(sources, spreads, strict=True))

    here, value, damping = start, cost(start), 1e-9
    for _ in range(_STEPS):
        slope = _sum([s.slope(here, spread) for s, spread in zip(sources, spreads, strict=True)])
        values, vectors = np.linalg.eigh(slope.step)
        values = np.abs(values)  # far from a minimum a curvature may be negative
        size = max(float(values.max()), 1e-300)
        for _ in range(30):
            step: Array = -vectors @ ((vectors.T @ slope.gradient) / (values + damping * size))
            there = from_vector(step) @ here
            after = cost(there)
            if after <= value or np.linalg.norm(step) < settled:
                break
            damping = max(10 * damping, 1e-6)
        here, value, damping = there, after, damping / 10
        if np.linalg.norm(step) < settled:
            break
    u, _, vt = np.linalg.svd(here)  # products of many rotations stay rotations
    return np.asarray(u @ vt), value


def _minima(
    sources: Sequence[Source], spreads: Sequence[float], starts: Sequence[Array], settled: float = _ROUGH
) -> list[tuple[float, Array]]:
    """Different minima that the starts lead to, best first."""
    reached = [_descended(sources, spreads, start, settled) for start in starts]
    found: list[tuple[float, Array]] = []
    for rotation, value in sorted(reached, key=lambda r: r[1]):
        if all(angle_between(rotation, other) > _APART for _, other in found):
            found.append((value, rotation))
    return found


def _known(total: Slope) -> tuple[Array, Array]:
    """The information (3,) about three axes, least first, zero where rounding alone makes it, and the axes (3, 3)."""
    values, vectors = np.linalg.eigh(total.information)
    return np.where(values > _NOTHING * values[-1], values, 0.0), vectors


def _uncertainty(total: Slope) -> tuple[Array, Array]:
    """Covariance by the survey's noise, and the response to the calibration's errors; inf where a direction is free."""
    values, vectors = _known(total)
    if values[0] == 0:
        return np.full((3, 3), np.inf), np.zeros_like(total.response)
    inverse = (vectors / values) @ vectors.T
    return inverse @ total.scatter @ inverse, -inverse @ total.response


def _require_determined(sources: Sequence[Source], total: Slope, covariance: Array, worst: float) -> None:
    values, vectors = _known(total)
    std = np.full(3, np.inf)
    if values[0] > 0:
        std = np.sqrt(np.einsum("ik,ij,jk->k", vectors, covariance, vectors))
    else:
        seen = values > 0
        std[seen] = np.sqrt(np.einsum("ik,ij,jk->k", vectors, total.scatter, vectors)[seen]) / values[seen]
    free = std > worst
    if not free.any():
        return
    directions = vectors.T[free]
    largest = np.argmax(np.abs(directions), axis=1)
    directions = directions * np.sign(directions[np.arange(len(directions)), largest])[:, None]
    if free.all():
        about = f"the common rotation is not determined to {np.degrees(worst):.3g} deg about any axis"
    else:
        names = " and ".join(axis_in_words(d) for d in directions)
        known = [f"{np.degrees(s):.2g} deg" if np.isfinite(s) and s < 1 else "more than 1 rad" for s in std[free]]
        about = (
            f"the common rotation is not determined to {np.degrees(worst):.3g} deg about {names} of the platform "
            f"(standard deviation {' and '.join(known)})"
        )
    raise NotEnoughData(about, hint="; ".join(s.free_because(directions) for s in sources))


def _shares(slopes: Sequence[Slope], total: Slope) -> tuple[float, ...]:
    each = [float(np.trace(np.linalg.solve(total.information, s.information))) / 3 for s in slopes]
    return tuple(each)
