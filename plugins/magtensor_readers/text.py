"""Text files with columns: CSV, semicolons, tabs, blanks; with or without a header."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magtensor.components import reader
from magtensor.errors import DataError
from magtensor.survey.tables import Column, Tables, concatenate, existing
from magtensor.units import is_unit

DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "blank": None}
_UNITS = re.compile(r"[(\[]([^()\[\]]+)[)\]]\s*$")
_SHOWN = 3  # bad lines quoted in a message
_SAMPLE = 200  # lines looked at to tell the delimiter


@reader(suffixes=(".csv", ".txt", ".dat", ".tsv", ".asc", ".log", ".xyz"))
def text(
    paths: list[Path],
    *,
    delimiter: Annotated[
        Literal["auto", "comma", "semicolon", "tab", "blank"], Field(description="what separates the columns")
    ] = "auto",
    header: Annotated[bool | Literal["auto"], Field(description="whether the first line names the columns")] = "auto",
    comment: Annotated[str, Field(description="lines that start with this are left out")] = "#",
    skip_lines: Annotated[int, Field(ge=0, description="lines before the header or the first row")] = 0,
    decimal: Annotated[Literal[".", ","], Field(description="decimal mark")] = ".",
    missing: Annotated[
        tuple[str, ...], Field(description="texts that stand for a missing value, beside NaN, NA and nothing")
    ] = (),
    max_bad_share: Annotated[
        float, Field(ge=0, le=1, description="refuse a file with a larger share of rows that cannot be read")
    ] = 0.01,
) -> Tables:
    """Columns of text, one row a line; a header may state units as `Bx (nT)` or `Bx [nT]`.

    Rows with another number of columns, or with letters in a column of numbers, are left out and told with their
    line numbers. Columns without a name are called by their number, from 0.
    """
    parts = []
    for path in existing(paths):
        lines = _lines(path, comment, skip_lines)
        split = _splitter(path, lines, delimiter, decimal)
        names, lines = _header(split, lines, header, decimal, path)
        parts.append(_table(path, names, lines, split, decimal, missing, max_bad_share))
    return concatenate(parts)


class _Splitter:
    """How a line falls into fields."""

    def __init__(self, separator: str | None, quoted: bool) -> None:
        self.separator, self.quoted = separator, quoted

    def fields(self, line: str) -> list[str]:
        if self.separator is None:
            return line.split()
        if self.quoted and '"' in line:
            return next(csv.reader([line], delimiter=self.separator, skipinitialspace=True), [])
        return [f.strip() for f in line.split(self.separator)]

    def count(self, line: str) -> int:
        if self.separator is None:
            return len(line.split())
        if self.quoted and '"' in line:
            return len(self.fields(line))
        return line.count(self.separator) + 1


def _lines(path: Path, comment: str, skip: int) -> list[tuple[int, str]]:
    """The lines that may hold a header or a row, with their numbers from 1."""
    raw = path.read_bytes()
    start = raw[:4096]
    encoding = "utf-16" if start[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    if encoding != "utf-16" and sum(c < 9 or 13 < c < 27 for c in start) > 0.1 * len(start):
        raise DataError(
            f"this is a binary file, not text (it starts with {start[:8]!r})",
            where=path.name,
            hint="name its reader in the recipe's survey section; `apply` reads as the calibration's recipe does",
        )
    # Not str.splitlines: form feeds and other separators inside a corrupt row must not make new rows.
    lines = raw.decode(encoding, "replace").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    kept = [
        (i + 1, line)
        for i, line in enumerate(lines)
        if i >= skip and line.strip() and not (comment and line.lstrip().startswith(comment))
    ]
    if not kept:
        raise DataError("the file holds no row", where=path.name)
    return kept


def _splitter(path: Path, lines: Sequence[tuple[int, str]], delimiter: str, decimal: str) -> _Splitter:
    quoted = any('"' in line for _, line in lines)
    if delimiter != "auto":
        return _Splitter(DELIMITERS[delimiter], quoted)
    sample = [line for _, line in lines[1 : _SAMPLE + 1]] or [lines[0][1]]
    for separator in ("\t", ";", ",", None):
        if separator == decimal:
            continue
        splitter = _Splitter(separator, quoted)
        (fields, agreeing), *_ = Counter(splitter.count(line) for line in sample).most_common(1)
        if fields > 1 and agreeing >= 0.8 * len(sample):
            return splitter
    return _Splitter(",", quoted)


def _is_number(text: str, decimal: str) -> bool:
    try:
        float(text.replace(decimal, ".") if decimal != "." else text)
    except ValueError:
        return False
    return True


def _header(
    split: _Splitter, lines: list[tuple[int, str]], header: bool | str, decimal: str, path: Path
) -> tuple[list[str], list[tuple[int, str]]]:
    """The columns' names, and the lines that are rows."""
    first = split.fields(lines[0][1])
    if header == "auto":
        following = split.fields(lines[1][1]) if len(lines) > 1 else first
        header = sum(_is_number(f, decimal) for f in first) < sum(_is_number(f, decimal) for f in following)
    rows = lines[1:] if header else lines
    if not rows:
        raise DataError("the file has a header but no row", where=path.name)
    (width, _), *_ = Counter(split.count(line) for _, line in rows).most_common(1)
    if not header:
        return [str(i) for i in range(width)], rows
    if len(first) != width:
        raise DataError(
            f"the header names {len(first)} columns, most rows have {width}",
            where=f"{path.name}, line {lines[0][0]}",
            hint="the reader's options delimiter, header and skip_lines tell it how to split them",
        )
    names = [f or str(i) for i, f in enumerate(first)]
    twice = [n for n, count in Counter(names).items() if count > 1]
    if twice:
        names = [f"{n} ({i})" if n in twice else n for i, n in enumerate(names)]
    return names, rows


