"""The samples of one survey or several, and what is known of the field at each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array


@dataclass(frozen=True)
class Samples:
    """Samples of K surveys of one array, survey after survey.

    Attributes:
        raw: (N, S, 3) nT.
        total_field: (N,) nT; where `level` is given only its size matters, and it is one number.
        run: (N,) number of the run of consecutive samples that each belongs to.
        survey: (N,) number of the survey, 0 to K - 1, ascending.
        level: (N,) number of the unknown constant, 0 to G - 1, that the total field is there; None where it is known.
        direction: (N, 3) unit vectors, the field in the platform's frame by the attitude; None where it is not known.
    """

    raw: Array
    total_field: Array
    run: NDArray[np.int_]
    survey: NDArray[np.int_]
    level: NDArray[np.int_] | None = None
    direction: Array | None = None

    @property
    def surveys(self) -> int:
        """K."""
        return int(self.survey[-1]) + 1

    @property
    def levels(self) -> int:
        """G; 0 where the total field is known."""
        return 0 if self.level is None else int(self.level.max()) + 1

    def at(self, keep: NDArray[np.bool_]) -> Samples:
        """Some of them."""
        return replace(
            self,
            raw=self.raw[keep],
            total_field=self.total_field[keep],
            run=self.run[keep],
            survey=self.survey[keep],
            level=None if self.level is None else self.level[keep],
            direction=None if self.direction is None else self.direction[keep],
        )


def joined(surveys: list[Samples]) -> Samples:
    """Surveys put after each other, each of which is numbered as if it were alone."""
    runs, levels = _offsets([int(s.run.max(initial=-1)) + 1 for s in surveys]), _offsets([s.levels for s in surveys])
    known = [s.direction for s in surveys if s.direction is not None]
    level = [s.level + n for s, n in zip(surveys, levels, strict=True) if s.level is not None]
    return Samples(
        np.concatenate([s.raw for s in surveys]),
        np.concatenate([s.total_field for s in surveys]),
        np.concatenate([s.run + n for s, n in zip(surveys, runs, strict=True)]),
        np.repeat(np.arange(len(surveys)), [len(s.raw) for s in surveys]),
        np.concatenate(level) if level else None,
        np.concatenate(known) if len(known) == len(surveys) else None,
    )


def _offsets(counts: list[int]) -> list[int]:
    return [0, *np.cumsum(counts)[:-1].tolist()]
