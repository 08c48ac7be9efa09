"""The look of the pictures, and how a matplotlib figure becomes a piece of the page.

Figures are drawn in the colours of light paper; in the SVG each colour becomes a CSS variable, so that the same
picture follows the reader's dark or light scheme and prints dark on white.
"""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.report.reduction import COLUMNS, envelope

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

# (light, dark); the light ones are told apart by readers who do not see red from green (Okabe and Ito)
INK, MUTED, GRID, WASH, ALARM = "#1c2733", "#5d6b7a", "#dde3ea", "#eef2f6", "#b42318"
SERIES = ("#0a6fb0", "#cf5a00", "#00876a", "#b3528f", "#8a6d00", "#3f96d4", "#6b4fbb", "#707b86")
DARK = {
    INK: "#dfe6ee", MUTED: "#9aa8b6", GRID: "#313d4a", WASH: "#222c37", ALARM: "#ff8a7a",
    "#0a6fb0": "#5fb3f0", "#cf5a00": "#ff9a4d", "#00876a": "#3ecfa8", "#b3528f": "#e58fc4",
    "#8a6d00": "#d9b945", "#3f96d4": "#9ad0fb", "#6b4fbb": "#b09cf5", "#707b86": "#b3bdc7",
}  # fmt: skip
FONTS = "system-ui,'Segoe UI','Helvetica Neue',Arial,'DejaVu Sans',sans-serif"
MEANS_PER_COLUMN = 4  # a slow change shows better in fewer, quieter means
WIDTH = 10.6  # inches, of a picture as wide as the page
LEFT, RIGHT, BOTTOM, TITLE = 0.78, 0.12, 0.46, 0.24  # inches of the margins and above each axes
LEGEND_COLUMNS = 7
MOST_SENSORS = 12  # rows of a picture
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none", "svg.hashsalt": "magtensor", "text.parse_math": False, "font.size": 8.5,
    "font.family": ["DejaVu Sans"], "axes.titlesize": 8.5, "axes.titleweight": "bold", "axes.titlelocation": "left",
    "axes.titlepad": 4.0, "axes.titley": 1.0, "axes.labelsize": 8.5, "axes.linewidth": 0.7, "axes.edgecolor": MUTED,
    "axes.labelcolor": INK, "axes.titlecolor": INK, "axes.facecolor": "none", "axes.spines.top": False,
    "axes.spines.right": False, "axes.grid": True, "axes.axisbelow": True, "axes.formatter.useoffset": False,
    "axes.unicode_minus": True, "grid.color": GRID, "grid.linewidth": 0.6, "text.color": INK, "xtick.color": MUTED,
    "ytick.color": MUTED, "xtick.labelcolor": INK, "ytick.labelcolor": INK, "xtick.labelsize": 8, "ytick.labelsize": 8,
    "figure.facecolor": "none", "savefig.facecolor": "none", "legend.frameon": False, "legend.fontsize": 8,
    "lines.solid_capstyle": "round", "path.simplify": True, "date.converter": "auto",
}  # fmt: skip


@dataclass(frozen=True)
class Picture:
    """A figure ready for the page: a data URI of an SVG, its size in CSS pixels, and the words around it."""

    title: str
    caption: str
    uri: str
    width: int
    height: int


