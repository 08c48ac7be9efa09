"""What a QC metric says of a survey."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Verdict:
    """One judgement.

    Attributes:
        name: of the quantity, unique in the survey ("total_field_rms S1").
        value: the figure; NaN where it could not be made.
        units: of the value.
        state: "pass", "warn" (usable, look at it), "fail" (do not use it as it is).
        words: one sentence with the reason and, where not passed, what would be right.
        limit: what the value was held against; NaN where nothing.
    """

    name: str
    value: float
    units: str
    state: Literal["pass", "warn", "fail"]
    words: str
    limit: float = float("nan")


STATES = ("pass", "warn", "fail")


def worst(verdicts: list[Verdict]) -> str:
    """The state of the whole."""
    return STATES[max((STATES.index(v.state) for v in verdicts), default=0)]
