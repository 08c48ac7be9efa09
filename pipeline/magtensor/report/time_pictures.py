"""Pictures over time: residuals, tensor, closure, invariants, and the reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from magtensor.accuracy import COMPONENTS
from magtensor.calibration.types import Array
from magtensor.report.clock import Clock, clock
from magtensor.report.drawing import (
    INK,
    MUTED,
    WASH,
    around,
    colour,
    label,
    legend,
    legend_height,
    nothing,
    panels,
    trace,
)  # fmt: skip
from magtensor.report.reduction import COLUMNS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AXIS = ("x", "y", "z")


def total_field_residual(
    time: Array, units: str, residual: Array, before: Array | None, noise: Array, sensors: list[str]
) -> Figure:
    """|b| - F of each sensor over time, with the band of twice its noise; before calibration in a small panel.

    Args:
        time: (N,) s on the epoch of `units`.
        residual, before: (N, S) nT, NaN where not in use.
        noise: (S,) nT, NaN where unknown.
        sensors: S names.
    """
    count = len(sensors)
    figure, grid = panels(count, 2, 0.9, gap=0.2, right=0.62, sharex=True, width_ratios=(4.2, 1.0))
    axis = clock(time, units)
    for i, (main, small) in enumerate(grid):
        if np.isfinite(noise[i]):
            main.axhspan(-2 * noise[i], 2 * noise[i], color=WASH, zorder=0)
            main.axhline(2 * noise[i], color=MUTED, linewidth=0.6, linestyle=(0, (4, 3)))
            main.axhline(-2 * noise[i], color=MUTED, linewidth=0.6, linestyle=(0, (4, 3)))
        trace(main, axis.values, residual[:, i], colour(i))
        around(main, residual[:, i], 2.4 * np.nan_to_num(noise[i]))
        main.set_title(label(sensors[i]))
        main.set_ylabel("|b| − F  (nT)")
        small.set_title("before")
        small.yaxis.tick_right()
        small.spines["right"].set_visible(True)
        small.spines["left"].set_visible(False)
        if before is None or not np.isfinite(before[:, i]).any():
            nothing(small, "not stored")
        else:
            trace(small, axis.values, before[:, i], MUTED, columns=160)
    _label_time(grid[-1][0], axis)
    grid[-1][1].set_xlabel(axis.unit)
    return figure


def contrast(time: Array, units: str, values: Array, noise: Array, sensors: list[str]) -> Figure:
    """Each sensor's field less the mean of all, three axes to a panel.

    Args:
        values: (N, S, 3) nT, NaN where not in use.
        noise: (S,) nT what noise alone makes of each contrast.
    """
    figure, grid = panels(len(sensors), 1, 0.85, top=legend_height(AXIS) - 0.1, sharex=True)
    axis = clock(time, units)
    for i, axes in enumerate(grid[:, 0]):
        if np.isfinite(noise[i]):
            axes.axhspan(-2 * noise[i], 2 * noise[i], color=WASH, zorder=0)
        for k in range(3):
            trace(axes, axis.values, values[:, i, k], colour(k))
        around(axes, values[:, i])
        axes.set_title(label(sensors[i]))
        axes.set_ylabel("nT")
    legend(figure, _swatches(3), AXIS)
    _label_time(grid[-1, 0], axis)
    return figure


def tensor(time: Array, units: str, values: Array, std: Array | None) -> Figure:
    """The six components with a band of one standard deviation each side.

    Args:
        values: (N, 3, 3) nT/m, NaN where not in use; std: the same shape, or None.
    """
    figure, grid = panels(3, 2, 1.35, sharex=True)
    axis = clock(time, units)
    for i, (axes, name) in enumerate(zip(grid.T.ravel(), COMPONENTS, strict=True)):
        row, column = (AXIS.index(c) for c in name)
        _with_band(axes, axis, values[:, row, column], None if std is None else std[:, row, column], colour(i))
        axes.set_title(f"B{name}")
        axes.set_ylabel("nT/m")
    for axes in grid[-1]:
        _label_time(axes, axis)
    return figure


def closure(time: Array, units: str, values: Array, names: list[str]) -> Figure:
    """What Maxwell's equations make zero, as far as it was measured. `values`: (N, K) nT/m of the `names`."""
    figure, grid = panels(len(names), 1, 0.85, sharex=True)
    axis = clock(time, units)
    for i, (axes, name) in enumerate(zip(grid[:, 0], names, strict=True)):
        trace(axes, axis.values, values[:, i], colour(i))
        axes.axhline(0.0, color=INK, linewidth=0.5)
        axes.set_title(label(name))
        axes.set_ylabel("nT/m")
    _label_time(grid[-1, 0], axis)
    return figure


def invariants(time: Array, units: str, values: Array, std: Array | None, names: list[str], of: list[str]) -> Figure:
    """The rotation invariants with one standard deviation each side.

    Args:
        values: (N, K); std: the same shape, or None; names: K; of: their K units.
    """
    rows = (len(names) + 1) // 2
    figure, grid = panels(rows, 2, 1.15, sharex=True)
    axis = clock(time, units)
    for i, axes in enumerate(grid.ravel()):
        if i >= len(names):
            axes.set_axis_off()
            continue
        _with_band(axes, axis, values[:, i], None if std is None else std[:, i], colour(i))
        axes.set_title(label(names[i]))
        axes.set_ylabel(label(of[i]))
    for axes in grid[-1]:
        _label_time(axes, axis)
    return figure


def reference(time: Array, units: str, total_field: Array | None, diurnal: Array | None) -> Figure:
    """The total field the sensors were held against, and its diurnal variation. (N,) nT each."""
    shown = [(v, w) for v, w in ((total_field, "total field F"), (diurnal, "diurnal variation")) if v is not None]
    figure, grid = panels(len(shown), 1, 1.05, left=1.0, sharex=True)  # five digits and more stand at the left
    axis = clock(time, units)
    for i, (axes, (values, words)) in enumerate(zip(grid[:, 0], shown, strict=True)):
        trace(axes, axis.values, values, colour(i))
        axes.set_title(words)
        axes.set_ylabel("nT")
    _label_time(grid[-1, 0], axis)
    return figure


def _with_band(axes: Axes, axis: Clock, values: Array, std: Array | None, paint: str) -> None:
    trace(axes, axis.values, values, paint, COLUMNS // 2, std)
    axes.axhline(0.0, color=INK, linewidth=0.5)


def _label_time(axes: Axes, axis: Clock) -> None:
    axes.set_xlabel(axis.label)
    axes.margins(x=0.01)


def _swatches(count: int) -> list[object]:
    from matplotlib.lines import Line2D

    return [Line2D([], [], color=colour(k), linewidth=2) for k in range(count)]
