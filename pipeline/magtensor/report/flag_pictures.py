"""The flag record as a ribbon over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.in_a_row import in_a_row
from magtensor.report.clock import clock
from magtensor.report.drawing import WASH, colour, label, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SLOTS = 1200  # of the ribbon's length; runs within one slot are drawn as one
MOST_REASONS = 8


def reasons(flags: Sequence[Mapping[str, Any]]) -> list[str]:
    """`stage: reason` of every flag, once each, most samples first."""
    totals: dict[str, int] = {}
    for flag in flags:
        totals[_reason(flag)] = totals.get(_reason(flag), 0) + int(flag["samples"])
    return sorted(totals, key=lambda reason: (-totals[reason], reason))


def _reason(flag: Mapping[str, Any]) -> str:
    return f"{flag['by']}: {flag['reason']}"


def ribbon(time: Array, units: str, flags: Sequence[Mapping[str, Any]], sensors: list[str]) -> Figure:
    """When samples were taken out of use, a row for each sensor and one for the whole array, coloured by reason.

    Args:
        time: (N,) s of the survey, for its span.
        flags: the flag record.
        sensors: names of the sensors with a row.
    """
    from matplotlib.lines import Line2D

    rows = ["", *sensors] if any(not f["sensor"] for f in flags) else list(sensors)
    known = reasons(flags)
    axis = clock(time, units)
    figure, grid = panels(1, 1, 0.24 * len(rows), top=0.2 * min(len(known), MOST_REASONS), left=1.9)
    axes = grid[0, 0]
    end = float(axis.values[-1]) if len(axis.values) else 0.0
    span = end if end > 0 else 1.0
    for row, sensor in enumerate(rows):
        axes.broken_barh([(0.0, span)], (row - 0.35, 0.7), facecolor=WASH, zorder=1)
        for k, reason in enumerate(known):
            here = [f for f in flags if f["sensor"] == sensor and _reason(f) == reason]
            runs = _runs(here, axis.origin, axis.scale, span)
            if runs:
                paint = colour(min(k, MOST_REASONS - 1))
                axes.broken_barh(runs, (row - 0.35, 0.7), facecolor=paint, linewidth=0, zorder=2)
    axes.set_yticks(range(len(rows)), [label(r) if r else "whole array" for r in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlim(0.0, span)
    axes.grid(False)
    axes.set_xlabel(axis.label)
    shown = [*known[: MOST_REASONS - 1], "other reasons"] if len(known) > MOST_REASONS else known
    handles = [Line2D([], [], color=colour(k), linewidth=5, solid_capstyle="butt") for k in range(len(shown))]
    figure.legend(handles, [label(s, 110) for s in shown], loc="upper left", ncols=1, borderaxespad=0.2)
    return figure


def _runs(flags: Sequence[Mapping[str, Any]], origin: float, scale: float, span: float) -> list[tuple[float, float]]:
    """(start, length) on the axis, at least one slot long, neighbours joined."""
    filled = np.zeros(SLOTS, dtype=bool)
    for flag in flags:
        first, last = ((float(flag[k]) - origin) / scale / span * SLOTS for k in ("start", "stop"))
        if np.isfinite([first, last]).all():
            filled[int(np.clip(first, 0, SLOTS - 1)) : int(np.clip(last, 0, SLOTS - 1)) + 1] = True
    return [(a / SLOTS * span, (b - a) / SLOTS * span) for a, b in in_a_row(filled)]
