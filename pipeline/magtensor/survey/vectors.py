"""Which columns of a file make a vector: by their names, their shape, or by staying on a sphere."""

from __future__ import annotations

import re
from collections.abc import Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError
from magtensor.survey.tables import Column, Tables

Floats = NDArray[np.float64]

LOOKED_AT = 20_000  # samples; enough for magnitudes, quick for any file
MISFIT = 0.05  # of a sphere through columns without names; the sensors of a turned platform stay within some per cent
_AXIS = re.compile(r"(?<![a-z])([xyz])(?![a-z])|(?<=[a-z])([xyz])(?=_|$|\d|\s|\()|(?<=[A-Z])([XYZ])$")


def numbers_of(column: Column) -> Floats | None:
    """A column's numbers (N, k), or None for text, single values and what cannot be read."""
    if column.text or not column.shape or len(column.shape) > 3 or column.shape[0] < 2:
        return None
    try:
        values = np.asarray(column.load())
    except DataError:
        return None
    if values.dtype.kind not in "fiub":
        return None
    return values.reshape(len(values), -1).astype(np.float64)


@dataclass(frozen=True)
class Triple:
    """Three columns that may be one vector."""

    label: str
    refs: tuple[str, ...]
    values: Floats  # (n, 3)
    units: str | None
    radius: float  # of the sphere that fits best
    misfit: float  # relative
    named: bool  # the names say that they belong together


def _triple(label: str, refs: tuple[str, ...], values: Floats, units: str | None, *, named: bool) -> Triple | None:
    thinned = values[:: max(1, len(values) // LOOKED_AT)]
    whole = thinned[np.isfinite(thinned).all(axis=1)]
    if len(whole) < 10:
        return None
    radius, misfit = sphere(whole)
    return Triple(label, refs, whole, units, radius, misfit, named)


def sphere(values: Floats) -> tuple[float, float]:
    """Radius and relative misfit of the sphere through vectors (n, 3); infinite misfit where they do not span space.

    Whatever its offsets, a magnetometer or an accelerometer at rest that is turned stays on one sphere; rates and
    currents do not. Samples far out are left out first.

    Args:
        values: (n, 3) finite, any units.
    """
    centre = np.median(values, axis=0)
    moved = values - centre
    away = np.linalg.norm(moved, axis=1)
    moved = moved[away <= 5 * np.median(away)]  # corrupt rows would pull a least-squares sphere to themselves
    spread = np.linalg.svd(moved, compute_uv=False) / np.sqrt(len(moved))
    length = float(np.median(np.linalg.norm(values, axis=1)))
    if spread[-1] < 0.02 * max(spread[0], 1e-300):
        return length, np.inf
    design = np.column_stack([2 * moved, np.ones(len(moved))])
    square = (moved**2).sum(axis=1)
    scale = np.abs(design).max(axis=0)
    solution, *_ = np.linalg.lstsq(design / scale, square, rcond=None)
    solution /= scale
    squared_radius = solution[3] + (solution[:3] ** 2).sum()
    if squared_radius <= 0:
        return length, np.inf
    radius = float(np.sqrt(squared_radius))
    off = np.abs(np.linalg.norm(moved - solution[:3], axis=1) - radius)
    return radius, float(np.median(off)) / radius


def _axis_key(name: str) -> tuple[str, str] | None:
    """`("mag1_*_nT", "x")` for `mag1_x_nT`."""
    folder, _, last = name.rpartition("/")
    match = list(_AXIS.finditer(last))
    if not match:
        return None
    letter = match[-1].group(0)
    a, b = match[-1].span()
    return f"{folder}/{last[:a]}*{last[b:]}" if folder else f"{last[:a]}*{last[b:]}", letter.lower()


def candidates(tables: Tables, rows: int, used: Set[str]) -> list[Triple]:
    """Every set of three columns that may be a vector.

    Args:
        tables: the file.
        rows: only columns of so many rows.
        used: columns that are known to be something else.
    """
    found: list[Triple | None] = []
    grouped: dict[str, dict[str, Column]] = {}
    for column in tables.columns.values():
        if column.name in used or not column.shape or column.shape[0] != rows:
            continue
        values = numbers_of(column)
        if values is None:
            continue
        if len(column.shape) == 2 and column.shape[1] % 3 == 0:
            for i in range(column.shape[1] // 3):
                part = column.name if column.shape[1] == 3 else f"{column.name}[{3 * i}:{3 * i + 3}]"
                found.append(_triple(part, (part,), values[:, 3 * i : 3 * i + 3], column.units, named=True))
        elif len(column.shape) == 3 and column.shape[2] == 3:
            for i in range(column.shape[1]):
                part = f"{column.name}[{i}]"
                found.append(_triple(part, (part,), values[:, 3 * i : 3 * i + 3], column.units, named=True))
        elif values.shape[1] == 1:
            key = _axis_key(column.name)
            if key is not None:
                grouped.setdefault(key[0], {})[key[1]] = column
    for label, members in grouped.items():
        if set(members) == {"x", "y", "z"}:
            ordered = [members[a] for a in "xyz"]
            found.append(_stacked(label, ordered))
    if not any(found):
        found += _observatory(tables, rows, used)
    if not any(found) and all(name.isdigit() for name in tables.columns):
        found += _unnamed(tables, rows, used)
    return [t for t in found if t is not None]


def _stacked(label: str, ordered: list[Column]) -> Triple | None:
    values = np.column_stack([column_values(c) for c in ordered])
    return _triple(label, tuple(c.name for c in ordered), values, ordered[0].units, named=True)


def _observatory(tables: Tables, rows: int, used: Set[str]) -> list[Triple | None]:
    """Columns in nT named by the observatories' letters: BOUH, BOUE, BOUZ."""
    free = {c.name: c for c in tables.columns.values() if c.units == "nT" and c.shape == (rows,) and c.name not in used}
    for stem in dict.fromkeys(name[:-1] for name in free):
        for letters in ("XYZ", "HEZ", "UVW"):
            if all(stem + letter in free for letter in letters):
                return [_stacked(f"{stem} field", [free[stem + letter] for letter in letters])]
    return []


def column_values(column: Column) -> Floats:
    """The numbers (N,) of a column that is known to hold numbers."""
    return np.asarray(column.load(), dtype=np.float64).reshape(-1)


def _unnamed(tables: Tables, rows: int, used: Set[str]) -> list[Triple | None]:
    """Without names only the numbers can tell: neighbouring columns that stay on a sphere, the best first."""
    free = [c for c in tables.columns.values() if c.name not in used and c.shape == (rows,) and not c.text]
    numbers = [int(c.name) for c in free]
    possible = []
    for i in range(len(free) - 2):
        if numbers[i + 2] - numbers[i] == 2:
            refs = tuple(c.name for c in free[i : i + 3])
            stacked = np.column_stack([column_values(c) for c in free[i : i + 3]])
            triple = _triple("columns " + ", ".join(refs), refs, stacked, None, named=False)
            if triple is not None and triple.misfit < MISFIT:
                possible.append(triple)
    chosen: list[Triple | None] = []
    taken: set[str] = set()
    for triple in sorted(possible, key=lambda t: t.misfit):
        if not taken & set(triple.refs):
            chosen.append(triple)
            taken |= set(triple.refs)
    return sorted(chosen, key=lambda t: int(t.refs[0]) if t else 0)
