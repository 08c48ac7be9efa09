"""From columns to numbers with units: what the mapping's `from`, `scale`, `units`, `time` ... mean."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError
from magtensor.survey.sections import FileSection, QuantitySection, Ref, TimeSection
from magtensor.survey.tables import Column, Tables
from magtensor.survey.times import (
    UNIX,
    numbers_to_seconds,
    parse_instant,
    require_digits,
    split_since,
    texts_to_seconds,
    to_epoch,
    without_days,
)
from magtensor.units import UnitError, convert

_PART = re.compile(r"^(.+)\[(\d+)(?::(\d+))?\]$")
# Times so large count from 1970 or the like; they are moved to midnight of the first day, which is exact.
_FAR = 1e8


@dataclass(frozen=True)
class Rows:
    """The rows of a set of files, in use order, with their times.

    Attributes:
        tables: where the columns are.
        time: (N,) s since `epoch`.
        epoch: what the times count from.
        order: row numbers where files were put in the order of their times, None for the order given.
        relative: nothing said what the times count from.
    """

    tables: Tables
    time: NDArray[np.float64]
    epoch: datetime
    order: NDArray[np.intp] | None = None
    relative: bool = False

    def values(self, ref: Ref) -> NDArray[Any]:
        """A column's numbers (N, k), in use order.

        Raises:
            DataError: no such column, text instead of numbers, or another number of rows.
        """
        numbers = matrix(self.tables, ref)
        if len(numbers) != len(self.time):
            raise DataError(
                f"{len(numbers)} rows, but the time base has {len(self.time)}",
                where=self.tables.find(_name(ref)).origin,
            )
        return numbers if self.order is None else numbers[self.order]

    def units(self, refs: Sequence[Ref]) -> str | None:
        """The units the file states for these columns; None if it states none, or not one for all."""
        stated = {self.tables.find(_name(r)).units for r in refs}
        return stated.pop() if len(stated) == 1 else None


def _name(ref: Ref) -> Ref:
    match = _PART.match(ref) if isinstance(ref, str) else None
    return match[1] if match else ref


def listed(refs: Ref | Sequence[Ref]) -> list[Ref]:
    """One reference or several, as a list."""
    return [refs] if isinstance(refs, int | str) else list(refs)


def matrix(tables: Tables, ref: Ref) -> NDArray[Any]:
    """A column or dataset, or a part of one (`mag[1]`, `mag[3:6]`), as numbers (N, k).

    The part counts along the second dimension; what is left beyond it is laid out in the file's order.

    Raises:
        DataError: no such column, no such part, or text.
    """
    part = None
    try:
        column = tables.find(ref)
    except DataError:
        part = _PART.match(ref) if isinstance(ref, str) else None
        if part is None:
            raise
        column = tables.find(part[1])
    if column.text:
        raise DataError("this is text where numbers are needed", where=column.origin)
    if not column.shape:
        raise DataError("this is a single value, not one per sample", where=column.origin)
    values = column.load()
    if part is not None:
        first = int(part[2])
        last = int(part[3]) if part[3] else first + 1
        if values.ndim < 2 or not first < last <= values.shape[1]:
            raise DataError(f"there is no part {ref} in shape {values.shape}", where=column.origin)
        values = values[:, first:last]
    return values.reshape(len(values), -1)


def rows_of(part: FileSection, tables: Tables) -> Rows:
    """The rows of the files with their times, from the section's `time` or the reader's own column `time`.

    Raises:
        DataError: no time base, or one that cannot be read.
    """
    section = part.time
    if section is None:
        own = tables.columns.get("time")
        if own is None or own.units is None or _since(own.units, own) is None:
            raise DataError(
                "nothing says when the samples were taken",
                where=tables.where,
                hint="give `time` with a column (`from`) or a `rate_Hz`",
            )
        section = TimeSection(from_="time")
    time, epoch = _rate_times(section, tables) if section.rate_Hz is not None else _column_times(section, tables)
    relative = epoch is None
    epoch = epoch or parse_instant(UNIX)
    finite = time[np.isfinite(time)]
    if finite.size and abs(finite[0]) > _FAR and not relative:
        start = datetime.fromtimestamp(epoch.timestamp() + float(finite[0]), tz=epoch.tzinfo)
        midnight = start.replace(hour=0, minute=0, second=0, microsecond=0)
        time, epoch = to_epoch(time, epoch, midnight), midnight
    time = time + section.shift_s if section.shift_s else time
    order = _order(time, tables.part_rows) if part.order == "time" and len(tables.part_rows) > 1 else None
    return Rows(tables, time if order is None else time[order], epoch, order, relative)


def _since(units: str, column: Column) -> tuple[str, datetime] | None:
    try:
        return split_since(units)
    except ValueError as error:
        raise DataError(str(error), where=column.origin) from error


def _rate_times(section: TimeSection, tables: Tables) -> tuple[NDArray[np.float64], datetime | None]:
    rate = section.rate_Hz
    if isinstance(rate, str):
        if rate not in tables.attributes:
            raise DataError(
                f"the file has no attribute {rate} that would state the rate",
                where=tables.where,
                hint=f"it has {', '.join(map(str, tables.attributes)) or 'none'}",
            )
        try:
            rate = float(tables.attributes[rate])
        except (TypeError, ValueError) as error:
            raise DataError(f"the attribute {section.rate_Hz} is not a number", where=tables.where) from error
    assert rate is not None
    if not rate > 0:
        raise DataError(f"a rate of {rate} Hz", where=tables.where)
    # Dividing keeps every time within one rounding of i / rate; multiplying by a step would let it wander.
    return np.arange(sum(tables.part_rows)) / rate, _epoch(section)


def _epoch(section: TimeSection) -> datetime | None:
    if section.epoch is None:
        return None
    return parse_instant(UNIX if section.epoch == "unix" else section.epoch)


def _column_times(section: TimeSection, tables: Tables) -> tuple[NDArray[np.float64], datetime | None]:
    refs = listed(section.from_) if section.from_ is not None else []
    columns = [tables.find(r) for r in refs]
    where = columns[0].origin
    try:
        if len(columns) > 1 or columns[0].text or section.format is not None:
            pieces = [np.asarray(c.load()).astype(str) for c in columns]
            texts = pieces[0]
            for piece in pieces[1:]:
                texts = np.char.add(np.char.add(texts, " "), piece)
            return texts_to_seconds(texts, section.format, _epoch(section))
        values = matrix(tables, refs[0])[:, 0]
        require_digits(values, where)
        units = section.units or columns[0].units or "s"
        parts = split_since(units)
        unit, epoch = parts if parts is not None else (units, _epoch(section))
        if section.counter is not None:
            values = unwrapped(values.astype(np.float64), section.counter)
        if epoch is not None:
            values, epoch = without_days(values, unit, epoch)
        return numbers_to_seconds(values, unit), epoch
    except ValueError as error:
        raise DataError(str(error), where=where) from error


def unwrapped(values: NDArray[np.float64], modulus: int) -> NDArray[np.float64]:
    """A counter that starts again from 0 at `modulus`, made to go on; missing values stay missing.

    Args:
        values: (N,) readings of the counter; forward steps must be shorter than `modulus`.
        modulus: one more than the largest reading.
    """
    found = values.copy()
    read = np.isfinite(values)
    kept = values[read]
    turns = np.concatenate(([0.0], np.cumsum(np.diff(kept) < -modulus / 2)))
    found[read] = kept + modulus * turns[: len(kept)]
    return found


def signed(values: NDArray[np.float64], modulus: int) -> NDArray[np.float64]:
    """A two's-complement register that was read as unsigned: the congruent number in [-modulus/2, modulus/2)."""
    half = modulus / 2
    return np.mod(values + half, modulus) - half


