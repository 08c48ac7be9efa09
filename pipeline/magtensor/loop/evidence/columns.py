"""The columns of a least-squares problem that terms make in the values along the field and across known directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.terms import REFERENCE, Terms
from magtensor.loop.evidence.residual import Residual


@dataclass(frozen=True)
class Columns:
    """Columns base @ mix of each of B sets of P terms, few of which are worked on: base (N, B Q), mix (Q, P)."""

    base: Array
    mix: Array

    @property
    def made(self) -> Array:
        """(N, P) those of a single set."""
        out: Array = self.base @ self.mix
        return out


@dataclass(frozen=True)
class Made:
    """What sets of terms that differ in their series only make: (B, K, N) the series of each, and columns along the
    field and across known directions, None where the residual has no such part."""

    series: Array
    along: Columns | None
    sighted: Columns | None

    @classmethod
    def of(cls, residual: Residual, several: Sequence[Terms]) -> Made:
        along = None if residual.along is None else along_the_field(residual, several)
        sighted = None if residual.sighted is None else across_directions(residual, several)
        return cls(_series_of_each(several), along, sighted)


def along_the_field(residual: Residual, several: Sequence[Terms]) -> Columns:
    """The columns along the field of sets of terms that differ in their series only."""
    found = _columns(residual, several, residual.slow_modes.response, residual.shown_along)
    return found if residual.levels is None else replace(found, base=residual.levels.off(found.base))


def across_directions(residual: Residual, several: Sequence[Terms]) -> Columns:
    """The columns (2 N, .) across known directions, likewise."""
    assert residual.sighted is not None
    rows = np.repeat(np.arange(len(residual.affine)), 2)
    return _columns(residual, [t.at(rows) for t in several], residual.sighted.response, residual.shown_sighted)


def _series_of_each(several: Sequence[Terms]) -> Array:
    """(B, K, N) the series of each set."""
    return np.stack([terms.series.T for terms in several])


def _columns(residual: Residual, several: Sequence[Terms], response: Array, shown: Array) -> Columns:
    """Columns in rows of whitened values.

    The outputs show in each of them through three responses only, so a series that acts on more than three of them has
    no more columns than three to be worked on.

    Parameters
    ----------
    response: (N, 3); shown: (3 S + 1, N).
    """
    first, series = several[0], _series_of_each(several)
    term, output, which = first.part_term, first.part_output, first.part_series
    wide = np.bincount(which[output != REFERENCE], minlength=series.shape[1]) > 3
    own = ~wide[which] | (output == REFERENCE)
    base = [series[:, which[own]] * shown[output[own]]]
    mix = [np.zeros((int(own.sum()), first.count))]
    mix[0][np.arange(len(mix[0])), term[own]] = first.part_weight[own]
    if wide.any():
        size = 3 * int(wide.sum())
        base.append((series[:, wide, None] * response.T).reshape(len(several), size, -1))
        each = np.zeros((size // 3, 3, first.count))
        place = (np.cumsum(wide) - 1)[which[~own]]
        by_output = residual.basis[output[~own]] * (first.part_weight[~own] / residual.noise[output[~own]])[:, None]
        np.add.at(each, (place[:, None], np.arange(3), term[~own, None]), by_output)
        mix.append(each.reshape(size, first.count))
    rows, together = np.concatenate(base, axis=1), np.vstack(mix)
    if len(together) > first.count:
        rows, together = together.T @ rows, np.eye(first.count)
    return Columns(rows.reshape(-1, rows.shape[2]).T, together)
