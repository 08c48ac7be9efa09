"""What comes before a calibration: the survey that a recipe begins with, and its stages that read and prepare one."""

from __future__ import annotations

from dataclasses import replace
from itertools import takewhile
from pathlib import Path

from magtensor.errors import DataError
from magtensor.recipe.plan import Plan, PlannedStage
from magtensor.runner import run
from magtensor.survey.in_memory import Held
from magtensor.survey.model import Survey
from magtensor.survey.source import Source


def empty_survey(source: Plan | Source | Held) -> Survey:
    """A survey that only knows its source: where a recipe that loads begins."""
    import xarray as xr

    if isinstance(source, Plan):
        planned = source
        source = replace(planned.source(), prepared=lambda path: load_as(planned, path))
    return Survey(xr.DataTree(), source=source)


def load_as(planned: Plan, path: Path | Held | None, *, tolerant: bool = False, rows: slice | None = None) -> Survey:
    """Run only the stages of a recipe that read and prepare a survey (before any calibration) on another one, or on
    its own when None.

    A stage whose variables this survey lacks is left out; `tolerant` also leaves out one that the data refuse, as
    long as the survey itself was read (a field needs no base station to be corrected). `rows` reads only some samples.
    """
    stages = preparing_stages(planned)
    if isinstance(path, Held):
        preparing, survey = replace(planned, stages=stages), empty_survey(path)
    else:
        section = planned.survey if path is None else planned.survey_for(path)
        preparing = replace(planned, stages=stages, survey=section)
        survey = empty_survey(replace(preparing.source(), rows=rows))
    for stage in stages:
        if all(any(_fits(p, need) for p in survey.paths()) for need in stage.declares.needs):
            try:
                survey = run(replace(preparing, stages=(stage,)), survey).survey
            except DataError:
                if not tolerant or "b_raw" not in survey:
                    raise
    if "b_raw" not in survey:
        raise DataError("the recipe loads no survey before it calibrates", where=planned.file)
    return survey


def preparing_stages(planned: Plan) -> tuple[PlannedStage, ...]:
    """The stages before any calibration."""
    return tuple(takewhile(lambda stage: not calibrates(stage), planned.stages))


def calibrates(stage: PlannedStage) -> bool:
    """Whether a stage has to do with a calibration, its making or its use."""
    return any(p.startswith("calibration/") for p in (*stage.declares.gives, *stage.declares.needs))


def _fits(path: str, pattern: str) -> bool:
    from fnmatch import fnmatchcase

    return fnmatchcase(path, pattern)