def picture(title: str, caption: str, draw: Callable[[], Figure]) -> Picture:
    """Draw a figure in the report's style and make it a picture; the same data give the same bytes."""
    import matplotlib

    with matplotlib.rc_context(STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")  # the reader's browser has other fonts
        figure = draw()
        text = svg(figure)
    width, height = figure.get_size_inches() * 96
    data = base64.b64encode(text.encode()).decode("ascii")
    return Picture(title, caption, f"data:image/svg+xml;base64,{data}", round(width), round(height))


def svg(figure: Figure) -> str:
    """A figure as SVG text: colours as CSS variables, the reader's own fonts, coordinates to a tenth of a point."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r' (?:d|x|y)="[^"]*"', lambda m: _short(m[0]), text)
    text = re.sub(r'style="[^"]*"', lambda m: _with_variables(m[0]), text)
    head = text.index(">") + 1
    return f"{text[:head]}<style>{_scheme()}</style>{text[head:]}"


def _short(coordinates: str) -> str:
    """Path data to a tenth of a point, without the letters and blanks that SVG lets one leave out."""
    coordinates = re.sub(r"(\.\d)\d+", r"\1", coordinates)
    return re.sub(r"\s*\n(?:L )?", " ", coordinates).replace(".0 ", " ") if ' d="' in coordinates else coordinates


def _with_variables(style: str) -> str:
    style = style.replace("'DejaVu Sans'", FONTS)
    return re.sub(r"#[0-9a-f]{6}", lambda m: f"var(--c{m[0][1:]},{m[0]})" if m[0] in DARK else m[0], style)


def _scheme() -> str:
    dark = ";".join(f"--c{light[1:]}:{dark}" for light, dark in DARK.items())
    return f"@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}"


def panels(
    rows: int, columns: int, row_height: float, *, top: float = 0.06, gap: float = 0.85, between: float = 0.12,
    left: float = LEFT, right: float = RIGHT, **options: Any,
) -> tuple[Figure, Any]:  # fmt: skip
    """A figure of the page's width with a grid of axes, laid out by rule: no drawing is needed to place anything.

    Args:
        rows, columns: of the grid.
        row_height: inches of an axes' height; a title stands above each.
        top: inches kept free for a legend.
        gap: inches between columns; between: inches between rows, beside the room for a title.
        left, right: inches of the margins.
        options: for `Figure.subplots`.

    Returns:
        the figure and the axes (rows, columns).
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as NewFigure

    step = row_height + TITLE + between
    height = top + rows * step - between + BOTTOM
    figure = NewFigure(figsize=(WIDTH, height), dpi=96)
    FigureCanvasAgg(figure)
    across = (WIDTH - left - right - gap * (columns - 1)) / columns
    grid = {
        "left": left / WIDTH, "right": 1 - right / WIDTH, "bottom": BOTTOM / height, "top": 1 - (top + TITLE) / height,
        "wspace": gap / across, "hspace": (TITLE + between) / row_height,
    }  # fmt: skip
    return figure, figure.subplots(rows, columns, squeeze=False, gridspec_kw=grid, **options)


def label(text: str, most: int = 28) -> str:
    """A name from the data as it may stand in a picture: one short line of printable text."""
    line = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    line = line if len(line) <= most else f"{line[: most - 1]}\N{HORIZONTAL ELLIPSIS}"
    return f"\N{THIN SPACE}{line}" if line.startswith("_") else line  # matplotlib hides labels that begin with _


def colour(i: int) -> str:
    """The colour of the i-th sensor or component."""
    return SERIES[i % len(SERIES)]


def trace(
    axes: Axes, time: Array, values: Array, colour: str, columns: int = COLUMNS, std: Array | None = None
) -> None:
    """Draw a series so that every extreme shows, whatever its length; where samples are many, a dark line of means.

    `std` (N,): a band of one standard deviation each side of the line.
    """
    found = envelope(time, values, columns)
    many = found.samples > 2 * columns
    look: dict[str, Any] = {"linewidth": 0.8, "alpha": 0.9}
    if many:
        axes.plot(*found.zigzag, color=colour, linewidth=0.8, alpha=0.38)
        columns //= MEANS_PER_COLUMN
        found, look = envelope(time, values, columns), {"linewidth": 1.1}
    elif found.samples <= 300:
        look |= {"marker": "o", "markersize": 2.2, "markeredgewidth": 0}
    axes.plot(found.time, found.mean, color=colour, **look)
    if std is not None:
        # over the samples of `values`, so that both have the same columns
        wide = envelope(time, np.where(np.isfinite(values), np.nan_to_num(std), np.nan), columns).mean
        axes.fill_between(found.time, found.mean - wide, found.mean + wide, color=colour, alpha=0.3, linewidth=0)


def around(axes: Axes, values: Array, least: float = 0.0) -> None:
    """Limits of the y axis that hold every finite value, at least `least` each side, symmetric about zero."""
    known = values[np.isfinite(values)]
    reach = max(float(np.abs(known).max()) if known.size else 0.0, least)
    axes.set_ylim(*((-1.08 * reach, 1.08 * reach) if reach > 0 else (-1.0, 1.0)))


def decades(axis: Axis) -> None:
    """Tick labels of a logarithmic axis in plain text: powers of ten, and 2 and 5 between them where they are few."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = sorted(axis.get_view_interval())
    between = (1.0, 2.0, 5.0) if high < 30 * low else (1.0,)
    axis.set_major_locator(LogLocator(subs=between, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}" if 1e-4 <= value < 1e6 else f"{value:.0e}"))
    axis.set_minor_formatter(NullFormatter())


def nothing(axes: Axes, words: str) -> None:
    """Say in an empty panel why it is empty."""
    axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center", va="center", color=MUTED)


def legend(figure: Figure, handles: Sequence[Any], names: Sequence[str]) -> None:
    """One legend above all panels."""
    columns = min(len(names), LEGEND_COLUMNS)
    figure.legend(
        handles, [label(n, 18) for n in names], loc="upper right", ncols=columns, borderaxespad=0.2,
        bbox_to_anchor=(1 - RIGHT / WIDTH, 1.0),
    )  # fmt: skip


def legend_height(names: Sequence[str]) -> float:
    """Inches that `legend` takes."""
    return 0.12 + 0.18 * -(-len(names) // LEGEND_COLUMNS)
