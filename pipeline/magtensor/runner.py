"""Runs a plan: stage after stage in the recipe's order, each seeing only what it declared."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from magtensor.errors import MagtensorError, NotEnoughData, UsageError
from magtensor.recipe.plan import Plan, PlannedStage
from magtensor.survey.flags import Flag, much_lost
from magtensor.survey.model import Survey, Variable

if TYPE_CHECKING:
    import xarray as xr

ALWAYS_READABLE = ("time", "sensor", "axis", "good", "is_reading")


@dataclass(frozen=True)
class StageRecord:
    """What one stage did; made only after it succeeded."""

    name: str
    options: Mapping[str, Any]
    started: str
    duration_s: float
    read: tuple[str, ...]
    wrote: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "options": dict(self.options),
            "started": self.started,
            "duration_s": round(self.duration_s, 6),
            "read": list(self.read),
            "wrote": list(self.wrote),
        }


@dataclass(frozen=True)
class Watched(Survey):
    """What a stage sees: the survey, cut down to what the stage declared, noting what it reads."""

    stage: str = ""
    readable: tuple[str, ...] = ()
    was_read: set[str] = field(default_factory=set)

    def allowed(self, path: str) -> bool:
        return path in ALWAYS_READABLE or any(fnmatchcase(path, pattern) for pattern in self.readable)

    def __getitem__(self, path: str) -> xr.DataArray:
        if not self.allowed(path):
            raise UsageError(f"stage {self.stage} reads {path}, which it declares neither in needs nor in uses")
        found = super().__getitem__(path)
        self.was_read.add(path)
        values = found.values.view()
        values.flags.writeable = False  # a stage that writes in place would change what others read, unrecorded
        return found.copy(data=values)

    def __contains__(self, path: object) -> bool:
        return self.allowed(str(path)) and super().__contains__(path)

    def paths(self) -> list[str]:
        return [p for p in super().paths() if self.allowed(p)]


@dataclass(frozen=True)
class RunResult:
    """The survey after the last stage, and what each stage did."""

    survey: Survey
    records: tuple[StageRecord, ...]


def run(plan: Plan, survey: Survey, *, progress: Callable[[str], None] | None = None) -> RunResult:
    """Run the plan's stages on a survey (for a recipe that loads: a survey that only knows its source).

    Args:
        plan: from `read_plan`.
        survey: where the first stage starts.
        progress: called with each stage's name before it runs.

    Raises:
        DataError: the data are wrong or not enough; the stage's name is put before the message.
        UsageError: a stage breaks its own declaration.
    """
    records = []
    for stage in plan.stages:
        if progress is not None:
            progress(stage.name)
        survey, record = run_stage(stage, survey)
        records.append(record)
    return RunResult(survey, tuple(records))


def run_stage(
    stage: PlannedStage, survey: Survey, function: Callable[..., Any] | None = None
) -> tuple[Survey, StageRecord]:
    """Run one stage, or another function in its place; as `run`."""
    _require(stage, survey)
    declares = stage.declares
    view = Watched(
        survey.tree, survey.flags, survey.attributes, survey.source,
        stage=stage.name, readable=(*declares.needs, *declares.uses),
    )  # fmt: skip
    started, begin = datetime.now(UTC).isoformat(timespec="milliseconds"), clock.perf_counter()
    try:
        given = (function or stage.component.function)(view, **stage.options)
        after, wrote = _merge(stage, survey, given)
    except NotEnoughData as error:
        missing = told_of_reading(survey)
        if not missing:
            raise
        hint = "\n  ".join([*([error.hint] if error.hint else []), *missing])
        raise type(error)(error.what, where=error.where, hint=hint) from error
    except MagtensorError:
        raise
    except SystemExit as error:
        raise RuntimeError(f"stage {stage.name} tried to end the program ({error!r})") from error
    except Exception as error:
        error.add_note(f"in stage {stage.name}, options {dict(stage.described)}")
        raise
    record = StageRecord(
        stage.name,
        stage.described,
        started,
        clock.perf_counter() - begin,
        tuple(sorted(view.was_read)),
        tuple(sorted(wrote)),
    )
    return after, record


def told_of_reading(survey: Survey) -> list[str]:
    """What was noticed while a survey was read, and where much of it is not used, a line each."""
    lost = much_lost(survey.flags, len(survey.time)) if survey.flags else []
    return [
        *(f"as read: {note}" for note in survey.attributes.get("notes", ())),
        *(f"not used: {line}" for line in lost),
    ]


NO_REFERENCE = (
    "no base station? `survey: {reference: {constant: {value: ..., units: nT, why: ...}}}` takes the total field as "
    "constant; `file:` and `total_field:` there take it from another file (docs/surveys.md)"
)


MADE = ("good", "is_reading")  # by loading, of every survey


def _require(stage: PlannedStage, survey: Survey) -> None:
    """The plan knew only what a loader may give; now the data are there."""
    for need in stage.declares.needs:
        if not any(fnmatchcase(path, need) for path in survey.paths()):
            from magtensor.errors import DataError

            own = [p for p in survey.paths() if p not in MADE and ("/" not in p or p.startswith("reference/"))]
            has = f"it has {', '.join(own)}"
            raise DataError(
                f"stage {stage.name} needs {need}, which this survey does not have",
                where=str(survey.attributes.get("source", "")),
                hint=f"{has}\n  {NO_REFERENCE}" if need.startswith("reference/") else has,
            )


def _merge(stage: PlannedStage, survey: Survey, given: Any) -> tuple[Survey, list[str]]:
    if isinstance(given, Survey):  # a loader makes the survey
        _require_promised(stage, given.paths())
        return given, [p for p in given.paths() if p not in survey.paths()]
    if not isinstance(given, Mapping):
        raise UsageError(f"stage {stage.name} returned {type(given).__name__}, not a mapping of paths to variables")
    variables: dict[str, Variable] = {k: v for k, v in given.items() if k != "flags"}
    flags: list[Flag] = list(given.get("flags", []))
    promised = (*stage.declares.gives, *stage.declares.may_give)
    for path in variables:
        if not any(fnmatchcase(path, pattern) for pattern in promised):
            raise UsageError(f"stage {stage.name} gives {path}, which it does not declare")
    _require_promised(stage, variables)
    return survey.merged(variables, flags), list(variables)


def _require_promised(stage: PlannedStage, given: Iterable[str]) -> None:
    paths = list(given)
    for pattern in stage.declares.gives:
        if not any(fnmatchcase(path, pattern) for path in paths):
            raise UsageError(f"stage {stage.name} declares that it gives {pattern}, but did not")