def _order(time: NDArray[np.float64], part_rows: Sequence[int]) -> NDArray[np.intp]:
    """Row numbers with the files in the order of their first times; inside a file nothing moves."""
    bounds = np.concatenate(([0], np.cumsum(part_rows)))
    starts = []
    for a, b in pairwise(bounds):
        known = time[a:b][np.isfinite(time[a:b])]
        starts.append(known[0] if known.size else np.inf)
    turn = np.argsort(starts, kind="stable")
    return np.concatenate([np.arange(bounds[i], bounds[i + 1]) for i in turn])


@dataclass(frozen=True)
class Quantity:
    """Numbers with units.

    Attributes:
        values: (N, k); NaN where nothing was recorded.
        units: of the values.
        unbelievable: (N,) a number was outside `valid`; it keeps its value.
        notes: what the user should know.
    """

    values: NDArray[np.float64]
    units: str | None
    unbelievable: NDArray[np.bool_]
    notes: tuple[str, ...] = ()


def quantity(section: QuantitySection, rows: Rows, *, to: str | None, what: str) -> Quantity:
    """Read what a mapping entry describes.

    Args:
        section: the entry.
        rows: where its columns are.
        to: the units wanted; None to keep its own.
        what: the entry's place, for messages.

    Raises:
        DataError: a column is missing, is text, or has no units or units of another dimension.
    """
    refs = listed(section.from_)
    raw = np.concatenate([rows.values(r).astype(np.float64) for r in refs], axis=1)
    origin = f"{rows.tables.where}: {what}"
    if section.missing:
        raw[np.isin(raw, section.missing)] = np.nan
    unbelievable: NDArray[np.bool_] = np.zeros(len(raw), dtype=bool)
    if section.valid is not None:
        low, high = section.valid
        unbelievable = np.asarray(((raw < low) | (raw > high)).any(axis=1))
    if section.wrap is not None:
        raw = signed(raw, section.wrap)
    raw = raw * _each(section.scale, raw.shape[1], "scale", origin)
    raw = raw + _each(section.offset, raw.shape[1], "offset", origin)
    stated = rows.units(refs)
    units = section.units or stated
    notes: tuple[str, ...] = ()
    untouched = section.scale == 1.0 and section.offset == 0.0
    if section.units and stated and untouched and not _agree(section.units, stated):
        notes = (f"{what}: the file says {stated}, the recipe says {section.units}; the recipe holds",)
    if to is not None:
        if units is None:
            raise DataError(
                "neither the file nor the mapping says which units these are",
                where=origin,
                hint=f"add `units:` (it becomes {to})",
            )
        try:
            raw = convert(raw, units, to)
        except UnitError as error:
            raise DataError(str(error), where=origin) from error
        units = to
    if section.axes is not None:
        if raw.shape[1] != 3:
            raise DataError(f"`axes` needs three columns, there are {raw.shape[1]}", where=origin)
        signs = np.array([-1.0 if a[0] == "-" else 1.0 for a in section.axes])
        raw = raw[:, ["xyz".index(a[-1]) for a in section.axes]] * signs
    return Quantity(raw, units, unbelievable, notes)


