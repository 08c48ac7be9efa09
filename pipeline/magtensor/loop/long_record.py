"""Long surveys: a search on evenly chosen samples, and the calibration that follows from it on every sample.

What a search costs grows with the samples, and it asks some thousand questions; an effect that forty thousand samples
do not show is below a hundredth of their noise. The lines in the spectrum are those of all samples, because the chosen
ones would show a fast tone as a slow one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibration.joint import JointFit
from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.wandering import unweighed
from magtensor.loop.remainder.tones import tones
from magtensor.loop.searching.found import Search
from magtensor.loop.searching.latent import renewed

MOST_SEARCHED = 40_000  # samples


@dataclass(frozen=True)
class Part:
    """What the search of a survey looks at.

    Attributes:
        record: every k-th sample, the whole survey where it is not long.
        alone: the declared model fitted to all samples; None where the record holds them all.
        lines: Hz, of all samples; None where the record holds them all.
    """

    record: Record
    alone: JointFit | None = None
    lines: tuple[float, ...] | None = None


def part_of(record: Record, declared: Sequence[Adopted], how: Fitting, most: int = MOST_SEARCHED) -> Part:
    """The samples of a survey that are searched."""
    step = -(-len(record.time) // most)
    if step == 1:
        return Part(record)
    every = joint_state(record, declared, how)
    lines = tones(every, record.time)
    return Part(record.at(np.arange(step // 2, len(record.time), step)), every.fit, lines)


def on_every_sample(found: Search, whole: Record, part: Part) -> Search:
    """The search with its calibrations fitted to all samples of the survey."""
    if part.alone is None:
        return found
    if found.record.waveform is not None:
        whole = replace(whole, waveform=np.interp(whole.time, found.record.time, found.record.waveform))
    last = joint_state(
        whole, found.last.adopted, replace(found.how, searching=False), found.last.theta, found.last.lines
    )
    whole, last = renewed(whole, last, found.how)
    first = replace(found.first, fit=part.alone)
    return replace(found, first=first, last=last, record=whole, evenly=unweighed(whole, last, found.how))
