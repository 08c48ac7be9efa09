"""What a file holds: its columns with shapes, units, ranges and gaps, its time base, and a mapping for a recipe."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor.errors import DataError, UsageError
from magtensor.survey import time_base
from magtensor.survey.recorded_numbers import resolution
from magtensor.survey.sections import SurveySection
from magtensor.survey.source import Source
from magtensor.survey.tables import Column, Tables, existing
from magtensor.survey.times import split_since

if TYPE_CHECKING:
    from magtensor.components import Component


@dataclass(frozen=True)
class ColumnFacts:
    """One column or dataset.

    Attributes:
        name, number: how a mapping may call it.
        shape, dims, units: as the file says.
        kind: number, text, or unreadable.
        low, median, high: of all finite numbers.
        missing: share of numbers that are NaN or infinite.
        resolution: quantisation step, 0 where none shows.
        example: the first text; for what cannot be read, why.
    """

    name: str
    number: int
    shape: tuple[int, ...]
    dims: tuple[str, ...] | None
    units: str | None
    kind: str
    low: float = float("nan")
    median: float = float("nan")
    high: float = float("nan")
    missing: float = 0.0
    resolution: float = 0.0
    example: str = ""


@dataclass(frozen=True)
class FileFacts:
    """A file.

    Attributes:
        files: names.
        reader: which reader read it.
        canonical: it has `time` and `b_raw` of the canonical layout, with their units.
        columns: in the file's order.
        attributes: what the file says of itself.
        notes: what the reader noticed.
        sampling: sentences on the time base.
        mapping: YAML text that can stand in a recipe.
    """

    files: tuple[str, ...]
    reader: str
    canonical: bool
    columns: tuple[ColumnFacts, ...]
    attributes: Mapping[str, Any]
    notes: tuple[str, ...]
    sampling: tuple[str, ...]
    mapping: str


def describe(file: Path, readers: Mapping[str, Component], reader: str | None = None) -> FileFacts:
    """Look into a file.

    Args:
        file: any file a reader knows.
        readers: reader components by name.
        reader: which one; None to go by the file name's ending, then by what is in the file.

    Raises:
        UsageError: no such reader.
        DataError: the file cannot be read.
    """
    from magtensor.survey.propose import propose

    name, tables = _read(file, readers, reader)
    facts = tuple(column_facts(n, c, i) for i, (n, c) in enumerate(tables.columns.items()))
    raw, time = tables.columns.get("b_raw"), tables.columns.get("time")
    canonical = raw is not None and len(raw.shape) == 3 and bool(raw.units) and time is not None and _dated(time)
    return FileFacts(
        tuple(f.name for f in tables.files),
        name,
        canonical,
        facts,
        tables.attributes,
        tables.notes,
        tuple(sampling_sentences(tables)),
        propose(tables, str(file), name if reader or not _by_suffix(file, readers) else None, canonical=canonical),
    )


def _dated(time: Column) -> bool:
    """The units of the times name an epoch, without which the canonical layout is refused."""
    try:
        return split_since(time.units or "") is not None
    except ValueError:
        return False


def _by_suffix(file: Path, readers: Mapping[str, Component]) -> list[str]:
    return [n for n, c in readers.items() if any(file.name.lower().endswith(s) for s in c.suffixes)]


def _read(file: Path, readers: Mapping[str, Component], reader: str | None) -> tuple[str, Tables]:
    """The file through the named reader, the one its ending names, or the first that understands it."""
    existing([file])
    candidates = [reader] if reader else _by_suffix(file, readers) or list(readers)
    failures = []
    for name in candidates:
        section = SurveySection(file=str(file.resolve()), reader=name)
        source = Source(section, file.parent, readers)
        wrong = source.problems()
        if wrong:
            raise UsageError("; ".join(message for _, message in wrong))
        try:
            return name, source.tables(section)
        except DataError as error:
            failures.append(error)
    if len(failures) == 1:
        raise failures[0]
    raise DataError("no reader understands this file", where=file.name, hint="\n  ".join(f"{f.what}" for f in failures))


def column_facts(name: str, column: Column, number: int) -> ColumnFacts:
    """What can be said of one column; one that cannot be read is described as such."""
    facts = {"name": name, "number": number, "shape": column.shape, "dims": column.dims, "units": column.units}
    try:
        values = np.asarray(column.load())
    except DataError as error:
        return ColumnFacts(**facts, kind="unreadable", example=error.what)  # type: ignore[arg-type]
    if values.dtype.kind not in "fiub":
        example = str(values.flat[0]) if values.size else ""
        return ColumnFacts(**facts, kind="text", example=example)  # type: ignore[arg-type]
    numbers = values.astype(np.float64).ravel()
    finite = numbers[np.isfinite(numbers)]
    if finite.size == 0:
        return ColumnFacts(**facts, kind="number", missing=1.0 if numbers.size else 0.0)  # type: ignore[arg-type]
    return ColumnFacts(
        **facts,  # type: ignore[arg-type]
        kind="number",
        low=float(finite.min()),
        median=float(np.median(finite)),
        high=float(finite.max()),
        missing=1.0 - finite.size / numbers.size,
        resolution=resolution(values.reshape(len(values), -1)[:, 0].astype(np.float64)) if values.ndim else 0.0,
    )


def sampling_sentences(tables: Tables) -> list[str]:
    """Rate, gaps and faults of every time base in the file."""
    from magtensor.survey.propose import time_candidates

    found = []
    for column, seconds in time_candidates(tables):
        if len(seconds) < 2:
            found.append(f"{column.name}: one sample")
            continue
        onward = time_base.moves_on(seconds)
        good = seconds[onward]
        if len(good) < 2:
            found.append(f"{column.name}: the times do not increase")
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            rhythm = time_base.sampling(good)
        text = f"{column.name}: {len(seconds)} samples over {good[-1] - good[0]:.6g} s, {rhythm.rate_Hz:.6g} Hz"
        text += f", {rhythm.gaps} gaps (longest {rhythm.longest_gap_s:.6g} s)" if rhythm.gaps else ", no gaps"
        if not onward.all():
            text += f", {int((~onward).sum())} times that repeat or step back"
        found.append(text)
    return found


def show(file: Path, reader: str | None = None, plugin_folders: Sequence[Path] = ()) -> None:
    """Print what a file holds and the mapping to paste into a recipe.

    Raises:
        UsageError, DataError: as `describe`.
    """
    from rich.console import Console
    from rich.syntax import Syntax
    from rich.table import Table

    from magtensor.recipe.plan import readers as readers_of
    from magtensor.registry import Registry

    facts = describe(file, readers_of(Registry.load(plugin_folders)), reader)
    console = Console() if sys.stdout.isatty() else Console(width=200)  # a file or a pipe has no edge to wrap at
    console.print(f"[bold]{', '.join(facts.files)}[/bold]  (reader {facts.reader})", highlight=False)
    table = Table(box=None, pad_edge=False)
    for title in ("", "name", "shape", "units", "lowest", "median", "highest", "missing", "step"):
        number = title in ("lowest", "median", "highest", "missing", "step")
        table.add_column(title, justify="right" if number else "left", no_wrap=number, overflow="fold")
    for c in facts.columns:
        shape = " x ".join(
            str(n) if not c.dims else f"{d} {n}" for n, d in zip(c.shape, c.dims or c.shape, strict=True)
        )
        cells = [str(c.number), c.name, shape, c.units or ""]
        if c.kind == "number":
            cells += [*(f"{v:.6g}" for v in (c.low, c.median, c.high)), f"{100 * c.missing:.3g} %" if c.missing else ""]
            cells.append(f"{c.resolution:.4g}" if c.resolution else "")
        else:
            cells.append(f"{c.kind}: {c.example}"[:40])
        table.add_row(*(escape_markup(cell) for cell in cells))
    console.print(table)
    for line in (*facts.sampling, *facts.notes):
        console.print(line, highlight=False, markup=False)
    for key, value in facts.attributes.items():
        console.print(f"{key}: {_short(value)}", highlight=False, markup=False)
    console.print("\nFor a recipe:\n", highlight=False)
    if console.is_terminal:
        console.print(Syntax(facts.mapping, "yaml", background_color="default"))
    else:
        print(facts.mapping)


def escape_markup(text: str) -> str:
    """Text that rich prints as it is: `[nT]` in a column's name is no markup."""
    from rich.markup import escape

    return escape(text)


def _short(value: Any) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 100 else text[:97] + "..."