def _agree(one: str, other: str) -> bool:
    try:
        return bool(convert(1.0, one, other) == 1.0 and convert(0.0, one, other) == 0.0)
    except UnitError:
        return False


def _each(given: float | list[float], columns: int, what: str, origin: str) -> NDArray[np.float64]:
    array = np.atleast_1d(np.asarray(given, dtype=np.float64))
    if array.size not in (1, columns):
        raise DataError(f"{array.size} numbers of `{what}` for {columns} columns", where=origin)
    return array


def interpolated(
    at: NDArray[np.float64], time: NDArray[np.float64], values: NDArray[np.float64], max_gap_s: float
) -> NDArray[np.float64]:
    """Values (M, k) at other times by linear interpolation; NaN outside and inside gaps longer than `max_gap_s`.

    Args:
        at: (M,) s, where they are wanted.
        time: (N,) s, strictly increasing.
        values: (N, k).
        max_gap_s: s.
    """
    if len(time) == 0:
        return np.full((len(at), values.shape[1]), np.nan)
    right = np.clip(np.searchsorted(time, at, side="left"), 0, len(time) - 1)
    exact = time[right] == at
    left = np.where(exact, right, np.maximum(right - 1, 0))
    gap = time[right] - time[left]
    inside = exact | ((at > time[0]) & (at < time[-1]) & (gap <= max_gap_s))
    weight = np.divide(at - time[left], gap, out=np.zeros(len(at)), where=gap > 0)[:, None]
    found = values[left] * (1.0 - weight) + values[right] * weight
    found[exact] = values[right[exact]]
    found[~inside] = np.nan
    return found
