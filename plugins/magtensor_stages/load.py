"""The stage that reads the survey and refuses what cannot be used."""

from __future__ import annotations

from dataclasses import replace

from magtensor.components import stage
from magtensor.errors import UsageError
from magtensor.survey.model import Survey


@stage(
    gives=("time", "sensor", "axis", "b_raw"),
    may_give=(
        "position", "reference/*", "temperature", "current_*", "acceleration", "angular_rate", "attitude", "segment",
        "good",
    ),
)  # fmt: skip
def load(survey: Survey) -> Survey:
    """Read the survey."""
    if survey.source is None:
        raise UsageError("load: the recipe has no `survey` section and the command line names no survey")
    return replace(survey.source.read(), source=survey.source)
