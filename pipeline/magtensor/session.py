"""What `run` does, from Python: run a recipe, or a result again, and write the files of the contract."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magtensor import provenance, result
from magtensor.applying import verification
from magtensor.atomic import refuse_overwriting, require_writable
from magtensor.calibrated import left_open
from magtensor.errors import UsageError
from magtensor.preparing import empty_survey
from magtensor.provenance import Provenance
from magtensor.qc import told
from magtensor.recipe.plan import Plan, read_plan
from magtensor.runner import StageRecord, run
from magtensor.survey.in_memory import Held
from magtensor.survey.model import Survey
from magtensor.survey.source import Source
from magtensor.verdict import sentence, verdict

if TYPE_CHECKING:
    pass

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"


@dataclass(frozen=True)
class Finished:
    """A run that was written.

    Attributes:
        directory: where its files are.
        outcome: the content of `verdict.json`.
        sentence: the verdict in one sentence.
        made_by: the provenance, content hash included.
        survey: after the last stage.
        notes: what a re-run has to say about differences, and the QC verdicts that are not passed.
    """

    directory: Path
    outcome: dict[str, Any]
    sentence: str
    made_by: Provenance
    survey: Survey
    notes: tuple[str, ...] = ()


def run_recipe(
    recipe: Path,
    output: Path,
    *,
    survey: Path | None = None,
    verify: Path | None = None,
    overrides: Sequence[str] = (),
    plugin_folders: Sequence[Path] = (),
    progress: Callable[[str], None] | None = None,
    memory_GiB: float | None = None,
) -> Finished:
    """Run a recipe, or a result again from its own provenance, and write the files of the contract.

    Args:
        recipe: a YAML recipe, or a `result.nc`.
        output: the folder to write into.
        survey: takes the place of the recipe's own survey.
        verify: a second survey in a uniform field with a total field; its error goes into the verdict.
        overrides: `PATH=VALUE` texts.
        plugin_folders: folders of single-file plugins.
        progress: called with each stage's name.
        memory_GiB: work in windows that take about so much memory; the whole survey at once when None.

    Raises:
        UsageError, DataError: with the exit status of the contract.
    """
    before: Provenance | None = None
    if is_hdf5(recipe):
        before = provenance.read(recipe)
        if survey is None:
            provenance.check_inputs(before)
        planned = provenance.plan_again(
            recipe, before, overrides=overrides, plugin_folders=plugin_folders, survey=survey
        )
        memory_GiB = memory_GiB or float(before.notes.get("memory_GiB", 0)) or None
    else:
        planned = read_plan(recipe, overrides=overrides, plugin_folders=plugin_folders, survey=survey)
    finished = run_plan(planned, output, verify=verify, progress=progress, memory_GiB=memory_GiB)
    if before is not None and not overrides and survey is None:
        return replace(finished, notes=(*compare(before, finished.made_by), *finished.notes))
    return finished


def run_plan(
    planned: Plan,
    output: Path,
    *,
    verify: Path | None = None,
    progress: Callable[[str], None] | None = None,
    memory_GiB: float | None = None,
) -> Finished:
    """Run a plan and write the files of the contract; as `run_recipe`."""
    require_writable(output)
    files = planned.source().files()
    refuse_overwriting([output / name for name in result.FILES], [*files, *([verify] if verify else [])])
    if verify is not None:
        require_unseen(verify, files)
    if progress is not None:
        progress("start")
    if memory_GiB is not None:
        from magtensor.long_survey import run_long

        return run_long(planned, output, memory_GiB, verify=verify, progress=progress)
    return compute(planned, empty_survey(planned), verify=verify, progress=progress).write(output)


def require_unseen(verify: Path, files: Sequence[Path]) -> None:
    """See that a verification survey is none of the files that the survey is read from.

    Raises:
        UsageError: it is.
    """
    if verify.resolve() in {f.resolve() for f in files}:
        raise UsageError(f"{verify}: this is the survey itself; a verification survey is one that the fit has not seen")


@dataclass(frozen=True)
class Computed:
    """A run that was not written yet.

    Attributes:
        planned: what was run.
        survey: after the last stage.
        records: what each stage did.
        outcome: the content of `verdict.json`.
    """

    planned: Plan
    survey: Survey
    records: tuple[StageRecord, ...]
    outcome: dict[str, Any]

    def provenance(self) -> Provenance:
        """What made it."""
        if isinstance(self.survey.source, Held):
            made_by = provenance.collect(self.planned, self.records, ())
            return replace(made_by, inputs=[self.survey.source.facts()])
        return provenance.collect(self.planned, self.records, self.planned.source().files())

    def write(self, output: Path) -> Finished:
        """Write the files of the contract."""
        made_by = result.write(output, self.survey, self.provenance(), self.outcome)
        notes = (*(f"not determined: {words}" for words in left_open(self.survey)), *told(self.survey))
        if left := (self.outcome["error"].get("verify") or {}).get("not_taken_off"):
            notes = (*notes, f"NOT taken off the verification survey: {left}")
        if isinstance(self.survey.source, Source):
            notes = (*notes, *self.survey.source.named_again())
        return Finished(output, self.outcome, sentence(self.outcome), made_by, self.survey, notes)


def compute(
    planned: Plan,
    survey: Survey,
    *,
    verify: Path | Held | None = None,
    progress: Callable[[str], None] | None = None,
) -> Computed:
    """Run a plan on a survey (one that only knows its source), write nothing; else as `run_plan`."""
    done = run(planned, survey, progress=progress)
    outcome = verdict(done.survey, verify=verification(done.survey, verify, planned) if verify else None)
    return Computed(planned, done.survey, done.records, outcome)


def compare(before: Provenance, now: Provenance) -> tuple[str, ...]:
    """In words: whether a re-run gave the same bits, and what was different where not."""
    changes = provenance.differences(before, now)
    if before.content_sha256 == now.content_sha256:
        return ("reproduced bit for bit", *changes)
    return ("NOT the same bits as the result it was run from", *(changes or ["no version differs"]))


def is_hdf5(path: Path) -> bool:
    """Whether a file begins as HDF5 does."""
    try:
        with open(path, "rb") as file:
            return file.read(len(HDF5_MAGIC)) == HDF5_MAGIC
    except OSError:
        return False
