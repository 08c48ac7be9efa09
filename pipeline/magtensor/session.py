"""What `run` does, from Python: run a recipe, or a result again, and write the files of the contract."""

from __future__ import annotations

import filecmp
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from magtensor import provenance, result
from magtensor.applying import verified
from magtensor.atomic import refuse_overwriting, require_writable
from magtensor.calibrated import left_open, told_of_fit
from magtensor.dated import told_of_change
from magtensor.errors import UsageError
from magtensor.preparing import empty_survey, load_as
from magtensor.provenance import Provenance
from magtensor.qc import told
from magtensor.recipe.plan import Plan, read_plan
from magtensor.refusal import picture_named
from magtensor.runner import RunResult, StageRecord, run, told_of_reading
from magtensor.survey.in_memory import Held
from magtensor.survey.model import Survey
from magtensor.survey.source import Source
from magtensor.verdict import verdict
from magtensor.verdict_words import sentence

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
        verify: a second survey in a uniform field with a total field; its error goes into the verdict. Takes the
            place of the one that the recipe names, or that the result was verified with.
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
        planned = provenance.plan_again(
            recipe, before, overrides=overrides, plugin_folders=plugin_folders, survey=survey, verify=verify
        )
        same = planned.resolved().get("verify") == before.recipe.get("verify")
        provenance.check_inputs(before, survey=survey is None, verification=verify is None and same)
        memory_GiB = memory_GiB or float(before.notes.get("memory_GiB", 0)) or None
    else:
        planned = read_plan(recipe, overrides=overrides, plugin_folders=plugin_folders, survey=survey, verify=verify)
    drawing = picture_named(recipe, survey=survey, overrides=overrides, plugin_folders=plugin_folders)
    with drawing if before is None else nullcontext():
        finished = run_plan(planned, output, progress=progress, memory_GiB=memory_GiB)
    if before is not None and not overrides and survey is None:
        return replace(finished, notes=(*compare(before, finished.made_by), *finished.notes))
    return finished


def run_plan(
    planned: Plan,
    output: Path,
    *,
    progress: Callable[[str], None] | None = None,
    memory_GiB: float | None = None,
) -> Finished:
    """Run a plan and write the files of the contract; as `run_recipe`."""
    require_writable(output)
    files = planned.source().files()
    verify = planned.verify
    refuse_overwriting([output / name for name in result.FILES], [*files, *([verify] if verify else [])])
    if verify is not None:
        require_verifying(planned, verify, files)
    if progress is not None:
        progress("start")
    if memory_GiB is not None:
        from magtensor.long_survey import run_long

        return run_long(planned, output, memory_GiB, progress=progress)
    return compute(planned, empty_survey(planned), progress=progress).write(output)


def _alike(one: Path, other: Path) -> bool:
    """Whether two paths are one file, or files of the same bytes."""
    both = one.is_file() and other.is_file()
    return one.resolve() == other.resolve() or (both and filecmp.cmp(one, other, shallow=False))


def require_verifying(planned: Plan, verify: Path | Held, files: Sequence[Path]) -> None:
    """See that a verification survey can be read, and is none of the survey's files: now and not after the fit.

    Raises:
        UsageError: it is the survey itself.
        DataError: it cannot be read and prepared as the recipe does.
    """
    if isinstance(verify, Path) and any(_alike(verify, file) for file in files):
        raise UsageError(f"{verify}: this is the survey itself; a verification survey is one that the fit has not seen")
    load_as(planned, verify)


@dataclass(frozen=True)
class Computed:
    """A run that was not written yet.

    Attributes:
        planned: what was run.
        survey: after the last stage.
        records: what each stage did.
        outcome: the content of `verdict.json`.
        verify: the verification survey.
    """

    planned: Plan
    survey: Survey
    records: tuple[StageRecord, ...]
    outcome: dict[str, Any]
    verify: Path | Held | None = None

    def provenance(self) -> Provenance:
        """What made it."""
        source = self.survey.source
        inputs = [source] if isinstance(source, Held) else self.planned.source().files()
        return provenance.collect(self.planned, self.records, inputs, self.verify)

    def write(self, output: Path) -> Finished:
        """Write the files of the contract."""
        made_by = result.write(output, self.survey, self.provenance(), self.outcome)
        notes = (
            *told_of_reading(self.survey),
            *(f"not determined: {words}" for words in left_open(self.survey)),
            *told_of_change(self.survey),
            *told_of_fit(self.survey),
            *told(self.survey),
        )
        if left := (self.outcome["error"].get("verify") or {}).get("not_taken_off"):
            notes = (*notes, f"NOT taken off the verification survey: {left}")
        if isinstance(self.survey.source, Source):
            notes = (*notes, *self.survey.source.named_again())
        return Finished(output, self.outcome, sentence(self.outcome), made_by, self.survey, notes)


def compute(
    planned: Plan,
    survey: Survey,
    *,
    verify: Held | None = None,
    progress: Callable[[str], None] | None = None,
) -> Computed:
    """Run a plan on a survey (one that only knows its source), write nothing; else as `run_plan`.

    `verify` is a verification survey that is in memory; a file's path is in the plan.
    """
    return judged(planned, run(planned, survey, progress=progress), verify or planned.verify)


def judged(planned: Plan, done: RunResult, verify: Path | Held | None) -> Computed:
    """What a plan's stages made, with its verdict."""
    checked = None if verify is None else verified(done.survey, verify, planned)
    return Computed(planned, done.survey, done.records, verdict(done.survey, verify=checked), verify)


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
