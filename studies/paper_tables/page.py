"""The comparisons as tables: on the terminal and in Markdown, from one set of cells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
from rich.console import Console
from rich.table import Table

from .comparison import Comparison, Row


def cells(row: Row) -> Iterator[tuple[str, list[str]]]:
    """The lines of one row: their names and a text for each column."""
    if row.paper is not None:
        yield "paper", [f"{x:.{row.decimals}f}" for x in row.paper]
    yield "magtensor", [f"{x:.{row.decimals}f}" for x in row.mean]
    if np.isfinite(row.scatter).all():
        yield "one run's scatter", [f"{x:.2g}" for x in row.scatter]
    if row.paper is not None:
        yield "difference / spread", [f"{x:+.1f}" for x in row.difference]


def blocks(comparison: Comparison) -> Iterator[tuple[tuple[str, ...], list[Row]]]:
    """Rows that follow each other with the same columns."""
    for columns, rows in groupby(comparison.rows, key=lambda r: r.columns):
        yield columns, list(rows)


def remarks(comparison: Comparison) -> list[str]:
    """What stands below the tables."""
    return [*comparison.reasons(), *filter(None, [comparison.chance()]), *comparison.notes]


def show(console: Console, comparison: Comparison) -> None:
    """Print one comparison."""
    console.rule(f"[bold]{comparison.title}", align="left")
    console.print(comparison.intro)
    for columns, rows in blocks(comparison):
        table = Table(box=None, header_style="bold", pad_edge=False)
        for name in ("", "", *columns):
            table.add_column(name, justify="right" if name else "left", no_wrap=True)
        for row in rows:
            for i, (name, texts) in enumerate(cells(row)):
                table.add_row(row.label if i == 0 else "", name, *texts)
        console.print(table)
    for remark in remarks(comparison):
        console.print(f"- {remark}", highlight=False)
    console.print()


def markdown(comparison: Comparison) -> str:
    """The same as Markdown."""
    lines = [f"## {comparison.title}", "", comparison.intro, ""]
    for columns, rows in blocks(comparison):
        lines.append("| | | " + " | ".join(columns) + " |")
        lines.append("|---|---|" + "---:|" * len(columns))
        for row in rows:
            for i, (name, texts) in enumerate(cells(row)):
                lines.append("| " + " | ".join([row.label if i == 0 else "", name, *texts]) + " |")
        lines.append("")
    lines += [f"- {remark}" for remark in remarks(comparison)]
    return "\n".join([*lines, ""])


def document(comparisons: Sequence[Comparison], head: str) -> str:
    """The whole page."""
    return "\n".join([head, *(markdown(c) for c in comparisons)])
