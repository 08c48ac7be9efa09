"""What a reader returns: the columns or datasets of one or more files, each with its origin, read when asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError, did_you_mean


@dataclass(frozen=True)
class Column:
    """One column of a text file or one dataset of a binary file.

    Attributes:
        name: the column's name, its number as text if it has none, or the dataset's path.
        origin: `file: dataset` or `file: column 3 (name)`, for messages.
        shape: the first dimension counts the rows.
        load: reads the values; may raise DataError. With a slice as its argument, only those rows (HDF5 only).
        units: as the file states them, None if it does not.
        dims: names of the dimensions if the file states them.
        attributes: what else the file says of it.
        text: the values are text.
    """

    name: str
    origin: str
    shape: tuple[int, ...]
    load: Callable[..., NDArray[Any]] = field(repr=False, compare=False)
    units: str | None = None
    dims: tuple[str, ...] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    text: bool = False

    @classmethod
    def of(
        cls,
        name: str,
        origin: str,
        values: NDArray[Any],
        units: str | None = None,
        attributes: Mapping[str, Any] | None = None,
    ) -> Column:
        """A column whose values have been read already."""
        text = values.dtype.kind in "OSU"
        return cls(name, origin, values.shape, lambda: values, units, None, attributes or {}, text)


@dataclass(frozen=True)
class Tables:
    """The columns of the files a reader was given, in the files' order.

    Attributes:
        columns: by name.
        files: what was read.
        attributes: what the files say of themselves.
        notes: what the reader noticed and the user should know (rows left out, and where).
        part_rows: rows of each file in turn, so that files can be put in the order of their times.
    """

    columns: Mapping[str, Column]
    files: tuple[Path, ...]
    attributes: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    part_rows: tuple[int, ...] = ()

    def window(self, rows: slice) -> Tables:
        """The same with some rows only of everything that has as many as `time`, the reference left whole."""
        count = self.find("time").shape[0]
        start, stop, _ = rows.indices(count)
        columns = {
            name: replace(c, shape=(stop - start, *c.shape[1:]), load=partial(c.load, slice(start, stop)))
            if c.shape[:1] == (count,) and "/" not in name
            else c
            for name, c in self.columns.items()
        }
        return replace(self, columns=columns)

    @property
    def where(self) -> str:
        """The files' names, for messages."""
        first = self.files[0].name if self.files else ""
        return first if len(self.files) < 2 else f"{first} and {len(self.files) - 1} more files"

    def find(self, key: str | int) -> Column:
        """The column of this name, or at this place (from 0).

        Raises:
            DataError: there is none; the message says what there is.
        """
        names = list(self.columns)
        if isinstance(key, int):
            if 0 <= key < len(names):
                return self.columns[names[key]]
            raise DataError(
                f"there is no column {key}",
                where=self.where,
                hint=f"the columns are numbered 0 to {len(names) - 1}",
            )
        name = key.strip("/")
        if name in self.columns:
            return self.columns[name]
        shown = names if len(names) <= 40 else [*names[:40], f"and {len(names) - 40} more"]
        raise DataError(
            f"there is no {key}{did_you_mean(name, names)}", where=self.where, hint=f"the file has {', '.join(shown)}"
        )


def concatenate(parts: Sequence[Tables]) -> Tables:
    """One table out of files with the same columns, their rows one after the other.

    Raises:
        DataError: a file has other columns, or columns of another width, than the first.
    """
    first = parts[0]
    if len(parts) == 1:
        return first
    for other in parts[1:]:
        if list(other.columns) != list(first.columns):
            lacking = [n for n in first.columns if n not in other.columns]
            extra = [n for n in other.columns if n not in first.columns]
            what = "; ".join(
                text
                for text in (
                    f"it lacks {', '.join(lacking)}" if lacking else "",
                    f"it also has {', '.join(extra)}" if extra else "",
                )
                if text
            )
            raise DataError(
                f"the columns differ from those of {first.where}: {what or 'they come in another order'}",
                where=other.where,
                hint="files that follow each other must have the same columns",
            )
    columns = {name: _joined([p.columns[name] for p in parts]) for name in first.columns}
    return Tables(
        columns,
        tuple(f for p in parts for f in p.files),
        first.attributes,
        tuple(n for p in parts for n in p.notes),
        tuple(r for p in parts for r in p.part_rows),
    )


def _joined(pieces: Sequence[Column]) -> Column:
    first = pieces[0]
    for piece in pieces[1:]:
        if piece.shape[1:] != first.shape[1:]:
            raise DataError(
                f"shape {piece.shape} does not continue {first.shape} of {first.origin}", where=piece.origin
            )
        if piece.units != first.units:
            raise DataError(f"units {piece.units} differ from {first.units} of {first.origin}", where=piece.origin)
    rows = sum(p.shape[0] for p in pieces if p.shape)
    # A scalar or an array without rows says something of the file, not of its samples: the first file's holds.
    load = (lambda: np.concatenate([p.load() for p in pieces])) if first.shape else first.load
    return Column(
        first.name,
        f"{first.origin} and {len(pieces) - 1} more files",
        (rows, *first.shape[1:]) if first.shape else (),
        load,
        first.units,
        first.dims,
        first.attributes,
        any(p.text for p in pieces),
    )


def existing(paths: Iterable[Path]) -> list[Path]:
    """The paths, each of which is a file with something in it.

    Raises:
        DataError: a path is not there, is a folder, cannot be read, or is empty.
    """
    checked = list(paths)
    for path in checked:
        if not path.exists():
            beside = path.parent.iterdir() if path.parent.is_dir() else ()
            near = did_you_mean(path.name, [p.name for p in beside if p.suffix == path.suffix])
            raise DataError(f"there is no such file{near}", where=str(path))
        if path.is_dir():
            raise DataError("this is a folder, a file is needed", where=str(path))
        try:
            size = path.stat().st_size
            with path.open("rb"):
                pass
        except OSError as error:
            raise DataError(f"cannot be read: {error.strerror}", where=str(path)) from error
        if size == 0:
            raise DataError("the file is empty", where=path.name)
    return checked
