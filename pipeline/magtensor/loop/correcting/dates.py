"""From when the times of what drifts or happens count on another survey.

The survey's own outputs say, in what neither a uniform field nor a gradient can make of them: nothing that it may be
looking for is taken for an error of the instrument. Where its sensors are too few for that, and of the errors of a base
station, the lengths of their vectors beside the total field say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.by_sensor import by_sensor
from magtensor.calibration.types import Array, ArrayCalibration
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import Duration, EventTimes, profiled
from magtensor.loop.correcting.another_survey import Here, as_other_offsets, seen_in, shows_a_state
from magtensor.loop.correcting.filled import filled
from magtensor.loop.fitting.model import Adopted, Record

ANEW = 0.5  # of the difference between another start and the known one
LONG = 1e11  # s, longer than any two surveys are apart


def as_dated_here(
    record: Record,
    calibration: ArrayCalibration,
    own: Sequence[tuple[Adopted, Array]],
    dated: Sequence[int],
    good: NDArray[np.bool_],
) -> dict[int, Adopted]:
    """Effects that are known to go with the time since the survey of the calibration began, as this survey shows them:
    those of which it says something else.

    What the survey says comes before the dates: a drift of what is switched on with the survey and a jump at the same
    time of each begin anew, a jump was mended or has not happened yet, or the clock was never set. That has to be
    nearer to what is measured, and its course to be seen there whatever the offsets are, which differ from survey to
    survey; or they differ by just what a jump was, as if it were not there. A steady drift that goes on has the course
    of one that begins anew too, and is elsewhere. What is clearest comes first: beside it the others may be seen that
    happened at one moment with it.

    Parameters
    ----------
    own: the effects of instrument and reference with their coefficients, `dated` those that are asked about.
    good: (N,) the samples whose lengths count.
    """
    own, found = list(own), dict[int, Adopted]()
    shown = {i: _shown(record, calibration, own[i][0], good) for i in dated if own[i][0].start is not None}
    places = {i: here for i, here in shown.items() if here is not None}
    while places:
        each = {i: _nearest(record, own, i, here) for i, here in places.items()}
        clearest = max(each, key=lambda i: each[i][1])
        if each[clearest][1] <= 0.0:
            break
        found[clearest] = each[clearest][0]
        own[clearest] = found[clearest], own[clearest][1]
        del places[clearest]
    return found


def _nearest(
    record: Record, own: Sequence[tuple[Adopted, Array]], number: int, here: Here | _Lengths
) -> tuple[Adopted, float]:
    """An effect with the start that is nearest to what is measured, and by how much of the sum of squares, nT^2, it is
    nearer than the known one: 0 where that stays."""
    model, theta = own[number]
    dated, left = here.added(model, theta), here.left(own)
    nearest, most = model, 0.0
    for other in _otherwise(model, record):
        course = here.added(other, theta) - dated
        nearer = 2.0 * float(np.sum(left * course)) - float(np.sum(course**2))
        part, known = seen_in(left, course)
        if nearer > most and ((part > ANEW and known) or (isinstance(here, Here) and as_other_offsets(left, course))):
            nearest, most = other, nearer
    return nearest, most


def _shown(
    record: Record, calibration: ArrayCalibration, model: Adopted, good: NDArray[np.bool_]
) -> Here | _Lengths | None:
    """Where an effect shows on a survey; None where it does not."""
    if model.component.effect == "instrument" and shows_a_state(record.raw, record.position is not None):
        return Here.of(record, calibration)
    if record.total_field is None:
        return None
    lengths = _Lengths.of(record, calibration, record.total_field, good)
    return lengths if len(lengths.use) else None


@dataclass(frozen=True)
class _Lengths:
    """|b| - F of a survey, and what effects add to it, whatever the offsets of the sensors and of the base station are.

    Attributes:
        total_field: (N,) nT, as read.
        use: (n,) samples that count.
        direction: (n, S, 3) of the field at each sensor.
        offsets: (n, 4) of each sensor, a basis of what its offsets and one of the base station can make of it.
    """

    record: Record
    calibration: ArrayCalibration
    excitation: Excitation
    total_field: Array
    use: NDArray[np.int_]
    direction: Array
    offsets: list[Array]

    @classmethod
    def of(cls, record: Record, calibration: ArrayCalibration, total_field: Array, good: NDArray[np.bool_]) -> _Lengths:
        usable = np.asarray(np.isfinite(record.raw).all(axis=(1, 2)))
        b = filled(record.believed(calibration.apply(record.raw)), good)
        forward = np.asarray(np.linalg.inv(calibration.matrix), dtype=float)
        x = record.excitation(by_sensor(forward, b) + calibration.offset, b, matrix=forward)
        use = np.flatnonzero(usable & good & np.isfinite(total_field))
        direction = b[use] / np.linalg.norm(b[use], axis=2, keepdims=True)
        offsets = [np.linalg.qr(np.column_stack([np.ones(len(use)), u]))[0] for u in direction.transpose(1, 0, 2)]
        return cls(record, calibration, x, total_field, use, direction, offsets)

    def added(self, effect: Adopted, theta: Array) -> Array:
        """(n, S) nT."""
        raw, reference = self._adds(effect, theta)
        along = np.einsum("nsi,nsi->ns", self.direction, by_sensor(self.calibration.matrix, raw[self.use]))
        return self._beside_offsets(along - reference[self.use, None])

    def left(self, own: Sequence[tuple[Adopted, Array]]) -> Array:
        """(n, S) nT without effects."""
        raw, field = self.record.raw, self.total_field
        for effect in own:
            more, reference = self._adds(*effect)
            raw, field = raw - more, field - reference
        lengths = np.linalg.norm(self.calibration.apply(raw[self.use]), axis=2)
        return self._beside_offsets(lengths - field[self.use, None])

    def _adds(self, effect: Adopted, theta: Array) -> tuple[Array, Array]:
        """What an effect adds to the outputs (N, S, 3) and to the total field (N,), nT."""
        terms, shape = effect.terms(self.excitation), self.record.raw.shape
        return terms.contribution(theta, shape[1] * shape[2]).reshape(shape), terms.on_reference(theta)

    def _beside_offsets(self, lengths: Array) -> Array:
        each = zip(lengths.T, self.offsets, strict=True)
        return np.column_stack([series - basis @ (basis.T @ series) for series, basis in each])


def _otherwise(model: Adopted, record: Record) -> list[Adopted]:
    """An effect that begins anew with a survey, one that happened before it, and one that has not yet.

    A slip of a recorder, which ends with the survey as a rule, goes on where it was before.
    """
    marks = profiled(model.component).items()
    lasts = [name for name, mark in marks if isinstance(mark, Duration)]
    slips = lasts and any(isinstance(mark, EventTimes) for _, mark in marks)
    goes_on = dict.fromkeys(lasts, 3.0 * LONG) if slips else {}
    before = replace(model, start=float(record.time[0]) - LONG, settings={**model.settings, **goes_on})
    return [replace(model, start=None), before, replace(model, start=float(record.time[-1]) + LONG)]
