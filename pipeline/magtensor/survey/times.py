"""Time bases: `seconds since <ISO 8601 UTC>`, clock text, and what moves a time from one base to another."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError
from magtensor.units import UnitError, convert

UNIX = "1970-01-01T00:00:00Z"
_SINCE = re.compile(r"^\s*(\S+)\s+since\s+(.+?)\s*$", re.IGNORECASE)
# Directives of strptime that say which day it is; a pattern with none of them is a time of day.
_DAY_DIRECTIVES = ("%d", "%j", "%x", "%c", "%D", "%F", "%U", "%W", "%V")


def parse_instant(text: str) -> datetime:
    """An ISO 8601 instant in UTC; one without a zone is UTC.

    Raises:
        ValueError: it is not an ISO 8601 date and time.
    """
    cleaned = re.sub(r"\s+(UTC|GMT|Z)$", "Z", text.strip())
    cleaned = re.sub(r"\s+([+-]\d{1,2}:?\d{0,2})$", r"\1", cleaned)
    # CF writers pad neither the date nor the hour ("1970-1-1 0:0:0").
    loose = re.match(r"^(\d{4})-(\d{1,2})-(\d{1,2})(?:[T ](\d{1,2}):(\d{1,2})(?::(\d{1,2})([.]\d+)?)?)?(.*)$", cleaned)
    if loose:
        year, month, day, hour, minute, second, fraction, rest = loose.groups()
        micro = f"{round(float(fraction) * 1e6):06d}"[:6] if fraction else "000000"
        cleaned = (
            f"{year}-{int(month):02d}-{int(day):02d}T{int(hour or 0):02d}:{int(minute or 0):02d}:{int(second or 0):02d}"
            f".{micro}{rest}"
        )
    try:
        instant = datetime.fromisoformat(cleaned)
    except ValueError as error:
        raise ValueError(f"'{text}' is not an ISO 8601 time such as 2022-08-10T00:00:00Z") from error
    return instant.replace(tzinfo=UTC) if instant.tzinfo is None else instant.astimezone(UTC)


def split_since(units: str) -> tuple[str, datetime] | None:
    """`"seconds since 2020-01-01"` to its unit and epoch; None if it names no epoch.

    Raises:
        ValueError: the epoch is not an ISO 8601 time, or the unit is not known.
    """
    match = _SINCE.match(units)
    if not match:
        return None
    convert(0.0, match[1], "s")
    return match[1], parse_instant(match[2])


def since(epoch: datetime) -> str:
    """The units text of the canonical layout: `seconds since 2020-01-01T00:00:00Z`."""
    text = epoch.astimezone(UTC).replace(tzinfo=None).isoformat()
    return f"seconds since {text}Z"


def to_epoch(values: NDArray[np.float64], old: datetime, new: datetime) -> NDArray[np.float64]:
    """Seconds on one epoch, moved to another; the same array if they agree."""
    shift = old - new
    return values if shift == timedelta(0) else values + shift.total_seconds()


def numbers_to_seconds(values: NDArray[np.generic], units: str) -> NDArray[np.float64]:
    """Numbers in any unit of time to seconds.

    Integers are split before scaling, so that nanoseconds since 1970 (beyond 2^53) lose nothing above a float64's
    own resolution.

    Raises:
        UnitError: not a unit of time.
    """
    if values.dtype.kind in "iu":
        per_second = convert(1.0, "s", units)
        if per_second > 1 and per_second == int(per_second):
            whole, rest = np.divmod(values, values.dtype.type(int(per_second)))
            seconds: NDArray[np.float64] = whole.astype(np.float64) + rest.astype(np.float64) / float(per_second)
            return seconds
    return convert(values, units, "s")


def require_digits(values: NDArray[np.generic], where: str) -> None:
    """Refuse times (N,) that were stored with too few digits to tell one sample from the next.

    Raises:
        DataError: floating-point numbers most of which repeat, and that differ by their last digit where they do not.
    """
    if values.dtype.kind != "f" or values.dtype.itemsize >= 8:
        return
    steps, largest = np.diff(values), np.max(np.abs(values), initial=0.0, where=np.isfinite(values))
    apart, repeat = np.spacing(largest), steps == 0
    # whole seconds repeat too, and say what the clock said
    if np.count_nonzero(repeat) > 0.5 * len(steps) and np.min(np.abs(steps), initial=np.inf, where=~repeat) <= apart:
        raise DataError(
            f"{8 * values.dtype.itemsize}-bit numbers near {largest:.4g} are {apart:g} apart: different samples have "
            "the same time",
            where=where,
            hint="store times as 64-bit numbers, or count them from the start of the survey",
        )


def without_days(values: NDArray[np.generic], units: str, epoch: datetime) -> tuple[NDArray[np.generic], datetime]:
    """Whole numbers with the days up to the first moved into the epoch; other numbers as they are.

    Nanoseconds since 1970 exceed what a float64 resolves; nanoseconds of a survey do not.

    Args:
        values: (N,) whole numbers or others.
        units: of the values.
        epoch: what they count from.
    """
    per_day = round(float(86400.0 * convert(1.0, "s", units)))
    if values.dtype.kind not in "iu" or len(values) == 0:
        return values, epoch
    days = int(values[0]) // per_day
    return values - np.asarray(days * per_day, dtype=values.dtype), epoch + timedelta(days=days)


def texts_to_seconds(
    texts: NDArray[np.str_], pattern: str | None, day: datetime | None
) -> tuple[NDArray[np.float64], datetime]:
    """Clock text to seconds since an epoch.

    Args:
        texts: (N,) text; what cannot be read becomes NaN.
        pattern: a strptime pattern; None for ISO 8601.
        day: the first sample's day, for a pattern that has only a time of day; a clock that falls back by more
            than half a day has passed midnight.

    Returns:
        seconds (N,) and their epoch: midnight of the first day.

    Raises:
        ValueError: the pattern has no day and none is given, or no text can be read.
    """
    daily = pattern is not None and not any(d in pattern for d in _DAY_DIRECTIVES)
    if daily and day is None:
        raise ValueError(f"the pattern '{pattern}' has no day; give the first day as `epoch`")
    instants = np.full(len(texts), np.nan)
    first: datetime | None = None if not daily else datetime(1900, 1, 1, tzinfo=UTC)
    for i, text in enumerate(texts):
        try:
            instant = datetime.strptime(text, pattern) if pattern is not None else parse_instant(text)
        except ValueError:
            continue
        instant = instant.replace(tzinfo=UTC) if instant.tzinfo is None else instant.astimezone(UTC)
        if first is None:
            first = instant.replace(hour=0, minute=0, second=0, microsecond=0)
        instants[i] = (instant - first).total_seconds()
    if first is None or np.isnan(instants).all():
        raise ValueError(
            f"none of the times ('{texts[0] if len(texts) else ''}', ...) reads as {pattern or 'ISO 8601'}"
        )
    if daily:
        read = np.isfinite(instants)
        turns = np.concatenate(([0.0], np.cumsum(np.diff(instants[read]) < -43200.0)))
        instants[read] += 86400.0 * turns
        assert day is not None
        first = day.replace(hour=0, minute=0, second=0, microsecond=0)
    return instants, first


__all__ = [
    "UNIX", "UnitError", "numbers_to_seconds", "parse_instant", "require_digits", "since", "split_since",
    "texts_to_seconds", "to_epoch",
]  # fmt: skip
