"""Whether held-out blocks tell two models apart, and the plainest form of one model that they leave."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from magtensor.error_models.settings import Laws, Orders
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.assessment import Assessment, Colours
from magtensor.loop.evidence.folds import Blocks
from magtensor.loop.evidence.gains import Gain, held_out_gain
from magtensor.loop.evidence.grams import grams
from magtensor.loop.fitting.model import Adopted, State

SECOND_ORDER = 1e-5  # of the sum of squares that is explained: 0.3 % of an effect's size
SEPARATION = 9.0  # twice the log likelihood ratio between two models below which the data do not tell them apart


def fold_gain(state: State, colours: Colours, *terms: Terms, parts: Blocks | None = None) -> Gain:
    """What terms gain on held-out folds, of equal length or given ones, in noise of given colours, those of the adopted
    models free."""
    given = [] if state.terms is None else [state.terms]
    together = joined([*given, *terms])
    blocked = np.arange(together.count) < sum(t.count for t in given)
    samples = len(state.residual.affine)
    parts = Blocks.equal(samples) if parts is None else parts.among(samples)
    colours = colours.among(state.residual)
    blocks = grams(state.residual, together, colours.across, colours.along, parts.edges)
    return held_out_gain(blocks, state.residual.freedom, blocked, parts)


def separated(best: Gain, other: Gain, spare: int = 0) -> bool:
    """Whether the best model is ahead of another one, which has so many coefficients more.

    A coefficient that is not needed costs about one on blocks that it was not fitted to.
    """
    ahead = best.over(other)
    return ahead.total >= SEPARATION + spare and ahead.consistent


Assessed = tuple[Adopted, float, Terms, Assessment]  # a model, independent tests of its settings, terms, what data say


def plainer(settings: Mapping[str, Any], marks: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Settings of a model with lower orders than theirs, and with the first law, that first; `marks` say which settings
    are orders and laws."""
    found = [dict(settings)]
    for name, mark in marks.items():
        if isinstance(mark, Orders):
            found = [{**s, name: k} for s in found for k in mark.options if k <= settings[name]]
        if isinstance(mark, Laws):
            found = [{**s, name: law} for s in found for law in dict.fromkeys((mark.options[0], settings[name]))]
    return [s for s in found if s != settings]


def lowest(state: State, assessed: Sequence[Assessed], marks: Mapping[str, Any]) -> Assessed:
    """Of one model with several settings the one that predicts best, or the plainest not separated from it."""
    best = max(assessed, key=lambda each: each[3].gain.total)
    below = plainer(best[0].settings, marks)
    lower = [each for each in assessed if each[0].settings in below]
    if not lower:
        return best
    lower.sort(key=lambda each: below.index(dict(each[0].settings)))
    colours = best[3].colours
    reference = fold_gain(state, colours, best[2])
    kept = (each for each in lower if not separated(reference, fold_gain(state, colours, each[2])))
    return min(kept, key=lambda each: each[3].estimate.rank, default=best)
