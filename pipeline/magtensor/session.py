"""What the commands do, from Python: run a recipe, run a result again, apply a calibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magtensor import provenance, result
from magtensor.accuracy import figure
from magtensor.atomic import refuse_overwriting, require_writable
from magtensor.calibrated import left_open
from magtensor.errors import DataError, UsageError
from magtensor.provenance import Provenance
from magtensor.qc import told
from magtensor.recipe.plan import Plan, PlannedStage, plan, read_plan
from magtensor.recipe.source import Document
from magtensor.runner import StageRecord, run
from magtensor.survey.flags import summary
from magtensor.survey.in_memory import Held
from magtensor.survey.model import Survey, Variable
from magtensor.survey.source import Source
from magtensor.verdict import sentence, survey_block, verdict

if TYPE_CHECKING:
    from magtensor.platform_frame import Tied

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


def empty_survey(source: Plan | Source | Held) -> Survey:
    """A survey that only knows its source: where a recipe that loads begins."""
    import xarray as xr

    if isinstance(source, Plan):
        planned = source
        source = replace(planned.source(), prepared=lambda path: load_as(planned, path))
    return Survey(xr.DataTree(), source=source)


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
        planned = again(recipe, before, overrides=overrides, plugin_folders=plugin_folders, survey=survey)
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


def again(
    path: Path,
    before: Provenance,
    *,
    overrides: Sequence[str] = (),
    plugin_folders: Sequence[Path] = (),
    survey: Path | None = None,
) -> Plan:
    """The plan of a result, from its provenance."""
    folder = Path(before.notes.get("folder", "."))
    document = Document(before.recipe, f"{path}:/provenance", {}, folder)
    return plan(document, overrides=overrides, plugin_folders=plugin_folders, survey=survey)


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


def verification(calibrated: Survey, path: Path | Held, planned: Plan) -> dict[str, Any]:
    """The error blocks of another survey: with the declared model alone, and with all that was adopted."""
    corrected = apply_to(calibrated, path, planned, uniform=True)
    after = survey_block(corrected)
    before = after
    if "declared/matrix" in calibrated and "calibration/effects" in calibrated:
        alone = apply_to(with_declared_alone(calibrated), path, planned, judge=False)
        before = survey_block(alone.merged({"good": corrected["good"]}))  # the same samples
    found: dict[str, Any] = {"before": before, "after": after}
    if left := corrected["calibrated/b"].attrs.get("not_taken_off"):
        found["not_taken_off"] = left
    return found


def with_declared_alone(calibrated: Survey) -> Survey:
    """The calibration before anything was adopted: its own C and o, no effects."""
    from magtensor.survey.model import without_variables

    variables: dict[str, Variable] = {}
    for name in ("matrix", "offset"):
        now = calibrated[f"calibration/{name}"]
        dims = [str(d) for d in now.dims]
        variables[f"calibration/{name}"] = (dims, calibrated.values(f"declared/{name}"), dict(now.attrs))
    return without_variables(calibrated, "calibration/effects").merged(variables)


def apply_to(
    calibration: Survey,
    path: Path | Held,
    planned: Plan,
    *,
    tolerant: bool = False,
    rows: slice | None = None,
    uniform: bool = False,
    judge: bool = True,
) -> Survey:
    """Another survey, loaded as the recipe loads and corrected with a calibration; the options as in
    `apply_and_refine`."""
    return apply_and_refine(
        calibration, path, planned, tolerant=tolerant, rows=rows, refine_rotation=False, uniform=uniform, judge=judge
    )[0]


def apply_and_refine(
    calibration: Survey,
    path: Path | Held,
    planned: Plan,
    *,
    tolerant: bool,
    refine_rotation: bool,
    rows: slice | None = None,
    uniform: bool = False,
    judge: bool = True,
) -> tuple[Survey, Tied | None]:
    """Another survey, loaded as the recipe loads and corrected with a calibration.

    Args:
        tolerant, rows: as in `load_as`.
        refine_rotation: turn it into the frame in which its own tensor is symmetric.
        uniform: its field is known to be uniform.
        judge: flag the samples that stand out alone (`standing_out`); the attribute `not_taken_off` of `calibrated/b`
            names effects that cannot be taken off this survey.

    Returns:
        The survey, and the calibration in its new frame: None where no turn was asked for or is significant. The
        attribute `rotation_refined` of `calibrated/b` says what was done.
    """
    from magtensor.calibrated import corrected, require_positions, require_sensors, restored
    from magtensor.effect_errors import taken_off
    from magtensor.loop.stored import cleaned, left_in, on_its_clock, stored_effects
    from magtensor.platform_frame import as_fitted, with_refined_rotation
    from magtensor.standing_out import flagged
    from magtensor.tensor.elements import five
    from magtensor.tensors import assembled, refined, refinement_noise, stored_assembly, stored_refinement

    turned: Tied | None = None
    survey = load_as(planned, path, tolerant=tolerant, rows=rows)
    refinement = stored_refinement(calibration)
    if "calibration/matrix" in calibration:
        require_sensors(survey, result.sensors_of(calibration), str(path))
        if "calibration/position" in calibration:
            require_positions(survey, calibration.values("calibration/position"), str(path))
        fitted = restored(calibration)
        adopted, theta, means = stored_effects(calibration, planned.registry)
        adopted = on_its_clock(adopted, calibration, survey)
        before, survey = survey, cleaned(survey, as_fitted(calibration, fitted), adopted, theta, means)
        if judge:
            known = calibration.values("calibration/noise_std") if "calibration/noise_std" in calibration else None
            survey = flagged(survey, fitted, known, uniform=uniform)
        survey = survey.merged(_named(corrected(fitted, survey, left_in(survey, adopted)), calibration))
        if refine_rotation:
            survey, turned = with_refined_rotation(survey, calibration, fitted)
            fitted = turned.calibration if turned is not None else fitted
        if "calibration/tensor_gain" in calibration:
            b, noise = survey.values("calibrated/b"), calibration.values("calibration/noise_std")
            position = calibration.values("calibration/position")
            assembly = stored_assembly(calibration)
            off = taken_off(calibration, fitted, before, survey, adopted, theta, means)
            survey = survey.merged(assembled(assembly, b, position, noise, fitted, refinement, off))
    elif refine_rotation:
        raise DataError(
            "it calibrates no sensors, so there is no common frame to refine",
            where=str(calibration.attributes.get("source", "")),
        )
    elif refinement is not None:
        measured = five(survey.values("calibrated/tensor"))
        survey = survey.merged(refined(measured, refinement_noise(calibration), refinement))
    else:
        raise DataError(
            "it holds no calibration", where=str(calibration.attributes.get("source", "")),
            hint="name a calibration.nc or result.nc",
        )  # fmt: skip
    return survey, turned


def _named(given: dict[str, Variable], calibration: Survey) -> dict[str, Variable]:
    """The variables of a calibrated survey, with the words that say whose offsets were taken off."""
    words = calibration["calibration/matrix"].attrs.get("offset_of")
    if not words:
        return given
    dims, values, attributes = given["calibrated/b"]
    return given | {"calibrated/b": (dims, values, dict(attributes) | {"offset_of": words})}


def load_as(planned: Plan, path: Path | Held, *, tolerant: bool = False, rows: slice | None = None) -> Survey:
    """Run only the stages of a recipe that read and prepare a survey (before any calibration) on another one.

    A stage whose variables this survey lacks is left out; `tolerant` also leaves out one that the data refuse, as
    long as the survey itself was read (a field needs no base station to be corrected). `rows` reads only some samples.
    """
    stages = preparing_stages(planned)
    if isinstance(path, Held):
        preparing, survey = replace(planned, stages=stages), empty_survey(path)
    else:
        preparing = replace(planned, stages=stages, survey=planned.survey_for(path))
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


@dataclass(frozen=True)
class Applied:
    """A calibrated survey that was written: its file, and in words how well the calibration fits it.

    `refined` says what the survey's gradients made of the calibration's frame; empty where that was not asked for.
    `notes`: which samples were taken out of use, and which effects could not be taken off.
    """

    file: Path
    sentence: str
    refined: str = ""
    notes: tuple[str, ...] = ()


def apply(
    calibration: Path,
    survey: Path,
    output: Path | None = None,
    *,
    memory_GiB: float | None = None,
    refine_rotation: bool = False,
    save_calibration: Path | None = None,
) -> Applied:
    """Apply a stored calibration to another survey and write its `/calibrated` group.

    Args:
        calibration: `calibration.nc` or `result.nc`.
        survey: another survey of the same sensors, in the layout the recipe of the calibration reads.
        output: default: the survey's name with `.calibrated.nc`, beside it.
        memory_GiB: work in windows that take about so much memory; the whole survey at once when None.
        refine_rotation: turn the calibration's frame until the survey's tensor is symmetric, if that is significant.
        save_calibration: a file to write the calibration to as it was applied.
    """
    target = output or survey.with_name(f"{survey.stem}.calibrated.nc")
    written = [target, *([save_calibration] if save_calibration else [])]
    refuse_overwriting(written, [survey, calibration])
    if save_calibration is not None and save_calibration.resolve() == target.resolve():
        raise UsageError(f"{target} cannot hold both the calibrated survey and the calibration: name two files")
    for file in written:
        require_writable(file.parent)
    if memory_GiB is not None and (refine_rotation or save_calibration is not None):
        raise UsageError("the common rotation is refined on the whole survey: leave --memory out")
    from magtensor.platform_frame import calibration_variables

    stored = result.open_result(calibration)
    made_by = provenance.read(calibration)
    planned = again(calibration, made_by)
    inputs = [provenance.file_facts(survey), provenance.file_facts(calibration)]
    applied = Provenance(
        made_by.recipe, inputs, provenance.versions(), made_by.plugins, made_by.stages,
        notes={**made_by.notes, "applied": "recipe and stages are the calibration's, the inputs are this file's"},
    )  # fmt: skip
    if memory_GiB is not None:
        from magtensor.long_survey import apply_long

        return apply_long(stored, planned, survey, target, applied, memory_GiB)
    found, turned = apply_and_refine(stored, survey, planned, tolerant=True, refine_rotation=refine_rotation)
    result.write_calibrated(target, found, applied)
    if save_calibration is not None:
        if turned is not None:
            stored = stored.merged(calibration_variables(stored, result.sensors_of(stored), turned))
        result.write_calibration(save_calibration, stored, applied)
    words = str(found["calibrated/b"].attrs["rotation_refined"]) if refine_rotation else ""
    offsets = found["calibrated/b"].attrs.get("offset_of") if "calibrated/b" in found else None
    told = f" Offsets: {offsets}." if offsets else ""
    left = str(found["calibrated/b"].attrs.get("not_taken_off", "")) if "calibrated/b" in found else ""
    notes = (*summary(found.flags), *([f"NOT taken off: {left}"] if left else []))
    return Applied(target, fit_in_words(survey_block(found)) + told, words, notes)


def fit_in_words(block: dict[str, Any] | None) -> str:
    """How well a calibration fits a survey with this error block: |b| against the survey's own total field."""
    figures = (block or {}).get("total_field_rms_nT")
    if not figures or figures["all"] is None:
        return "How well it fits cannot be told: this survey has no total field at its samples."
    known = {name: value for name, value in figures.items() if name != "all" and value is not None}
    each = ", ".join(f"{name} {figure(value)}" for name, value in known.items())
    return f"|b| - F: {figure(figures['all'])} nT rms on this survey ({each})."
