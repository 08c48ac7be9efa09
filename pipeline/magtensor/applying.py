"""A stored calibration on another survey."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor import provenance, result
from magtensor.accuracy import figure, left_by_any_calibration
from magtensor.atomic import refuse_overwriting, require_writable
from magtensor.errors import DataError, UsageError
from magtensor.preparing import load_as
from magtensor.provenance import Provenance, plan_again
from magtensor.recipe.plan import Plan
from magtensor.survey.flags import summary
from magtensor.survey.in_memory import Held
from magtensor.survey.model import Survey, Variable
from magtensor.verdict import survey_block
from magtensor.verdict_words import WORSE

if TYPE_CHECKING:
    from magtensor.calibration.types import Array, ArrayCalibration
    from magtensor.loop.fitting.model import Adopted
    from magtensor.platform_frame import Tied


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
    from magtensor.dated import change_at_date_of
    from magtensor.platform_frame import calibration_variables

    stored = result.open_result(calibration)
    made_by = provenance.read(calibration)
    planned = plan_again(calibration, made_by)
    inputs = [provenance.facts(survey), provenance.facts(calibration)]
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
            own = change_at_date_of(found, stored, turned.calibration)
            stored = stored.merged(calibration_variables(stored, result.sensors_of(stored), turned) | own)
        result.write_calibration(save_calibration, stored, applied)
    words = str(found["calibrated/b"].attrs["rotation_refined"]) if refine_rotation else ""
    told = _told(found["calibrated/b"].attrs) if "calibrated/b" in found else ""
    attributes = found["calibrated/b"].attrs if "calibrated/b" in found else {}
    each = {
        "NOT taken off": "not_taken_off",
        "total field as it was read, which fits better than without": "total_field_as_read",
        "extrapolated": "extrapolated",
        "taken to go straight": "bridged",
        "begins anew with this survey": "begins_anew",
        "held as it was when what is known of it ended": "held",
        "otherwise than the dates say, as this survey's own outputs show": "not_as_dated",
        "taken to begin in equilibrium, which four sensors of known positions would show": "in_equilibrium",
        "NOT taken off, for the lengths of this survey's vectors refute it": "not_on_this_survey",
        "NOT measuring the field that the others measure, to a tenth of it": "strangers",
        "as if turned since the calibration, which makes the tensor wrong": "turned_since",
        "taken off, though |b| would be nearer to this survey's total field without": "contradicted",
    }
    told_of = (f"{what}: {attributes[name]}" for what, name in each.items() if name in attributes)
    notes = (*summary(found.flags), *told_of)
    return Applied(target, fit_in_words(survey_block(found)) + told, words, notes)


def fit_in_words(block: dict[str, Any] | None) -> str:
    """How well a calibration fits a survey with this error block: |b| against the survey's own total field."""
    figures = (block or {}).get("total_field_rms_nT")
    if not figures or figures["all"] is None:
        return "How well it fits cannot be told: this survey has no total field at its samples."
    known = {name: value for name, value in figures.items() if name != "all" and value is not None}
    each = ", ".join(f"{name} {figure(value)}" for name, value in known.items())
    return f"|b| - F: {figure(figures['all'])} nT rms on this survey ({each})."


def apply_to(
    calibration: Survey,
    path: Path | Held,
    planned: Plan,
    *,
    tolerant: bool = False,
    rows: slice | None = None,
    uniform: bool = False,
    judge: bool = True,
    date: datetime | None = None,
    scatter: float | None = None,
) -> Survey:
    """Another survey, loaded as the recipe loads and corrected with a calibration; the options as in
    `apply_and_refine`."""
    return apply_and_refine(
        calibration,
        path,
        planned,
        tolerant=tolerant,
        rows=rows,
        refine_rotation=False,
        uniform=uniform,
        judge=judge,
        date=date,
        scatter=scatter,
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
    date: datetime | None = None,
    scatter: float | None = None,
) -> tuple[Survey, Tied | None]:
    """Another survey, loaded as the recipe loads and corrected with a calibration.

    Args:
        tolerant, rows: as in `load_as`.
        refine_rotation: turn it into the frame in which its own tensor is symmetric.
        uniform: its field is known to be uniform.
        judge: flag the samples that stand out alone (`standing_out`); the attribute `not_taken_off` of `calibrated/b`
            names effects that cannot be taken off this survey.
        date: that a calibration which changes with time is brought to; the survey's when None.
        scatter: nT, of the survey's offsets about those of the calibration (`offsets_apart`); found when None.

    Returns:
        The survey, and the calibration in its new frame: None where no turn was asked for or is significant. The
        attribute `rotation_refined` of `calibrated/b` says what was done.
    """
    from magtensor.tensor.elements import five
    from magtensor.tensors import refined, refinement_noise, stored_refinement

    survey = load_as(planned, path, tolerant=tolerant, rows=rows)
    if "calibration/matrix" in calibration:
        return _with_sensors_calibrated(
            calibration, survey, planned, str(path),
            refine_rotation=refine_rotation, whole=rows is None, uniform=uniform, judge=judge, date=date,
            scatter=scatter,
        )  # fmt: skip
    source = str(calibration.attributes.get("source", ""))
    if refine_rotation:
        raise DataError("it calibrates no sensors, so there is no common frame to refine", where=source)
    refinement = stored_refinement(calibration)
    if refinement is None:
        raise DataError("it holds no calibration", where=source, hint="name a calibration.nc or result.nc")
    measured = five(survey.values("calibrated/tensor"))
    return survey.merged(refined(measured, refinement_noise(calibration), refinement)), None


