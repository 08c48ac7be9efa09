"""What a survey began with and a calibration cannot know: the phase of a tone, and the state of a response that lags.

Both are found from the survey's own outputs, in what neither a uniform field nor a gradient can make of them, so that
nothing a survey may be looking for is taken for an error of the instrument.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.by_sensor import by_sensor
from magtensor.calibration.types import Array, ArrayCalibration
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import Beginning, profiled
from magtensor.loop.correcting.filled import filled
from magtensor.loop.fitting.model import Adopted, Record
from magtensor.loop.fitting.seen import over_disturbances, spread
from magtensor.tensor.geometry import array_design

TONE = "periodic_interference"
WARM_UP = "warm_up"  # begins with every survey, warmer in one than in another
LEAST_CONTRAST = 1e-4  # of an effect's own power, between the sensors
SIGNIFICANT = 4.0  # standard deviations, of what is found on another survey
ROUNDING = 1e-6  # nT: a course no larger is none
THE_SAME = 0.1  # of an offset, by which another may differ from it: of three components one in a thousand is as near
LEAST_PARTS = 8  # of the survey, whose means tell how large slow noise is


def as_begun_here(
    record: Record,
    calibration: ArrayCalibration,
    own: Sequence[tuple[Adopted, Array]],
    good: NDArray[np.bool_] | None = None,
) -> list[tuple[Adopted, Array]]:
    """Effects with their coefficients, as they are on a survey that began otherwise than the calibration's.

    Parameters
    ----------
    good: (N,) samples that may be believed; all that there are if None.
    """

    def of_a_tone(model: Adopted, theta: Array) -> Array:
        here = tone_here(record, calibration, model, theta, good, own)
        return np.zeros_like(theta) if here is None else here

    begun = [(a, of_a_tone(a, t) if a.name == TONE else t) for a, t in own]
    begun = [
        (a, _warmth_here(record, calibration, begun, i, good) if a.name == WARM_UP else t)
        for i, (a, t) in enumerate(begun)
    ]
    for number, (model, theta) in enumerate(begun):
        names = unknown(model)
        if names:
            state = _state_here(record, calibration, begun, number, names, good)
            begun[number] = replace(model, settings={**model.settings, **state}), theta
    return begun


def unknown(model: Adopted) -> list[str]:
    """The settings that say what a model began with, if that is not known; else none."""
    grids = profiled(model.component).items()
    return [n for n, g in grids if isinstance(g, Beginning) and np.isnan(model.settings.get(n, 0.0))]


@dataclass(frozen=True)
class _Contrast:
    """What neither a uniform field nor a gradient can make of outputs; with fewer than four sensors, or positions that
    are not known, their differences."""

    calibration: ArrayCalibration
    free: Array
    usable: NDArray[np.bool_]

    @classmethod
    def of(cls, record: Record, calibration: ArrayCalibration, good: NDArray[np.bool_] | None = None) -> _Contrast:
        sensors = record.raw.shape[1]
        held = np.tile(np.eye(3), (sensors, 1))
        if record.position is not None and sensors > 3:
            held = array_design(record.position, "gradient")
        free = np.eye(3 * sensors) - held @ np.linalg.pinv(held, rcond=1e-9)
        usable = np.isfinite(record.raw).all(axis=(1, 2))
        return cls(calibration, free, np.asarray(usable if good is None else usable & good))

    def __call__(self, outputs: Array) -> Array:
        """(n, 3 S) of outputs (N, S, 3), at the usable samples."""
        b = by_sensor(self.calibration.matrix, outputs)[self.usable]
        out: Array = b.reshape(len(b), -1) @ self.free
        return out


def tone_here(
    record: Record,
    calibration: ArrayCalibration,
    model: Adopted,
    theta: Array,
    good: NDArray[np.bool_] | None,
    own: Sequence[tuple[Adopted, Array]],
) -> Array | None:
    """Coefficients of a tone with the phase and strength it has on this survey; what one survey began with is another's
    accident.

    Found by least squares over the tone as it was and a quarter of a turn later, in what neither a uniform field nor a
    gradient can make of the outputs (with fewer than four sensors: in their differences). None where these do not show
    it: of a single sensor, and of a tone that all sensors see alike.

    Parameters
    ----------
    record: its outputs at their time; own: the effects in these, without which the tone is sought, but for tones.
    """
    contrast = _Contrast.of(record, calibration, good)
    raw = np.nan_to_num(record.raw)
    terms = model.terms(record.excitation(raw, raw))
    half = len(theta) // 2  # cosines first, then sines
    later = np.concatenate([theta[half:], -theta[:half]])
    size = raw[0].size
    each = [contrast(terms.contribution(t, size).reshape(raw.shape)) for t in (theta, later)]
    both = np.column_stack([course.ravel() for course in each])
    if np.sum(both**2) <= LEAST_CONTRAST * contrast.usable.sum() * float(theta @ theta):
        return None
    strengths = np.linalg.svd(both.T @ both, compute_uv=False)
    still = all(np.sum((course - course.mean(axis=0)) ** 2) < LEAST_CONTRAST * strengths[0] for course in each)
    if still:  # a tone that the sampling shows as a constant has no phase
        return theta
    left = Here.of(record, calibration, good).left([(a, t) for a, t in own if a.name != TONE])
    found = (left - left.mean(axis=0)).ravel()  # whatever the offsets are
    both = np.column_stack([(course - course.mean(axis=0)).ravel() for course in each])
    parts = np.linalg.lstsq(both, found, rcond=LEAST_CONTRAST)[0]
    noise = float(np.mean((found - both @ parts) ** 2))
    scatter = noise * np.linalg.pinv(both.T @ both, rcond=LEAST_CONTRAST, hermitian=True)
    if SIGNIFICANT**2 * np.diagonal(scatter).max() > min(1.0, float(parts @ parts)):  # of its strength
        return None
    out: Array = parts[0] * theta + parts[1] * later
    return out


def _warmth_here(
    record: Record,
    calibration: ArrayCalibration,
    own: Sequence[tuple[Adopted, Array]],
    number: int,
    good: NDArray[np.bool_] | None,
) -> Array:
    """Coefficients of a warming up as far as it had come when this survey began: the same course, in another strength.

    None is left of what was switched on long before. By what the outputs show of the course whatever the offsets are;
    where that is not known from noise, it is as it was.
    """
    model, theta = own[number]
    if not shows_a_state(record.raw, record.position is not None):
        return theta
    here = Here.of(record, calibration, good)
    left, course = here.left(own), here.added(model, theta)
    if not len(left):
        return theta
    part, known = seen_in(left, course)
    return max(1.0 + part, 0.0) * theta if known else theta


def shows_a_state(raw: Array, positions_known: bool) -> bool:
    """Whether outputs (N, S, 3) can show what a lagged response began with, a gradient of the field apart."""
    return positions_known and raw.shape[1] > 3


def _state_here(
    record: Record,
    calibration: ArrayCalibration,
    own: Sequence[tuple[Adopted, Array]],
    number: int,
    names: Sequence[str],
    good: NDArray[np.bool_] | None,
) -> dict[str, float]:
    """What the lagged response of one of the effects was out of equilibrium by when the survey began: settings.

    It dies away with the lag, along vectors that are known: a number, or the components of a vector, found by least
    squares beside a constant, and 0 where slow noise could be it. A vector is no larger than fields there are: noise
    would make far more of a component that is nearly the same to all sensors. With fewer than four sensors, or
    positions that are not known, nothing tells it from a field that changes, and it is taken for 0.
    """
    from scipy.special import chdtrc, chdtri

    none = dict.fromkeys(names, 0.0)
    if not shows_a_state(record.raw, record.position is not None):
        return none
    here = Here.of(record, calibration, good)
    model, theta = own[number]
    left = here.left(own)
    rest = here.added(model, theta)
    units = [replace(model, settings={**model.settings, **none, name: 1.0}) for name in names]
    courses = np.stack([here.added(unit, theta) - rest for unit in units], axis=-1)
    if not len(left) or float(np.sum(courses**2)) <= 0.0:
        return none
    left, courses = left - left.mean(axis=0), courses - courses.mean(axis=0)
    state = np.linalg.lstsq(courses.reshape(-1, len(names)), left.ravel(), rcond=1e-6)[0]
    course = courses @ state
    if len(names) == 3:  # a vector: what was magnetised in the Earth's field differs from it by one as large
        size = float(np.median(np.linalg.norm(here.excitation.field, axis=2)))
        held = float(np.var(left - course)) / size**2
        normal = np.einsum("nki,nkj->ij", courses, courses) + held * np.eye(3)
        state = np.linalg.solve(normal, np.einsum("nki,nk->i", courses, left))
        course = courses @ state
    grid = next(g for n, g in profiled(model.component).items() if n == names[0])
    parts = max(int(np.ptp(record.time) / float(model.settings[grid.lag])), LEAST_PARTS)
    least = float(chdtri(len(names), chdtrc(1, SIGNIFICANT**2)))
    known = np.sum(course**2) > least * _variance(left - course, course, parts)
    return dict(zip(names, map(float, state), strict=True)) if known else none


@dataclass(frozen=True)
class Here:
    """What effects add to the outputs of a survey, and what is left of these without them, both as contrasts."""

    record: Record
    calibration: ArrayCalibration
    contrast: _Contrast
    excitation: Excitation

    @classmethod
    def of(cls, record: Record, calibration: ArrayCalibration, good: NDArray[np.bool_] | None = None) -> Here:
        contrast = _Contrast.of(record, calibration, good)
        b = filled(record.believed(calibration.apply(record.raw)), contrast.usable)
        b = over_disturbances(b, contrast.usable, record.time, record.run, spread(b))
        forward = np.asarray(np.linalg.inv(calibration.matrix), dtype=float)
        x = record.excitation(by_sensor(forward, b) + calibration.offset, b, matrix=forward)
        return cls(record, calibration, contrast, x)

    def added(self, effect: Adopted, theta: Array) -> Array:
        """(n, 3 S) nT."""
        raw = self.record.raw
        return self.contrast(effect.terms(self.excitation).contribution(theta, raw[0].size).reshape(raw.shape))

    def left(self, own: Sequence[tuple[Adopted, Array]]) -> Array:
        """(n, 3 S) nT without effects; what began unknown began in equilibrium."""
        left = self.contrast(self.record.raw - self.calibration.offset)
        for effect in own:
            left = left - self.added(*effect)
        return left


def _variance(noise: Array, course: Array, parts: int) -> float:
    """nT^2, of noise (n, 3 S) along the vectors of a course (n, 3 S), of its own colour: means over parts of the survey
    tell more of it than single samples do."""
    along = noise @ np.linalg.svd(course, full_matrices=False)[2][0]
    means = np.array([part.mean() for part in np.array_split(along, min(parts, len(along)))])
    return max(float(np.var(along)), float(np.var(means)) * len(along) / len(means))


def seen_in(left: Array, course: Array) -> tuple[float, bool]:
    """How much of a course (n, 3 S) there is in what is left, whatever the offsets are, and whether noise is less."""
    left, course = left - left.mean(axis=0), course - course.mean(axis=0)
    power = float(np.sum(course**2))
    if power <= ROUNDING**2 * course.size:
        return 0.0, False
    part = float(np.sum(left * course)) / power
    variance = _variance(left - part * course, course, LEAST_PARTS)
    return part, part**2 * power > SIGNIFICANT**2 * variance


def as_other_offsets(left: Array, course: Array) -> bool:
    """Whether what is left (n, 3 S) has the mean of a course that is constant on this survey, in direction and size: no
    other change of the offsets would, but by chance."""
    mean, like = left.mean(axis=0), course.mean(axis=0)
    size = float(np.linalg.norm(like))
    if size <= ROUNDING or float(np.sum((course - like) ** 2)) > LEAST_CONTRAST * len(course) * size**2:
        return False
    parts = np.array([part.mean(axis=0) for part in np.array_split(left, min(LEAST_PARTS, len(left)))])
    noise = float(np.sqrt(np.sum(np.var(parts, axis=0)) / len(parts)))
    return float(np.linalg.norm(mean - like)) < THE_SAME * size and noise < THE_SAME * size
