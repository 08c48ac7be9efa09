"""IAGA-2002, the exchange format of the geomagnetic observatories."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from magtensor.components import reader
from magtensor.errors import DataError
from magtensor.survey.tables import Column, Tables, concatenate, existing
from magtensor.survey.times import since

_LEADING = ("DATE", "TIME", "DOY")
_MISSING_FROM = 88888.0  # 88888.00 not recorded, 99999.00 missing; no component is that large in nT or arc minutes
_LARGEST_MEMBER = 2**31  # bytes: a year of seconds is 2 GB; more is no observatory file
_ANGLES = "DI"


@reader(suffixes=(".min", ".sec", ".hor", ".iaga2002", ".zip"))
def iaga2002(
    paths: list[Path],
    *,
    max_bad_share: Annotated[
        float, Field(ge=0, le=1, description="refuse a file with a larger share of rows that cannot be read")
    ] = 0.01,
) -> Tables:
    """IAGA-2002 files, also inside a zip archive; columns are named as in the header (BOUH), and there is `time`.

    88888 and 99999 become NaN. Header lines become attributes. Components are in nT, D and I in arc minutes.
    """
    parts = []
    for path in existing(paths):
        for name, content in _contents(path):
            parts.append(_table(path, name, content.decode("latin-1").splitlines(), max_bad_share))
    return concatenate(parts)


def _contents(path: Path) -> Iterator[tuple[str, bytes]]:
    if path.suffix.lower() != ".zip":
        yield path.name, path.read_bytes()
        return
    try:
        with zipfile.ZipFile(path) as archive:
            members = sorted((m for m in archive.infolist() if not m.is_dir()), key=lambda m: m.filename)
            if not members:
                raise DataError("the archive is empty", where=path.name)
            for member in members:
                if member.file_size > _LARGEST_MEMBER:
                    raise DataError(
                        f"{member.filename} would unpack to {member.file_size / 2**30:.0f} GiB", where=path.name
                    )
                yield f"{path.name}/{member.filename}", archive.read(member)
    # zipfile raises RuntimeError for an encrypted member, and a kind of it for a compression it does not know
    except (zipfile.BadZipFile, RuntimeError, OSError, EOFError) as error:
        raise DataError(f"the archive cannot be unpacked: {error}", where=path.name) from error
    except Exception as error:
        if type(error).__module__ == "zlib":  # zlib.error is no subclass of anything more telling
            raise DataError(f"the archive is corrupt: {error}", where=path.name) from error
        raise


def _table(path: Path, name: str, lines: list[str], max_bad_share: float) -> Tables:
    attributes, names, start = _header(name, lines)
    stamps: list[str] = []
    rows: list[list[float]] = []
    bad: list[int] = []
    for number, line in enumerate(lines[start:], start + 1):
        fields = line.split()
        if not fields:
            continue
        try:
            if len(fields) != len(names) + 3:
                raise ValueError
            datetime.fromisoformat(f"{fields[0]}T{fields[1]}")
            rows.append([float(f) for f in fields[3:]])
            stamps.append(f"{fields[0]}T{fields[1]}")
        except ValueError:
            bad.append(number)
    if not rows:
        raise DataError("the file has a header but no row", where=name)
    if len(bad) > max_bad_share * (len(rows) + len(bad)):
        raise DataError(
            f"{len(bad)} of {len(rows) + len(bad)} rows cannot be read, the first in line {bad[0]}", where=name
        )
    notes = (f"{name}: {len(bad)} rows left out, the first in line {bad[0]}",) if bad else ()
    instants = np.array(stamps, dtype="datetime64[us]")
    midnight = instants[0].astype("datetime64[D]")
    seconds = (instants - midnight) / np.timedelta64(1, "us") * 1e-6
    epoch = datetime.fromtimestamp(int(midnight.astype("datetime64[s]").astype(np.int64)), UTC)
    table = np.array(rows)
    table[np.abs(table) >= _MISSING_FROM] = np.nan
    columns = {"time": Column.of("time", f"{name}: DATE TIME", seconds, since(epoch))}
    for i, column in enumerate(names):
        units = "arcmin" if column[-1:] in _ANGLES else "nT"
        columns[column] = Column.of(column, f"{name}: {column}", table[:, i], units)
    return Tables(columns, (path,), attributes, notes, (len(rows),))


def _header(name: str, lines: list[str]) -> tuple[dict[str, Any], list[str], int]:
    """The header's entries, the components' column names, and where the rows begin."""
    attributes: dict[str, Any] = {}
    comments: list[str] = []
    for i, line in enumerate(lines):
        fields = line.replace("|", " ").split()
        if tuple(fields[:3]) == _LEADING:
            if len(fields) == 3 or len(set(fields)) < len(fields):
                raise DataError("the line DATE TIME DOY does not name the components", where=f"{name}, line {i + 1}")
            if comments:
                attributes["comment"] = " ".join(comments)
            return attributes, fields[3:], i + 1
        entry = line.rstrip().rstrip("|").rstrip()
        if entry.startswith(" #"):
            comments.append(entry[2:].strip())
        elif len(entry) > 24 and entry.startswith(" "):
            attributes[entry[1:24].strip()] = entry[24:].strip()
        elif i == 0:
            break
    raise DataError(
        "this is not an IAGA-2002 file: there is no line DATE TIME DOY that ends a header",
        where=name,
        hint="another reader may fit; `magtensor plugins` lists them",
    )
