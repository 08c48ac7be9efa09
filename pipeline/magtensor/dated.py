"""Between calibrations that change with the date and a survey's variables: one place that stores them, and brings a
stored one to the date of a survey."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import numpy as np

from magtensor.calibrated import MATRIX_ENTRIES, OFFSET_ENTRIES
from magtensor.calibration.surveys.dated import Change, Dated
from magtensor.calibration.types import ArrayCalibration
from magtensor.errors import DataError
from magtensor.survey.model import AXES, Survey, Variable
from magtensor.survey.times import parse_instant, split_since

RATE = "calibration/rate"
YEAR = timedelta(days=365.25)
_NO_DATE = datetime(1971, 1, 1, tzinfo=UTC)  # clocks that count from their own start say 1970


def date_of(survey: Survey) -> datetime:
    """The date of a survey's first sample, to the second.

    Raises:
        DataError: its clock does not tell the date.
    """
    where = str(survey.attributes.get("source", ""))
    parts = split_since(str(survey["time"].attrs.get("units", "")))
    known = survey.time[np.isfinite(survey.time)]
    found = None
    if parts is not None and len(known):
        found = parts[1] + timedelta(seconds=round(float(known[0])))
    if found is None or found < _NO_DATE:
        raise DataError(
            "its clock does not tell the date of the survey, which a calibration that changes with time needs",
            where=where,
            hint="give the units of `time` as `seconds since <date>`, or `time: {epoch: <date>}` in the mapping",
        )
    return found


def years_between(first: datetime, second: datetime) -> float:
    """Of 365.25 days."""
    return (second - first) / YEAR


def change_variables(
    change: Change, sensors: Sequence[str], at: datetime, facts: dict[str, str]
) -> dict[str, Variable]:
    """A change as variables of the group `calibration`, which holds C and o at a date.

    `rate` (sensor, raw_axis, raw_axis_) 1/a is (dC/dt) C^-1: its diagonal the relative drift of the scale factors, the
    rest that of angles, in rad; `offset_rate` nT/a. `change_covariance` is that of the relative errors dC C^-1 and o at
    that date, then of the rates. All of it is the same in any common frame of the sensors.
    """
    half = 12 * len(sensors)
    std = np.sqrt(np.maximum(np.diag(change.covariance)[half:], 0.0)).reshape(-1, 12)
    entries = [e.replace("matrix", "relative") for e in MATRIX_ENTRIES] + list(OFFSET_ENTRIES)
    names = [f"{s}:{e}" for s in sensors for e in entries]
    names += [f"{s}:rate_of_{e}" for s in sensors for e in entries]
    given: dict[str, Variable] = {
        RATE: (
            ("sensor", "raw_axis", "raw_axis_"), change.rate,
            {"units": "1/a", "long_name": "(dC/dt) C^-1", "date": _text(at), **facts},
        ),
        "calibration/rate_std": (("sensor", "raw_axis", "raw_axis_"), std[:, :9].reshape(-1, 3, 3), {"units": "1/a"}),
        "calibration/change_parameter": (("change_parameter",), np.array(names), {}),
        "calibration/change_covariance": (
            ("change_parameter", "change_parameter_"), change.covariance,
            {"units": "products of the parameters' units (1, nT, 1/a, nT/a)"},
        ),
        "calibration/raw_axis": (("raw_axis",), np.array(AXES), {"long_name": "axis of the raw output"}),
        "calibration/offset_rate": (("sensor", "raw_axis"), change.offset_rate, {"units": "nT/a"}),
        "calibration/offset_rate_std": (("sensor", "raw_axis"), std[:, 9:], {"units": "nT/a"}),
    }  # fmt: skip
    return given


def span_facts(dates: Sequence[datetime], words: str) -> dict[str, str]:
    """Attributes of `rate`: the dates of the first and the last survey, and what the fit says of the change."""
    return {"first": _text(min(dates)), "last": _text(max(dates)), "words": words}


def at_date_of(
    survey: Survey, calibration: Survey, fitted: ArrayCalibration, date: datetime | None = None
) -> tuple[ArrayCalibration, str]:
    """A stored calibration, as restored, at the date of a survey or one that is given; and that date in words.

    Raises:
        DataError: the calibration changes with the date and the survey's clock does not tell it.
    """
    if RATE not in calibration:
        return fitted, ""
    date = date_of(survey) if date is None else date
    found = _dated(calibration, fitted, date)
    first, last = (parse_instant(str(calibration[RATE].attrs[end])) for end in ("first", "last"))
    words = f"of {date:%Y-%m-%d}"
    if date > last:
        words += f", extrapolated: {years_between(last, date):.2f} years after the last survey of the fit"
    elif date < first:
        words += f", extrapolated: {years_between(date, first):.2f} years before the first survey of the fit"
    else:
        words += ", between the surveys of the fit"
    return found.calibration, words


def change_at_date_of(survey: Survey, calibration: Survey, fitted: ArrayCalibration) -> dict[str, Variable]:
    """The variables of a calibration's change, at the date of a survey; none where it does not change."""
    if RATE not in calibration:
        return {}
    date = date_of(survey)
    attributes = calibration[RATE].attrs
    facts = {name: str(attributes[name]) for name in ("first", "last", "words")}
    return change_variables(_dated(calibration, fitted, date).change, survey.sensors, date, facts)


def told_of_change(survey: Survey) -> tuple[str, ...]:
    """What a fit found of the change with the date, for the user; nothing where none was fitted."""
    return (f"with the date: {survey[RATE].attrs['words']}",) if RATE in survey else ()


def _dated(calibration: Survey, fitted: ArrayCalibration, date: datetime) -> Dated:
    values = (calibration.values(f"calibration/{name}") for name in ("rate", "offset_rate", "change_covariance"))
    change = Change(*(np.asarray(v, dtype=float) for v in values))
    if not all(np.isfinite(v).all() for v in (change.rate, change.offset_rate, change.covariance)):
        raise DataError(
            "the stored calibration is damaged: its change with the date is not finite",
            where=str(calibration.attributes.get("source", "")),
        )
    own = parse_instant(str(calibration[RATE].attrs["date"]))
    return Dated(fitted, change).after(years_between(own, date))


def _text(date: datetime) -> str:
    return f"{date.astimezone(UTC):%Y-%m-%dT%H:%M:%SZ}"
