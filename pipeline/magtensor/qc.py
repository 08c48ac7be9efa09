"""What a QC metric says of a survey."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from magtensor.survey.model import Survey


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


def told(survey: Survey, most: int = 5) -> tuple[str, ...]:
    """What the terminal says of the verdicts that a survey holds: those that failed, and how many are worth a look."""
    if "qc/state" not in survey:
        return ()
    states, names, words = (survey.values(f"qc/{k}").tolist() for k in ("state", "metric", "words"))
    failed = [i for i, state in enumerate(states) if state == "fail"]
    lines = [f"QC failed: {names[i]}: {words[i]}" for i in failed[:most]]
    if len(failed) > most:
        lines.append(f"QC failed: {len(failed) - most} more: {', '.join(names[i] for i in failed[most:])}")
    warned = [names[i] for i, state in enumerate(states) if state == "warn"]
    if warned:
        lines.append(f"QC: worth a look: {', '.join(warned)}")
    return tuple(lines)


def worst(verdicts: list[Verdict]) -> str:
    """The state of the whole."""
    return STATES[max((STATES.index(v.state) for v in verdicts), default=0)]
