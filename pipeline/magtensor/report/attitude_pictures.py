"""Pictures over the direction of the field: which attitudes were seen, and what is left at each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.report.drawing import ALARM, GRID, INK, MUTED, WASH, WIDTH, colour, label, legend, legend_height, panels
from magtensor.report.reduction import cell_means, disc, trend

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

    from magtensor.calibration.coverage import Cone, Coverage

RINGS = (30.0, 60.0)  # deg above the plane z = 0
REACH = 1.12  # of a disc's radius
TINTED = 181  # cells across a disc
MARKED = 4  # postures in the report's picture: those that its words name
AZIMUTHS = np.arange(-180.0, 180.1, 15.0)
ELEVATIONS = np.arange(-90.0, 90.1, 10.0)


def directions(b: Array) -> Array:
    """Unit vectors (..., 3) of fields; NaN where a field is not known or zero."""
    length = np.linalg.norm(b, axis=-1, keepdims=True)
    return np.divide(b, length, out=np.full_like(b, np.nan), where=length > 0)


def coverage(unit: Array, residual: Array | None, sensors: list[str], found: Sequence[Coverage | None] = ()) -> Figure:
    """Where each sensor's field pointed: two hemispheres in equal area, coloured by the mean residual.

    Args:
        unit: (N, S, 3) directions, NaN where not in use.
        residual: (N, S) nT, or None: then the directions alone.
        sensors: S names.
        found: of each sensor what its attitudes can determine: further postures and empty cones are marked.
    """
    across = 1 if len(sensors) == 1 else 2 if len(sensors) <= 4 else 3
    rows = -(-len(sensors) // across)
    height = {1: 2.8, 2: 2.3, 3: 1.5}[across]
    figure, axes_grid = panels(rows, 2 * across, height, gap=0.05, between=0.08, left=0.05, right=1.1)
    grid = axes_grid.ravel()
    maps: list[AxesImage] = []
    for i, name in enumerate(sensors):
        for axes, up in ((grid[2 * i], True), (grid[2 * i + 1], False)):
            axes.set_title(f"{label(name, 16)}  {'z > 0' if up else 'z < 0'}", loc="center")
            maps.append(hemisphere(axes, unit[:, i], None if residual is None else residual[:, i], up))
            if i < len(found) and (judged := found[i]) is not None:
                mark(axes, judged, up, MARKED)
    for axes in grid[2 * len(sensors) :]:
        axes.set_axis_off()
    if residual is None:
        return figure
    means = np.abs(np.stack([np.ma.filled(np.ma.asarray(m.get_array()), np.nan) for m in maps]))
    means = means[np.isfinite(means)]
    limit = float(np.percentile(means, 98)) if means.size and means.max() > 0 else 1.0
    for image in maps:
        image.set_clim(-limit, limit)
    tall = 1.8 / figure.get_figheight()
    beside = figure.add_axes((1 - 0.8 / WIDTH, 0.5 - tall / 2, 0.12 / WIDTH, tall))
    bar = figure.colorbar(maps[0], cax=beside, extend="both")
    bar.set_label("mean of |b| − F  (nT)")
    bar.outline.set_visible(False)
    return figure


def hemisphere(axes: Axes, unit: Array, residual: Array | None, up: bool) -> AxesImage:
    """Draw one half of the sphere with the directions (N, 3) seen in it, coloured by residual (N,) nT where given."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Circle

    _globe(axes)
    here = np.isfinite(unit).all(axis=1) & ((unit[:, 2] >= 0) == up)
    values = np.ones(int(here.sum())) if residual is None else residual[here]
    look: dict[str, Any] = {"cmap": "RdYlBu_r"} if residual is not None else {"cmap": ListedColormap([colour(0)])}
    image = axes.imshow(
        cell_means(disc(unit[here]), values),
        origin="lower", extent=(-1, 1, -1, 1), interpolation="none", zorder=2, **look,
    )  # fmt: skip
    axes.set_xlim(-REACH, REACH)  # the image had set its own
    axes.set_ylim(-REACH, REACH)
    image.set_clip_path(Circle((0, 0), 1.0, transform=axes.transData))
    return image


