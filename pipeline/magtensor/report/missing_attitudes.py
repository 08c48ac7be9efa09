"""The picture of missing attitudes: where each sensor's field pointed, and which further postures would help most."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from magtensor.calibration.coverage import Coverage
from magtensor.calibration.types import Array
from magtensor.report.attitude_pictures import hemisphere, mark
from magtensor.report.drawing import ALARM, INK, MUTED, WASH, WIDTH, colour, label
from magtensor.report.reduction import disc

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DISC, LINE, MARGIN, HEAD, FOOT = 2.35, 0.165, 0.15, 0.75, 1.5  # inches
WORDS_AT, WORDS_WIDE = 5.35, 78  # inches from the left; characters
FEW = 60  # attitudes that are dots rather than cells
ALONG, SHARED = 0.94, 0.34  # cosines of 20 and 70 deg from an axis
EXPLAINED = (
    "Each disc is one half of all directions that the field can have in the sensor's own axes, seen from +z, equal "
    "areas drawn equal: +z or -z in the middle, x to the right, y up; rings at 30 and 60 deg above the plane z = 0. "
    "Further postures are numbered in the order in which they help: turn the array until the field points along the "
    "direction given, and rest there as long as in a posture so far. A number is the same posture for all sensors. "
    "Worst error: the standard deviation of |b| in the worst direction of the whole sphere after this posture and "
    "those before it, as a multiple of the noise of one sample; unknown: the attitudes leave a parameter open."
)
ALONE = (
    " Each sensor is judged alone; calibrate_joint and close_loop, which fit all sensors together, do with somewhat "
    "less where the tilt is limited."
)


@dataclass(frozen=True)
class Seen:
    """The attitudes of one sensor.

    Attributes:
        sensor: its name.
        unit: (N, 3) directions of the field in the sensor's axes.
        found: what they can determine.
    """

    sensor: str
    unit: Array
    found: Coverage

    @property
    def verdict(self) -> str:
        """One sentence."""
        if self.found.determined:
            return "The attitudes determine scale factors, angles and offsets."
        missing = f"; {self.found.missing}" if self.found.missing else ""
        return f"NOT determined: {'; '.join(self.found.faults)}{missing}."

    @property
    def postures(self) -> list[str]:
        """A line for each further posture, after one that says how it stands now."""
        further = self.found.further
        if not len(further.directions):
            return []
        lines = [
            f"     {'further posture: the field along':<47}worst error",
            f"     {'none':<47}{_error(further.error[0])}",
        ]
        for k, (direction, error) in enumerate(zip(further.directions, further.error[1:], strict=True), 1):
            x, y, z = direction
            lines.append(f"{k:>3}  ({x:+.2f}, {y:+.2f}, {z:+.2f})  {in_words(direction):<24}{_error(error)}")
        evenly = 3.0 / np.sqrt(further.samples)
        return [*lines, f"     {'as many samples spread over the whole sphere':<47}{_error(evenly)}"]


def _error(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "unknown"


def in_words(direction: Array) -> str:
    """A unit vector by the half axes it is near to: `along +z`, `between +x and -z`, `amid +x, +y and -z`."""
    order = np.argsort(-np.abs(direction), kind="stable")
    near = [f"{'+' if direction[k] > 0 else '-'}{'xyz'[k]}" for k in order if abs(direction[k]) > SHARED]
    if abs(direction[order[0]]) > ALONG or len(near) == 1:
        return f"along {near[0]}"
    return f"between {near[0]} and {near[1]}" if len(near) == 2 else f"amid {near[0]}, {near[1]} and {near[2]}"


def picture(seen: Sequence[Seen], title: str, more: str = "") -> Figure:
    """A row for each sensor: both halves of the sphere, the verdict, the further postures.

    Args:
        seen: sensors in order.
        title: of the whole picture; more: what else is to be said, below it.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as NewFigure

    texts = [(textwrap.wrap(s.verdict, WORDS_WIDE), s.postures) for s in seen]
    rows = [max(DISC + 0.45, LINE * (len(words) + len(lines) + 2.5)) for words, lines in texts]
    height = HEAD + sum(rows) + FOOT
    figure = NewFigure(figsize=(WIDTH, height), dpi=96)
    FigureCanvasAgg(figure)

    def write(x: float, down: float, text: str, **look: str | float) -> None:
        figure.text(x / WIDTH, 1 - down / height, text, va="top", **look)  # type: ignore[arg-type]

    write(MARGIN, 0.12, label(title, 110), fontsize=11, weight="bold")
    write(MARGIN, 0.36, "\n".join(textwrap.wrap(more, 150)), color=MUTED)
    _legend(figure)
    down = HEAD
    for one, (words, lines), row in zip(seen, texts, rows, strict=True):
        for k, up in enumerate((True, False)):
            left, bottom = MARGIN + k * (DISC + 0.15), height - down - DISC - 0.3
            axes = figure.add_axes((left / WIDTH, bottom / height, DISC / WIDTH, DISC / height))
            axes.set_title(f"{label(one.sensor, 16)}  {'z > 0' if up else 'z < 0'}", loc="center")
            hemisphere(axes, one.unit, None, up)
            if one.found.distinct <= FEW:
                here = one.unit[(one.unit[:, 2] >= 0) == up]
                axes.plot(*disc(here).T, linestyle="", marker="o", markersize=4.5, color=colour(0), zorder=3)
            mark(axes, one.found, up, len(one.found.further.directions))
        write(WORDS_AT, down + 0.1, label(one.sensor, 60), weight="bold", fontsize=9)
        write(WORDS_AT, down + 0.3, "\n".join(words), color=INK if one.found.determined else ALARM, linespacing=1.25)
        below = down + 0.38 + LINE * len(words)
        write(WORDS_AT, below, "\n".join(lines), family="DejaVu Sans Mono", fontsize=7.5, linespacing=1.3)
        down += row
    write(MARGIN, down + 0.15, "\n".join(textwrap.wrap(EXPLAINED + ALONE * (len(seen) > 1), 165)), color=MUTED)
    return figure


def _legend(figure: Figure) -> None:
    from matplotlib.lines import Line2D

    kinds = [
        Line2D([], [], linestyle="", marker="s", markersize=6, color=colour(0), label="directions seen"),
        Line2D(
            [], [], linestyle="", marker="o", markersize=9, markerfacecolor=WASH, markeredgecolor=ALARM,
            label="further posture that would help most",
        ),
        Line2D([], [], linestyle=(0, (4, 2)), color=INK, linewidth=1.0, label="rim of a tinted cone without a sample"),
    ]  # fmt: skip
    figure.legend(handles=kinds, loc="upper right", ncols=1, borderaxespad=0.4)