def _with_sensors_calibrated(
    calibration: Survey,
    survey: Survey,
    planned: Plan,
    path: str,
    *,
    refine_rotation: bool,
    whole: bool,
    uniform: bool,
    judge: bool,
    date: datetime | None,
    scatter: float | None,
) -> tuple[Survey, Tied | None]:
    """The same of a survey that is loaded, with a calibration of sensors; `whole`: no rows were chosen."""
    from magtensor.calibrated import corrected, require_positions, require_sensors, restored
    from magtensor.calibration.surveys.corrections import with_scatter
    from magtensor.dated import at_date_of
    from magtensor.effect_errors import taken_off
    from magtensor.loop.correcting.stored import (
        begun_anew,
        bridged,
        cleaned,
        contradicted_here,
        held,
        in_equilibrium,
        not_as_dated,
        on_its_clock,
        stored_effects,
        those_here,
        without_unread,
    )  # fmt: skip
    from magtensor.offsets_apart import scatter_for, without_scatter
    from magtensor.platform_frame import as_fitted, with_refined_rotation
    from magtensor.standing_out import before_and_cleaned, flagged
    from magtensor.tensors import assembled, noise_of_a_sample, stored_assembly, stored_refinement

    require_sensors(survey, result.sensors_of(calibration), path)
    if "calibration/position" in calibration:
        require_positions(survey, calibration.values("calibration/position"), path)
    fitted, dated = at_date_of(survey, calibration, restored(calibration), date)
    apart = scatter_for(survey, calibration) if scatter is None else scatter
    fitted = with_scatter(fitted, apart)
    sensed = as_fitted(calibration, fitted)

    adopted, theta, origins = stored_effects(calibration, planned.registry)
    adopted = on_its_clock(adopted, theta, origins, calibration, sensed, survey)
    here = those_here(adopted, theta, origins, sensed, survey, calibration)
    adopted, theta = here.adopted, here.theta
    known = calibration.values("calibration/noise_std") if "calibration/noise_std" in calibration else None
    clean = partial(cleaned, calibration=sensed, adopted=adopted, theta=theta, origins=origins)
    judged = partial(flagged, calibration=fitted, noise=known, uniform=uniform)
    before, survey = before_and_cleaned(survey, clean, judged) if judge and adopted else (survey, clean(survey))
    if whole:
        survey = without_unread(survey, adopted)
    if judge:
        survey = judged(survey)

    words = {
        "not_taken_off": here.left_in,
        "extrapolated": "; ".join(f"{name}: {how}" for name, how in here.beyond.items()),
        "bridged": bridged(before, adopted),
        "begins_anew": begun_anew(adopted, calibration),
        "not_as_dated": not_as_dated(adopted, survey),
        "held": held(adopted, survey),
        "in_equilibrium": in_equilibrium(adopted, survey),
        "not_on_this_survey": here.refuted,
    }
    if whole and (as_read := _better_as_read(before, survey, fitted, adopted)) is not None:
        survey = as_read
        words["total_field_as_read"] = ", ".join(a.name for a in adopted if a.component.effect == "reference")
    given = corrected(fitted, survey, **words)
    doubts: dict[str, str] = {}
    if whole and judge:
        doubts = _disagreeing(np.asarray(given["calibrated/b"][1]), survey)
        doubts["contradicted"] = contradicted_here(before, survey, sensed, adopted, theta, origins)
    survey = survey.merged(_named(given, calibration, dated, apart, doubts))

    turned: Tied | None = None
    if refine_rotation:
        survey, turned = with_refined_rotation(survey, calibration, fitted)
        if turned is not None:  # as it is kept, it holds the scatter beside the covariance
            fitted = turned.calibration
            turned = replace(turned, calibration=without_scatter(fitted, apart))
    if "calibration/tensor_gain" in calibration:
        b = survey.values("calibrated/b")
        noise = noise_of_a_sample(calibration, calibration.values("calibration/noise_std"))
        position = calibration.values("calibration/position")
        off = taken_off(calibration, fitted, before, survey, adopted, theta, origins)
        refinement = stored_refinement(calibration)
        survey = survey.merged(assembled(stored_assembly(calibration), b, position, noise, fitted, refinement, off))
    return survey, turned