def _table(
    path: Path,
    names: list[str],
    lines: list[tuple[int, str]],
    split: _Splitter,
    decimal: str,
    missing: Sequence[str],
    max_bad_share: float,
) -> Tables:
    width = len(names)
    bad = {n: f"{c} columns instead of {width}" for n, line in lines if (c := split.count(line)) != width}
    whole = [(n, line) for n, line in lines if n not in bad]
    values = _parsed([line for _, line in whole], split, decimal, missing, width)
    columns: list[NDArray[Any]] = []
    keep = np.ones(len(whole), dtype=bool)
    for i, column in enumerate(values):
        numbers, unreadable = _numbers(column)
        columns.append(numbers)
        keep &= ~unreadable
        for row in np.flatnonzero(unreadable):
            bad.setdefault(whole[row][0], f"{str(column[row])[:20]!r} in column {names[i]}")
    if len(bad) > max_bad_share * len(lines) or not keep.any():
        raise DataError(
            f"{len(bad)} of {len(lines)} rows cannot be read: {_quoted(bad)}",
            where=path.name,
            hint=f"option max_bad_share is {max_bad_share:g}; are delimiter, decimal and header right?",
        )
    notes = (f"{path.name}: {len(bad)} of {len(lines)} rows left out: {_quoted(bad)}",) if bad else ()
    found = {
        name: _column(path, i, name, array[keep]) for i, (name, array) in enumerate(zip(names, columns, strict=True))
    }
    return Tables(found, (path,), {}, notes, (int(keep.sum()),))


def _quoted(bad: dict[int, str]) -> str:
    shown = [f"line {n} ({why})" for n, why in sorted(bad.items())[:_SHOWN]]
    return ", ".join(shown) + (f" and {len(bad) - _SHOWN} more" if len(bad) > _SHOWN else "")


def _parsed(lines: list[str], split: _Splitter, decimal: str, missing: Sequence[str], width: int) -> list[NDArray[Any]]:
    """Columns as pandas' parser sees them: numbers, or text where something in the column is not a number."""
    import io

    import pandas as pd

    # From 3.1 on every number is read to the last bit; before, only on request.
    new = tuple(int(n) for n in pd.__version__.split(".")[:2]) >= (3, 1)
    exact: dict[str, Any] = {} if new else {"float_precision": "round_trip"}
    frame = pd.read_csv(
        io.StringIO("\n".join(lines)),
        sep=r"\s+" if split.separator is None else split.separator,
        header=None,
        names=list(range(width)),
        index_col=False,
        decimal=decimal,
        na_values=list(missing),
        skipinitialspace=True,
        quoting=csv.QUOTE_MINIMAL if split.quoted else csv.QUOTE_NONE,
        low_memory=False,
        **exact,
    )
    return [frame[i].to_numpy() for i in range(width)]


def _numbers(column: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """A column as numbers with the rows that cannot be read as such, or as text if most of it is not numbers."""
    import pandas as pd

    fine = np.zeros(len(column), dtype=bool)
    if column.dtype.kind in "iuf":
        return column, fine
    if column.dtype.kind == "b":
        return column.astype(np.float64), fine
    series = pd.Series(column)
    absent = series.isna().to_numpy()
    numbers = pd.to_numeric(series, errors="coerce").to_numpy(dtype=np.float64)
    unreadable = np.isnan(numbers) & ~absent
    if unreadable.sum() > 0.5 * max((~absent).sum(), 1):
        return series.where(~absent, "").astype(str).to_numpy(dtype=str), fine
    return numbers, unreadable


def _column(path: Path, number: int, name: str, values: NDArray[Any]) -> Column:
    stated = _UNITS.search(name)
    units = stated[1].strip() if stated and is_unit(stated[1]) else None
    label = "" if name == str(number) else f" ({name})"
    return Column.of(name, f"{path.name}: column {number}{label}", values, units)
