"""A figure of a paper beside ours: how far apart, in units of what chance does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

Array = NDArray[np.float64]

EVERY = "every figure"
LIMIT = 3.0  # spreads beyond which chance is no reason: 1 figure in 370, were the scatter known exactly


@dataclass(frozen=True)
class Row:
    """A row of a paper's table and the runs that make it again.

    Attributes:
        label: what the row is.
        columns: K names.
        runs: (R, K) one line for each simulation.
        paper: (K,) as printed; None where the paper has no such row.
        decimals: of the print.
        averaged: how many simulations a printed figure is the mean of.
        why: reasons for differences: a column's name, or EVERY, to words.
    """

    label: str
    columns: tuple[str, ...]
    runs: Array
    paper: Array | None = None
    decimals: int = 4
    averaged: int = 1
    why: Mapping[str, str] = field(default_factory=dict)

    @property
    def mean(self) -> Array:
        """(K,) of the runs."""
        return np.asarray(self.runs.mean(axis=0))

    @property
    def scatter(self) -> Array:
        """(K,) standard deviation of one run; NaN of a single run."""
        if len(self.runs) < 2:
            return np.full(self.runs.shape[1], np.nan)
        return np.asarray(self.runs.std(axis=0, ddof=1))

    @property
    def spread(self) -> Array:
        """(K,) standard deviation of printed - mean where nothing but chance and the print's rounding is at work."""
        rounding = 10.0**-self.decimals / np.sqrt(12)
        return np.asarray(np.sqrt(self.scatter**2 * (1 / self.averaged + 1 / len(self.runs)) + rounding**2))

    @property
    def difference(self) -> Array:
        """(K,) printed - mean, in spreads; NaN where the paper has no figure."""
        if self.paper is None:
            return np.full(len(self.columns), np.nan)
        return np.asarray((self.paper - self.mean) / self.spread)

    def reason(self, column: str) -> str:
        """Why this figure differs; empty where chance has to do."""
        return self.why.get(column, self.why.get(EVERY, ""))

    @property
    def limit(self) -> float:
        """Spreads beyond which chance is no reason; more than `LIMIT` where few runs tell the scatter badly."""
        return float(t.ppf(norm.cdf(LIMIT), max(len(self.runs) - 1, 1)))

    def unexplained(self) -> list[str]:
        """Columns beyond what chance does, without a reason."""
        beyond = np.abs(self.difference) > self.limit
        return [c for c, far in zip(self.columns, beyond, strict=True) if far and not self.reason(c)]


@dataclass(frozen=True)
class Comparison:
    """One table of a paper.

    Attributes:
        title: which one; intro: what was done.
        rows: in the paper's order; notes: what else has to be said.
    """

    title: str
    intro: str
    rows: Sequence[Row]
    notes: Sequence[str] = ()

    def chance(self) -> str:
        """How many of the figures left to chance lie beyond one and two spreads, and how many should."""
        left = [
            abs(d)
            for row in self.rows
            for c, d in zip(row.columns, row.difference, strict=True)
            if np.isfinite(d) and not row.reason(c)
        ]
        if not left:
            return ""
        one, two = (sum(d > k for d in left) for k in (1, 2))
        expected = f"{0.317 * len(left):.1f} and {0.046 * len(left):.1f}"
        return (
            f"Of the {len(left)} figures without a reason here, {one} lie beyond one spread and {two} beyond two, the "
            f"farthest at {max(left):.1f}; chance puts {expected} there."
        )

    def reasons(self) -> list[str]:
        """One line for each reason given, with the figures beyond one spread that it is for."""
        given: dict[str, dict[str, list[str]]] = {}
        for row in self.rows:
            for c, d in zip(row.columns, row.difference, strict=True):
                if abs(d) > 1 and row.reason(c):
                    given.setdefault(row.reason(c), {}).setdefault(row.label, []).append(c)
        lines = []
        for words, where in given.items():
            figures = "; ".join(f"{label}: {', '.join(columns)}" for label, columns in where.items())
            lines.append(f"{words} ({figures})")
        return lines

    def unexplained(self) -> list[str]:
        """Figures that differ by more than chance does, without a reason."""
        return [f"{self.title}, {row.label}, {column}" for row in self.rows for column in row.unexplained()]
