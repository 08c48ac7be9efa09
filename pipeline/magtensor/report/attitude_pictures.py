"""Pictures over the direction of the field: which attitudes were seen, and what is left at each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.report.drawing import GRID, INK, MUTED, WASH, colour, label, legend, new_figure
from magtensor.report.reduction import cell_means, disc, trend

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection
    from matplotlib.figure import Figure

RINGS = (30.0, 60.0)  # deg above the plane z = 0
AZIMUTHS = np.arange(-180.0, 180.1, 15.0)
ELEVATIONS = np.arange(-90.0, 90.1, 10.0)


def directions(b: Array) -> Array:
    """Unit vectors (..., 3) of fields; NaN where a field is not known or zero."""
    length = np.linalg.norm(b, axis=-1, keepdims=True)
    return np.divide(b, length, out=np.full_like(b, np.nan), where=length > 0)


def coverage(unit: Array, residual: Array | None, sensors: list[str]) -> Figure:
    """Where each sensor's field pointed: two hemispheres in equal area, coloured by the mean residual.

    Args:
        unit: (N, S, 3) directions, NaN where not in use.
        residual: (N, S) nT, or None: then the directions alone.
        sensors: S names.
    """
    across = 1 if len(sensors) == 1 else 2 if len(sensors) <= 4 else 3
    rows = -(-len(sensors) // across)
    figure = new_figure(0.3 + (1.85 if across == 3 else 2.7) * rows)
    grid = figure.subplots(rows, 2 * across, squeeze=False).ravel()
    dots = []
    for i, name in enumerate(sensors):
        for axes, up in ((grid[2 * i], True), (grid[2 * i + 1], False)):
            _globe(axes)
            axes.set_title(f"{label(name, 16)}  {'z > 0' if up else 'z < 0'}", loc="center")
            dots.append(_hemisphere(axes, unit[:, i], None if residual is None else residual[:, i], up))
    for axes in grid[2 * len(sensors) :]:
        axes.set_axis_off()
    if residual is None:
        return figure
    means = np.concatenate([d.get_array() for d in dots if d is not None] or [np.zeros(0)])
    means = np.abs(np.ma.filled(np.ma.masked_invalid(means), 0.0))
    limit = float(np.percentile(means, 98)) if means.size and means.max() > 0 else 1.0
    shown = [d for d in dots if d is not None]
    for d in shown:
        d.set_clim(-limit, limit)
    if shown:
        bar = figure.colorbar(shown[0], ax=list(grid), shrink=0.75 / rows**0.5, pad=0.01, aspect=24, extend="both")
        bar.set_label("mean of |b| − F  (nT)")
        bar.outline.set_visible(False)
    return figure


def _hemisphere(axes: Axes, unit: Array, residual: Array | None, up: bool) -> PathCollection | None:
    here = np.isfinite(unit).all(axis=1) & ((unit[:, 2] >= 0) == up)
    if not here.any():
        return None
    values = np.full(int(here.sum()), np.nan) if residual is None else residual[here]
    place, mean = cell_means(disc(unit[here]), values)
    look: dict[str, Any] = {"c": colour(0)} if residual is None else {"c": mean, "cmap": "RdBu_r"}
    return axes.scatter(place[:, 0], place[:, 1], s=9, linewidths=0, rasterized=True, **look)


def _globe(axes: Axes) -> None:
    from matplotlib.patches import Circle

    axes.set_aspect("equal")
    axes.set_xlim(-1.12, 1.12)
    axes.set_ylim(-1.12, 1.12)
    axes.set_axis_off()
    axes.add_patch(Circle((0, 0), 1.0, facecolor=WASH, edgecolor=MUTED, linewidth=0.8, zorder=0))
    for ring in RINGS:
        radius = np.sqrt(1 - np.sin(np.radians(ring)))
        axes.add_patch(Circle((0, 0), radius, fill=False, edgecolor=GRID, linewidth=0.7, zorder=0.5))
    axes.plot([-1, 1], [0, 0], color=GRID, linewidth=0.7, zorder=0.5)
    axes.plot([0, 0], [-1, 1], color=GRID, linewidth=0.7, zorder=0.5)
    axes.text(1.03, 0, "x", va="center", color=MUTED, fontsize=8)
    axes.text(0, 1.03, "y", ha="center", color=MUTED, fontsize=8)


def against_direction(unit: Array, residual: Array, sensors: list[str]) -> Figure:
    """The mean residual against the azimuth and the elevation of the field; bars are two standard errors.

    Args: as for `coverage`, `residual` not None.
    """
    figure = new_figure(3.0)
    panels = figure.subplots(1, 2, sharey=True)
    azimuth = np.degrees(np.arctan2(unit[..., 1], unit[..., 0]))
    elevation = np.degrees(np.arcsin(np.clip(unit[..., 2], -1.0, 1.0)))
    handles = []
    for axes, angle, edges, words in (
        (panels[0], azimuth, AZIMUTHS, "azimuth of the field from x towards y  (deg)"),
        (panels[1], elevation, ELEVATIONS, "elevation of the field towards z  (deg)"),
    ):
        shift = 0.5 * (edges[1] - edges[0]) / max(len(sensors), 1)
        for i in range(len(sensors)):
            found = trend(angle[:, i], residual[:, i], edges)
            at = found.centre + (i - 0.5 * (len(sensors) - 1)) * shift
            drawn = axes.errorbar(
                at, found.mean, 2 * found.error, color=colour(i), linewidth=0.9, marker="o", markersize=2.6,
                elinewidth=0.8,
            )  # fmt: skip
            if axes is panels[0]:
                handles.append(drawn)
        axes.axhline(0.0, color=INK, linewidth=0.5)
        axes.set_xlabel(words)
        axes.set_xlim(edges[0], edges[-1])
        axes.set_xticks(edges[:: 6 if len(edges) > 20 else 3])
    panels[0].set_ylabel("mean |b| − F  (nT)")
    legend(figure, handles, sensors)
    return figure
