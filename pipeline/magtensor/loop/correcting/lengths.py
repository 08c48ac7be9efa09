"""What a survey's own lengths |b| say of the effects that a calibration takes off it.

The sensors' differences show most effects and are looked at elsewhere. Rows that are averages they cannot show: all
sensors are averaged alike, and a mean is shorter than what it is made of, by an amount that goes with the square of the
rate of turning. And whatever was fitted to one survey may not carry over to another, which |b| - F shows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array, ArrayCalibration
from magtensor.loop.correcting.another_survey import LEAST_PARTS, SIGNIFICANT
from magtensor.loop.correcting.correction import corrected_raw
from magtensor.loop.fitting.model import Adopted, Record

AVERAGING = "averaging"
FURTHER = 1.01  # times as far from the total field as without an effect, which is then said to be none of the survey's
HALF = 0.5  # of what the effect takes off the lengths: below it the survey is nearer to having none


def refuted(
    name: str,
    record: Record,
    calibration: ArrayCalibration,
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    good: NDArray[np.bool_],
) -> bool:
    """Whether the lengths of a survey's outputs refute an effect of a calibration.

    A survey whose lengths cannot tell has what the calibration's has: for `averaging` one that turns too slowly, or
    crosses too strong a field.

    Parameters
    ----------
    name: of the effect.
    record: all samples of the survey, channels with the calibration's origins taken off, the total field without the
        base station's errors.
    adopted: the effects; theta: their coefficients; good: (N,) the samples that count.
    """
    b = calibration.apply(corrected_raw(record, calibration, adopted, theta, good))
    numbers = [i for i, a in enumerate(adopted) if a.name == name]
    return any(_refuted(record, calibration, adopted, theta, good, i, b) for i in numbers)


def contradicted(
    record: Record,
    calibration: ArrayCalibration,
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    good: NDArray[np.bool_],
    b: Array,
) -> list[str]:
    """The instrument's effects without which |b| would be nearer to the total field of a survey: they do not carry over
    to it.

    Parameters
    ----------
    b: (N, S, 3) nT, with all effects taken off; the others as for `refuted`.
    """
    own = [i for i, a in enumerate(adopted) if a.component.effect == "instrument"]
    return [adopted[i].name for i in own if _refuted(record, calibration, adopted, theta, good, i, b)]


def _refuted(
    record: Record,
    calibration: ArrayCalibration,
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    good: NDArray[np.bool_],
    number: int,
    b: Array,
) -> bool:
    """Whether less than half of what one effect takes off the lengths is there.

    It is sought in |b| - F without it (in |b| where the survey has no total field), beside a constant of each sensor,
    and counts where it is missing by four standard deviations of what else moves |b|.
    """
    others = [i for i in range(len(adopted)) if i != number]
    without = corrected_raw(record, calibration, [adopted[i] for i in others], [theta[i] for i in others], good)
    lengths = np.linalg.norm(calibration.apply(without), axis=2)
    course = np.linalg.norm(b, axis=2) - lengths
    left = lengths if record.total_field is None else lengths - record.total_field[:, None]
    use = good & np.isfinite(left).all(axis=1) & np.isfinite(course).all(axis=1)
    if not use.any():
        return False
    left, course = left[use], course[use]
    left, course = left - left.mean(axis=0), course - course.mean(axis=0)
    power = float(np.sum(course**2))
    if power <= 0.0:
        return False
    # a delay does next to nothing to a length, and what it does is the noise of the rate that it is made of
    if record.total_field is not None and np.sum((left + course) ** 2) < FURTHER**2 * np.sum(left**2):
        return False
    there = -float(np.sum(left * course)) / power
    products = np.sum((left + there * course) * course, axis=1)  # sums over sensors: what moves all counts once
    sums = np.array([part.sum() for part in np.array_split(products, min(LEAST_PARTS, len(products)))])
    variance = max(float(np.sum(products**2)), float(np.sum(sums**2))) / power**2
    return there < HALF and (1.0 - there) ** 2 > SIGNIFICANT**2 * variance
