"""Trials of a study side by side: those that a file of rows does not hold yet are made, and each is kept at once."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

Row = dict[str, Any]


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of the command line that `rows_of` takes."""
    parser.add_argument("--rows", type=Path, required=True, help="one line of JSON a trial, read first and added to")
    parser.add_argument("--seconds", type=float, default=math.inf, help="no trial is begun later")
    parser.add_argument("--workers", type=int, default=2)


def rows_of(
    chosen: argparse.Namespace,
    trials: Iterable[tuple[Any, ...]],
    trial_of: Callable[[Row], Sequence[Any]],
    tried: Callable[[Any], Row],
    line: Callable[[Row], str],
) -> tuple[list[Row], int]:
    """Make the rows that are missing.

    Parameters
    ----------
    chosen: with what `add_options` asks for.
    trials: that are wanted.
    trial_of: the trial that a row is of.
    tried: the row of a trial, a function of a module (it runs in other processes).
    line: what is printed of a new row.

    Returns
    -------
    All rows of the file, those of earlier runs first, and how many of the trials are still to be made.
    """
    end = time.time() + chosen.seconds
    chosen.rows.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(text) for text in chosen.rows.open()] if chosen.rows.exists() else []
    known = {tuple(trial_of(row)) for row in rows}
    missing = [trial for trial in trials if tuple(trial) not in known]
    open_ = len(missing)
    with chosen.rows.open("a") as out, ProcessPoolExecutor(chosen.workers) as pool:
        for row in pool.map(partial(_in_time, tried, end), missing):
            if row is None:
                continue
            rows.append(row)
            open_ -= 1
            out.write(json.dumps(row) + "\n")
            out.flush()
            print(line(row), flush=True)
    return rows, open_


def study(
    script: str,
    words: str | None,
    kind: Any,
    planned: Callable[[int], Iterable[tuple[Any, ...]]],
    tried: Callable[[Any], Row],
    line: Callable[[Row], str],
    page: Callable[[str, Sequence[Row], int], str],
) -> None:
    """The command line of a study: run what is missing and write the page.

    Parameters
    ----------
    script: its file; words: its help; kind: the named tuple of its trials.
    planned: the trials, of so many surveys of each kind; tried, line: as in `rows_of`.
    page: of the command, all rows, and how many trials are still to be made.
    """
    parser = argparse.ArgumentParser(description=words, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_options(parser)
    parser.add_argument("--page", type=Path, help="write the table here")
    parser.add_argument("--seeds", type=int, default=1, help="surveys of each kind")
    chosen = parser.parse_args()
    rows, open_ = rows_of(chosen, planned(chosen.seeds), named(kind), tried, line)
    if chosen.page:
        command = f"python studies/{Path(script).name} {' '.join(sys.argv[1:])}"
        chosen.page.write_text(page(command, rows, open_))


def of_recordings(
    title: str,
    words: str | None,
    planned: Callable[[str], Iterable[tuple[Any, ...]]],
    trial_of: Callable[[Row], Sequence[Any]],
    tried: Callable[[Any], Row],
    cells: Callable[[Row], Sequence[str]],
    tables: Callable[[list[Row]], str],
) -> None:
    """The command line of a study of measured recordings: run what is missing, print its tables and write the page.

    Parameters
    ----------
    words: its help, which is the page's too.
    planned: the trials of recordings whose name holds a word; trial_of, tried: as in `rows_of`.
    cells: of a row, printed when it is new; tables: of all rows.
    """
    parser = argparse.ArgumentParser(description=words, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_options(parser)
    parser.add_argument("--page", type=Path, help="write the tables here")
    parser.add_argument("--only", default="", help="recordings whose name holds this")
    chosen = parser.parse_args()
    rows, _ = rows_of(chosen, planned(chosen.only), trial_of, tried, lambda row: " | ".join(cells(row)))
    if chosen.page:
        chosen.page.write_text(f"# {title}\n\n{(words or '').strip()}\n\n{tables(rows)}\n", encoding="utf-8")
    print(tables(rows))


def named(kind: Any) -> Callable[[Row], Any]:
    """Reads a trial, a named tuple of that kind, out of a row that holds its fields among others."""
    return lambda row: kind(*(row[field] for field in kind._fields))


def _in_time(tried: Callable[[Any], Row], end: float, trial: Any) -> Row | None:
    """The row of a trial; None when the time is over."""
    return tried(trial) if time.time() < end else None