def mark(axes: Axes, found: Coverage, up: bool, most: int) -> None:
    """Number the further postures of one half of the sphere, and tint and outline the cones that hold no sample."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Circle

    if found.empty_cones:
        tint = np.where(_within(found.empty_cones, up), 0.0, np.nan)
        shade = axes.imshow(
            tint, origin="lower", extent=(-1, 1, -1, 1), cmap=ListedColormap([ALARM]), alpha=0.09, zorder=1
        )
        shade.set_clip_path(Circle((0, 0), 1.0, transform=axes.transData))
        axes.set_xlim(-REACH, REACH)
        axes.set_ylim(-REACH, REACH)
    for cone in found.empty_cones:
        axes.plot(*rim(cone, up).T, color=INK, linewidth=1.0, linestyle=(0, (4, 2)), zorder=4)
    round_it: dict[str, Any] = {"boxstyle": "circle,pad=0.2", "facecolor": WASH, "edgecolor": ALARM, "linewidth": 1.1}
    for k, direction in enumerate(found.further.directions[:most], 1):
        if (direction[2] >= 0) == up:
            x, y = disc(direction[None])[0]
            axes.text(
                x, y, str(k), ha="center", va="center", fontsize=7, color=ALARM, weight="bold", bbox=round_it, zorder=5
            )  # fmt: skip


def _within(cones: Sequence[Cone], up: bool) -> np.ndarray:
    """(TINTED, TINTED), first index along y: whether a direction of one half of the sphere lies in one of the cones."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, TINTED)] * 2)
    squared = np.minimum(x**2 + y**2, 1.0)
    height = (1.0 - squared) if up else (squared - 1.0)
    along = np.sqrt(2.0 - squared)  # of the disc's radius to that of the sphere: Lambert
    inside = [
        c.axis[0] * along * x + c.axis[1] * along * y + c.axis[2] * height >= np.cos(np.radians(c.half_angle_deg))
        for c in cones
    ]
    return np.any(inside, axis=0)


def rim(cone: Cone, up: bool) -> Array:
    """(M, 2) in the disc of one half of the sphere: the directions at a cone's half angle; NaN in the other half."""
    axis, half = np.array(cone.axis), np.radians(cone.half_angle_deg)
    some = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first = some / np.linalg.norm(some)
    turn = np.linspace(0, 2 * np.pi, 361)[:, None]
    across = np.cos(turn) * first + np.sin(turn) * np.cross(axis, first)
    direction = np.cos(half) * axis + np.sin(half) * across
    return np.where((direction[:, 2:] >= 0) == up, disc(direction), np.nan)


def _globe(axes: Axes) -> None:
    from matplotlib.patches import Circle

    axes.set_axis_off()
    axes.add_patch(Circle((0, 0), 1.0, facecolor=GRID, edgecolor=MUTED, linewidth=0.8, zorder=0))
    line: dict[str, Any] = {"color": MUTED, "linewidth": 0.5, "alpha": 0.45, "zorder": 3}
    for ring in RINGS:
        radius = np.sqrt(1 - np.sin(np.radians(ring)))
        axes.add_patch(Circle((0, 0), radius, fill=False, **line))
    axes.plot([-1, 1], [0, 0], **line)
    axes.plot([0, 0], [-1, 1], **line)
    axes.text(1.03, 0, "x", va="center", color=MUTED, fontsize=8)
    axes.text(0, 1.03, "y", ha="center", color=MUTED, fontsize=8)


def against_direction(unit: Array, residual: Array, sensors: list[str]) -> Figure:
    """The mean residual against the azimuth and the elevation of the field; bars are two standard errors.

    Args: as for `coverage`, `residual` not None.
    """
    figure, grid = panels(1, 2, 2.15, top=legend_height(sensors) - 0.2, gap=0.3, sharey=True)
    azimuth = np.degrees(np.arctan2(unit[..., 1], unit[..., 0]))
    elevation = np.degrees(np.arcsin(np.clip(unit[..., 2], -1.0, 1.0)))
    handles = []
    for axes, angle, edges, words in (
        (grid[0, 0], azimuth, AZIMUTHS, "azimuth of the field from x towards y  (deg)"),
        (grid[0, 1], elevation, ELEVATIONS, "elevation of the field towards z  (deg)"),
    ):
        shift = 0.5 * (edges[1] - edges[0]) / max(len(sensors), 1)
        for i in range(len(sensors)):
            found = trend(angle[:, i], residual[:, i], edges)
            at = found.centre + (i - 0.5 * (len(sensors) - 1)) * shift
            drawn = axes.errorbar(
                at, found.mean, 2 * found.error, color=colour(i), linewidth=0.9, marker="o", markersize=2.6,
                elinewidth=0.8,
            )  # fmt: skip
            if axes is grid[0, 0]:
                handles.append(drawn)
        axes.axhline(0.0, color=INK, linewidth=0.5)
        axes.set_xlabel(words)
        axes.set_xlim(edges[0], edges[-1])
        axes.set_xticks(edges[:: 6 if len(edges) > 20 else 3])
    grid[0, 0].set_ylabel("mean |b| − F  (nT)")
    legend(figure, handles, sensors)
    return figure
