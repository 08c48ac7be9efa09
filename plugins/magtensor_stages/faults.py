"""What the stage `load` refuses of the sensors' readings."""

from __future__ import annotations

import numpy as np

from magtensor.errors import DataError
from magtensor.survey import checks, repeated
from magtensor.survey.model import AXES, Survey


def refuse_faults(survey: Survey, magnitude: bool, copied_axes: bool, copied_rows: bool, where: str) -> None:
    """Raise for what cannot be believed of the sensors.

    Parameters
    ----------
    magnitude, copied_axes, copied_rows: whether these are refused.
    where: in the message.

    Raises:
        DataError: an axis without signal, a sensor that is stuck, a magnitude that betrays wrong units, numbers that
            are there twice.
    """
    field = survey.values("b_raw")
    names = survey.sensors
    for s, name in enumerate(names):
        here = f"{where}: sensor {name}"
        for a, axis in enumerate(AXES):
            if not np.isfinite(field[:, s, a]).any():
                raise DataError(f"axis {axis} holds no number at all", where=here)
        spread = np.nanmax(np.where(np.isfinite(field[:, s]), field[:, s], -np.inf), axis=0) - np.nanmin(
            np.where(np.isfinite(field[:, s]), field[:, s], np.inf), axis=0
        )
        if (spread == 0).all():
            raise DataError(
                "the sensor is stuck: all its samples are the same", where=here,
                hint="`load: {sensors: [...]}` can leave the sensor out",
            )  # fmt: skip
        for a in checks.dead_axes(field[:, s]):
            raise DataError(
                f"axis {AXES[a]} is dead: it is {field[:, s, a][np.isfinite(field[:, s, a])][0]:g} nT in every sample",
                where=here,
                hint="`load: {sensors: [...]}` can leave the sensor out",
            )
    if magnitude:
        _refuse_magnitude(survey, where)
    if copied_axes:
        for s, a, other, b in checks.copies(field):
            raise DataError(
                f"{names[s]} {AXES[a]} and {names[other]} {AXES[b]} hold the same numbers in every sample",
                where=f"{where}: b_raw",
                hint="is one column mapped twice? `load: {copied_axes: accept}` lets it pass",
            )
    if copied_rows and (twice := repeated.written_twice(field)) is not None:
        first, again, count = twice
        raise DataError(
            f"samples {again + 1} to {again + count} hold the same readings as samples {first + 1} to {first + count}",
            where=f"{where}: b_raw",
            hint="was a file or a buffer written twice? `load: {window_s: [...]}` leaves one of them out, "
            "`load: {copied_rows: accept}` lets it pass",
        )
    for s, a in checks.deaf_axes(field):
        raise DataError(
            f"axis {AXES[a]} is dead: it varies a hundred times less than any direction of the other sensors",
            where=f"{where}: sensor {names[s]}",
            hint="`load: {sensors: [...]}` can leave the sensor out",
        )


def _refuse_magnitude(survey: Survey, where: str) -> None:
    accept = "`load: {magnitude: accept}` lets it pass"
    medians = np.nanmedian(np.linalg.norm(survey.values("b_raw"), axis=2), axis=0)
    for name, median in zip(survey.sensors, medians, strict=True):
        suspicion = checks.unit_suspicion(float(median))
        if suspicion:
            hint = f"are its units right, and base values or offsets added? {accept}"
            raise DataError(suspicion, where=f"{where}: sensor {name}", hint=hint)
    if "reference/total_field" in survey:
        reference = float(np.nanmedian(survey.values("reference/total_field")))
        suspicion = checks.unit_suspicion(reference)
        if suspicion:
            raise DataError(suspicion, where=f"{where}: reference/total_field", hint=f"are its units right? {accept}")
        for name, median in zip(survey.sensors, medians, strict=True):
            if not 1 / checks.MARGIN <= median / reference <= checks.MARGIN:
                raise DataError(
                    f"the median magnitude is {median:.6g} nT, that of the reference {reference:.6g} nT",
                    where=f"{where}: sensor {name}",
                    hint=f"are the scale, the offset and the reference those of this survey? {accept}",
                )