def _named(
    given: dict[str, Variable], calibration: Survey, dated: str, scatter: float, doubts: dict[str, str]
) -> dict[str, Variable]:
    """The variables of a calibrated survey, with the words that say whose offsets were taken off, by how many nT they
    scatter about this survey's, the date that the calibration was brought to, and what the survey itself says against
    them."""
    from magtensor.offsets_apart import for_another

    whose = for_another(str(calibration["calibration/matrix"].attrs.get("offset_of", "")), scatter)
    words = {"offset_of": whose, "calibration_date": dated, "offset_scatter_nT": scatter, **doubts}
    dims, values, attributes = given["calibrated/b"]
    return given | {"calibrated/b": (dims, values, dict(attributes) | {k: v for k, v in words.items() if v})}


def _disagreeing(b: Array, survey: Survey) -> dict[str, str]:
    """Words for sensors that do not see what the others see: turned since the calibration, or not measuring at all."""
    from magtensor.calibration.agreement import strangers, turns

    good = survey.good_by_sensor
    total = survey.values("total_field") if "total_field" in survey else np.median(np.linalg.norm(b, axis=2), axis=1)
    if far := strangers(b, good, total):
        named = (f"{survey.sensors[s]} (in {part:.0%} of the samples)" for s, part in far.items())
        return {"strangers": ", ".join(named)}
    turned = turns(b, good)
    return {"turned_since": ", ".join(f"{survey.sensors[s]} by {angle:.2g} deg" for s, angle in turned.items())}


def _told(attributes: Mapping[str, Any]) -> str:
    """The same words, of a calibrated survey's `calibrated/b`, after a sentence."""
    dated, offsets = (attributes.get(name) for name in ("calibration_date", "offset_of"))
    return (f" Calibration: {dated}." if dated else "") + (f" Offsets: {offsets}." if offsets else "")


def verified(calibrated: Survey, path: Path | Held, planned: Plan) -> dict[str, Any]:
    """As `verification`; where the other survey cannot be used, blocks that are None, and why: the fit is as good."""
    try:
        return verification(calibrated, path, planned)
    except DataError as error:
        why = "; ".join(part for part in (error.what, error.hint) if part)
        return {"before": None, "after": None, "not_possible": why}


def verification(calibrated: Survey, path: Path | Held, planned: Plan) -> dict[str, Any]:
    """The error blocks of another survey: with the declared model alone, and with all that was adopted.

    `total_field_as_read` names errors of the base station that were left in (`_better_as_read`), `contradicted`
    effects without which |b| would be nearer to the survey's total field, `extrapolated` those that the survey
    takes beyond what the calibration has seen, `not_on_this_survey` those that its lengths refute, which were left
    in, `strangers` and `turned_since` sensors that do not see what the others see, `left_by_any_calibration_nT` is
    what of |b| - F no other calibration of the sensors would take off, and `share_not_in_use` the part of its samples,
    of all sensors, that are in no figure.
    """
    corrected = apply_to(calibrated, path, planned, uniform=True)
    after = survey_block(corrected)
    before = after
    if "declared/matrix" in calibrated and "calibration/effects" in calibrated:
        alone = apply_to(with_declared_alone(calibrated), path, planned, judge=False)
        before = survey_block(alone.merged({"good": corrected["good"]}))  # the same samples
    unused = 1.0 - float(corrected.good_by_sensor.mean())
    found: dict[str, Any] = {"before": before, "after": after, "share_not_in_use": unused}
    if "total_field" in corrected:
        each = corrected.values("calibrated/b"), corrected.values("total_field"), corrected.good_by_sensor
        found["left_by_any_calibration_nT"] = left_by_any_calibration(*each)
    attributes = corrected["calibrated/b"].attrs
    told = (
        "not_taken_off", "not_on_this_survey", "total_field_as_read", "contradicted", "extrapolated", "strangers",
        "turned_since",
    )  # fmt: skip
    return found | {name: attributes[name] for name in told if name in attributes}


def _better_as_read(
    before: Survey, cleaned: Survey, fitted: ArrayCalibration, adopted: Sequence[Adopted]
) -> Survey | None:
    """The survey with its total field as it was read, if that fits clearly better than without the errors of the base
    station that the calibration holds: they may have ended with its own survey, or another station was there."""
    from magtensor.calibrated import corrected

    if "total_field" not in cleaned or not any(a.component.effect == "reference" for a in adopted):
        return None
    as_read = before["total_field"]
    other = cleaned.merged({"total_field": (("time",), as_read.values, dict(as_read.attrs))})
    errors = [_total_field_error(survey_block(s.merged(corrected(fitted, s)))) for s in (other, cleaned)]
    return other if WORSE * errors[0] < errors[1] else None


def _total_field_error(block: dict[str, Any] | None) -> float:
    value = ((block or {}).get("total_field_rms_nT") or {}).get("all")
    return float("inf") if value is None else float(value)


def with_declared_alone(calibrated: Survey) -> Survey:
    """The calibration before anything was adopted: its own C and o, no effects."""
    from magtensor.survey.model import without_variables

    variables: dict[str, Variable] = {}
    for name in ("matrix", "offset"):
        now = calibrated[f"calibration/{name}"]
        dims = [str(d) for d in now.dims]
        variables[f"calibration/{name}"] = (dims, calibrated.values(f"declared/{name}"), dict(now.attrs))
    return without_variables(calibrated, "calibration/effects").merged(variables)
