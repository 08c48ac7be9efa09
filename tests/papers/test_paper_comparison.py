"""A figure of a paper beside ours: spreads, chance and reasons."""

import io

import numpy as np
import pytest
from paper_tables.comparison import EVERY, Comparison, Row
from paper_tables.page import document, show
from rich.console import Console

COLUMNS = ("a", "b")


def row(paper: list[float] | None, runs: int = 50, **more) -> Row:
    """Runs that scatter by exactly 1 about 10 and about 20."""
    ones = np.where(np.arange(runs) % 2, 1.0, -1.0) * np.sqrt((runs - 1) / runs)
    values = np.array([10.0, 20.0]) + ones[:, None]
    return Row("row", COLUMNS, values, None if paper is None else np.array(paper), **({"decimals": 4} | more))


def test_spread_holds_both_scatters_and_the_rounding() -> None:
    np.testing.assert_allclose(row([10, 20]).spread, np.sqrt(1 + 1 / 50), rtol=1e-6)
    np.testing.assert_allclose(row([10, 20], averaged=1000).spread, np.sqrt(1 / 1000 + 1 / 50), rtol=1e-6)
    np.testing.assert_allclose(row([10, 20], decimals=-1).spread, np.sqrt(1 + 1 / 50 + 100 / 12))
    np.testing.assert_allclose(row([12, 20]).difference, [2 / np.sqrt(1.02), 0], atol=1e-6)


def test_what_chance_does_not_do_needs_a_reason() -> None:
    assert row([12, 20]).unexplained() == []
    assert row([14, 20]).unexplained() == ["a"]
    assert row([14, 30], why={"a": "misprint"}).unexplained() == ["b"]
    assert row([14, 30], why={EVERY: "attitudes"}).unexplained() == []
    assert row(None).unexplained() == []


def test_few_runs_tell_the_scatter_badly() -> None:
    """Student's t: 3 sigma with one degree of freedom is 235 standard errors."""
    assert row([10, 20], runs=2).limit == pytest.approx(235.8, rel=0.01)
    assert row([10, 20], runs=1000).limit == pytest.approx(3.0, abs=0.02)


def test_page_and_terminal_show_the_same() -> None:
    found = Comparison("Table 9", "Ten runs.", [row([14, 20.5], why={"a": "a misprint"}), row(None)], ["A note."])
    assert found.unexplained() == []
    page = document([found], "# head\n")
    assert "| row | paper | 14.0000 | 20.5000 |" in page
    assert "- a misprint (row: a)" in page
    assert "Of the 1 figures without a reason here, 0 lie beyond one spread" in page
    console = Console(width=140, file=io.StringIO())
    show(console, found)
    text = console.file.getvalue()
    for words in ("Table 9", "14.0000", "a misprint (row: a)", "A note."):
        assert words in text
