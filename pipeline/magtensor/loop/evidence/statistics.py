"""Significance that autocorrelation cannot fake: the first gate of METHODS A2 steps 3 to 5."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.grams import Grams
from magtensor.loop.evidence.jackknife import Jackknife

BLOCK_COUNTS = (120, 30, 12)  # long blocks protect against correlation longer than a short block
LARGE_P = 0.999  # beyond which p values count alike
LEAST_BLOCKS = 6


def family_p(g: Grams, sensors: Sequence[str], subset: Sequence[int] | None = None) -> float:
    """P value that the subset's coefficients (all if None) are zero, the others being free, as in `Families`.

    Parameters
    ----------
    g: the finest blocks.
    sensors: (P,) whose each term is.
    """
    return Families(g, tuple(sensors)).p_value(range(g.count) if subset is None else subset)


def by_long_blocks(sensors: Sequence[str]) -> bool:
    """Whether the longest blocks are asked of a family whose coefficients are of these sensors (P,): only they protect
    against noise that is correlated for longer than a thirtieth of a survey."""
    return 3 * max(map(list(sensors).count, set(sensors))) <= BLOCK_COUNTS[-1]


@dataclass(frozen=True)
class Families:
    """Tests of families of coefficients in the same blocks.

    For several block lengths, the largest p taken: a noise correlated for longer than the short blocks does not fool
    the long ones. Where a family has more directions than a third of the blocks, it is tested sensor by sensor, and for
    coefficients that are the same in all sensors, which one sensor without the others would not show; these tests are
    combined (valid under any dependence). Where no block length serves a family that way, as that of a source beside a
    hundred postures, as many of its best determined directions are tested as a third of the blocks.

    Attributes:
        finest: the finest blocks.
        sensors: (P,) whose each term is.
    """

    finest: Grams
    sensors: tuple[str, ...]

    @cached_property
    def _jackknives(self) -> list[Jackknife]:
        finest = len(self.finest.zz)
        counts = sorted({min(count, finest) for count in BLOCK_COUNTS}, reverse=True)
        used = [count for count in counts if count >= LEAST_BLOCKS]
        return [Jackknife(self.finest if count == finest else self.finest.merged(count)) for count in used]

    def p_value(self, subset: Sequence[int]) -> float:
        """That the subset's coefficients are zero, the others being free."""
        chosen = list(subset)
        owners = dict.fromkeys(self.sensors[i] for i in chosen)
        groups = [[i for i in chosen if self.sensors[i] == name] for name in owners]
        found: list[float] = []
        for blocks in self._jackknives:
            count = len(blocks.blocks.zz)
            if 3 * len(chosen) <= count:
                found.append(blocks.p_value(chosen))
                continue
            if len(groups) > 1 and all(3 * len(group) <= count for group in groups):
                each = [blocks.p_value(group, alone=chosen) for group in groups]
                if len({len(group) for group in groups}) == 1:
                    each.append(blocks.p_value(chosen, within=_alike(chosen, groups)))
                found.append(cauchy_combination(each))
        if not found and self._jackknives:
            finest = self._jackknives[0]
            found.append(finest.p_value(chosen, most=len(finest.blocks.zz) // 3))
        return max(found, default=1.0)


def _alike(chosen: Sequence[int], groups: Sequence[Sequence[int]]) -> Array:
    """(P, K) the directions in which the K coefficients of each group are those of any other."""
    out = np.zeros((len(chosen), len(groups[0])))
    for group in groups:
        out[[chosen.index(i) for i in group], range(len(group))] = 1.0
    return out


def wald_p(g: Grams, chosen: Sequence[int], alone: Sequence[int] = (), most: int | None = None) -> float:
    """P value that the chosen coefficients are zero, the others free: delete-block jackknife (CR3), Hotelling's F.

    Parameters
    ----------
    alone: coefficients that are not free but zero where they are not chosen. A family whose part common to all sensors
        cannot be seen says nothing of one sensor as long as the other sensors' coefficients are free.
    most: directions tested, those with the most information; all if None.
    """
    return Jackknife(g).p_value(chosen, alone, most)


def cauchy_combination(p_values: Sequence[float]) -> float:
    """One p value from several that may depend on each other (ACAT, Liu and Xie 2020).

    The tangent goes to minus infinity at 1, and one test that sees nothing would outweigh any other: all large p values
    count alike.
    """
    if min(p_values) >= 1.0:
        return 1.0
    p = np.clip(np.asarray(p_values, dtype=float), 1e-300, LARGE_P)
    # tan(pi (1/2 - p)) is 1 / (pi p) for the smallest p, where the tangent itself overflows its accuracy
    statistic = np.mean(np.where(p < 1e-15, 1 / (np.pi * p), np.tan(np.pi * (0.5 - p))))
    if statistic > 1e15:
        return float(1 / (np.pi * statistic))
    return float(0.5 - np.arctan(statistic) / np.pi)


def fisher_combination(p_values: Sequence[float]) -> float:
    """One p value from several independent ones (Fisher 1925); 1 of none."""
    from scipy.special import chdtrc

    if not len(p_values):
        return 1.0
    p = np.maximum(np.asarray(p_values, dtype=float), 1e-300)
    return float(chdtrc(2.0 * len(p), -2.0 * np.sum(np.log(p))))
