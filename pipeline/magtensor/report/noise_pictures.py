"""Pictures that hold the residual against noise: its spectrum and its distribution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from magtensor.calibration.types import Array
from magtensor.report.drawing import INK, MUTED, colour, decades, label, legend, legend_height, nothing, panels
from magtensor.report.reduction import Spectrum, spectrum, thinned

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROBUST = 1.4826  # median absolute deviation to the standard deviation of a normal distribution


@dataclass(frozen=True)
class Curves:
    """The spectra of one quantity.

    Attributes:
        words: what it is.
        summed: how many axes the power is summed over.
        of: a spectrum for each sensor; None where no stretch of it is long enough.
        noise: (S,) nT of one axis, what noise alone would make of the quantity; NaN where unknown.
    """

    words: str
    summed: int
    of: list[Spectrum | None]
    noise: Array


def curves(
    time: Array, residual: Array | None, contrast: Array | None, noise: Array, contrast_noise: Array
) -> list[Curves]:
    """The spectra of |b| - F and of the contrasts, as far as there is one.

    Args:
        time: (N,) s.
        residual: (N, S) nT, or None; contrast: (N, S, 3) nT, or None.
        noise, contrast_noise: (S,) nT of one axis that noise alone gives each; NaN where unknown.
    """
    if len(time) < 2 or not np.median(np.diff(time)) > 0:
        return []
    found = []
    for words, values, level in (
        ("|b| − F", None if residual is None else residual[..., None], noise),
        ("contrast between the sensors, all axes", contrast, contrast_noise),
    ):
        if values is not None:
            each = [_summed([spectrum(time, column) for column in values[:, i].T]) for i in range(values.shape[1])]
            if any(s is not None for s in each):
                found.append(Curves(words, values.shape[2], each, level))
    return found


def _summed(parts: list[Spectrum | None]) -> Spectrum | None:
    """The spectrum of the summed power of some axes; None unless each has one, at the same frequencies."""
    known = [thinned(p) for p in parts if p is not None]
    if len(known) < len(parts) or any(len(p.frequency) != len(known[0].frequency) for p in known):
        return None
    density = np.sqrt(np.sum([p.density**2 for p in known], axis=0))
    return Spectrum(known[0].frequency, density, known[0].averaged)


def spectra(found: list[Curves], step: float, sensors: list[str]) -> Figure:
    """Amplitude spectra, with the level of each sensor's white noise.

    Args:
        found: from `curves`, not empty.
        step: s between samples.
        sensors: S names.
    """
    from matplotlib.lines import Line2D

    known = any(np.isfinite(shown.noise).any() for shown in found)
    names = [*sensors, "white noise"] if known else sensors
    figure, grid = panels(1, len(found), 2.3, top=legend_height(names) - 0.1)
    for axes, shown in zip(grid[0], found, strict=True):
        _spectrum_panel(axes, shown.of, shown.noise * np.sqrt(2 * step * shown.summed))
        axes.set_title(shown.words)
        axes.set_xlabel("frequency  (Hz)")
    grid[0, 0].set_ylabel("nT / √Hz")
    handles = [Line2D([], [], color=colour(i), linewidth=2) for i in range(len(sensors))]
    floor = Line2D([], [], color=MUTED, linewidth=1.2, linestyle=(0, (4, 3)))
    legend(figure, [*handles, floor] if known else handles, names)
    return figure


def _spectrum_panel(axes: Axes, of: list[Spectrum | None], level: Array) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    for i, shown in enumerate(of):
        if shown is None or not (shown.density > 0).any():
            continue
        axes.plot(shown.frequency, np.where(shown.density > 0, shown.density, np.nan), color=colour(i), linewidth=1.0)
        if np.isfinite(level[i]) and level[i] > 0:
            axes.axhline(level[i], color=colour(i), linewidth=0.9, linestyle=(0, (4, 3)), alpha=0.8)
    for axis in (axes.xaxis, axes.yaxis):
        decades(axis)


def histograms(residual: Array, sensors: list[str]) -> Figure:
    """The distribution of |b| - F of each sensor on a logarithmic scale, with the normal one of the same width.

    Args:
        residual: (N, S) nT, NaN where not in use.
    """
    across = min(len(sensors), 4)
    rows = -(-len(sensors) // across)
    figure, grid = panels(rows, across, 1.5, gap=0.5, between=0.42)
    for i, axes in enumerate(grid.ravel()):
        if i >= len(sensors):
            axes.set_axis_off()
            continue
        _histogram(axes, residual[:, i], i)
        axes.set_title(label(sensors[i], 18))
        axes.set_xlabel("|b| − F  (nT)")
    for axes in grid[:, 0]:
        axes.set_ylabel("samples")
    return figure


def _histogram(axes: Axes, values: Array, i: int) -> None:
    known = values[np.isfinite(values)]
    middle = float(np.median(known)) if known.size else 0.0
    width = ROBUST * float(np.median(np.abs(known - middle))) if known.size else 0.0
    if not width > 0:
        nothing(axes, "no spread to show" if known.size else "no samples")
        return
    edges = middle + width * np.linspace(-6.0, 6.0, 61)
    counts, _ = np.histogram(known, edges)
    axes.stairs(counts, edges, color=colour(i), fill=True, alpha=0.5)
    x = np.linspace(edges[0], edges[-1], 200)
    step = edges[1] - edges[0]
    normal = len(known) * step * np.exp(-0.5 * ((x - middle) / width) ** 2) / (width * np.sqrt(2 * np.pi))
    axes.plot(x, normal, color=INK, linewidth=1.0)
    axes.set_yscale("log")
    axes.set_ylim(0.5, 2.5 * max(float(counts.max()), float(normal.max()), 1.0))
    decades(axes.yaxis)
    if beyond := int(((known < edges[0]) | (known > edges[-1])).sum()):
        axes.text(0.98, 0.97, f"{beyond} beyond", transform=axes.transAxes, ha="right", va="top", color=MUTED)
