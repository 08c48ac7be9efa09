"""The stage that closes the loop: fit, look at what is left, trace it to an effect, add it, fit again."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from magtensor import ErrorModelsChoice, stage
from magtensor.errors import NotEnoughData
from magtensor.survey.flags import flag_ranges
from magtensor_stages.sensors import COMMON, common_frame

if TYPE_CHECKING:
    from magtensor.calibration.types import ArrayCalibration
    from magtensor.loop.inquiry import Inquiry
    from magtensor.loop.searching.found import Search
    from magtensor.survey.model import Survey


@stage(
    needs=("b_raw", "total_field"),
    uses=("*", "reference/time", "reference/total_field"),
    gives=(*COMMON, "loop/verdict", "calibration/slow_noise_std"),
    may_give=("residual/contrast", "good", "declared/matrix", "declared/offset"),
)
def close_loop(
    survey: Survey,
    inquiry: Inquiry | None = None,
    *,
    declared: ErrorModelsChoice = (),
    search: ErrorModelsChoice = None,
    false_alarm: Annotated[
        float, Field(gt=0, lt=1, description="probability that a survey without any effect passes the first gate")
    ] = 0.005,
    most_effects: Annotated[int, Field(ge=0, description="stop after so many adoptions")] = 8,
    reference_noise_nT: Annotated[float, Field(ge=0, description="white noise of the total field, nT")] = 0.0,
    worst_error: Annotated[
        float, Field(gt=0, le=1, description="refuse a fit whose predicted error of |b| reaches this fraction of F")
    ] = 0.05,
    decisions: Annotated[
        tuple[str, ...],
        Field(description="`adopt NAME [setting=value ...]`, `reject NAME` or `loop`, taken in order; default: `loop`"),
    ] = (),
    undetermined: Annotated[
        Literal["nominal", "refuse"],
        Field(
            description="attitudes that do not determine the calibration: search with sensors near nominal (see below) "
            "and say so, or refuse the survey"
        ),
    ] = "nominal",
    nominal_scale: Annotated[
        float, Field(gt=0, le=0.5, description="assumed then, one standard deviation: relative, of a scale factor")
    ] = 0.1,
    nominal_angle_deg: Annotated[
        float, Field(gt=0, le=30, description="likewise: of the direction of an axis, deg")
    ] = 6.0,
    nominal_offset: Annotated[
        float, Field(gt=0, le=2, description="likewise: of an offset, as a part of the total field")
    ] = 0.1,
) -> dict[str, Any]:
    """Calibrate all sensors jointly, find the effects that the declared model lacks, and refit with them.

    `declared` names error models that are in the model from the beginning (with settings, or none); `search` those
    that may be adopted, all that are installed if left out. `decisions` of a person (`magtensor explore` records them)
    take the place of the loop's own. An inquiry that has been made already is used as it stands. Where the attitudes do
    not determine the calibration (level flight), what is known of sensors beforehand stands in, and the result says so.
    """
    from magtensor.calibration.nominal import Nominal
    from magtensor.loop.decisions import Decision, decision_of
    from magtensor.loop.evidence.own_noise import OwnNoise
    from magtensor.loop.fitting.model import Fitting
    from magtensor.loop.inquiry import inquiry_of
    from magtensor.loop.near_nominal import settled
    from magtensor.loop.searching.unexplained import unexplained
    from magtensor.tensors import slow_noise_variables

    def inquired(how: Fitting) -> Inquiry:
        begun = inquiry_of(
            survey,
            dict(declared or {}),
            [component for component, _ in dict(search or {}).values()],
            how,
            most_effects=most_effects,
            alpha=false_alarm,
        )
        for decision in [decision_of(text) for text in decisions] or [Decision("loop")]:
            begun.decide(decision)
        return begun

    nominal = None if undetermined == "refuse" else Nominal(nominal_scale, nominal_angle_deg, nominal_offset)
    if inquiry is None:
        try:
            inquiry, found, refused = settled(inquired, Fitting(reference_noise_nT, worst_error), nominal)
        except NotEnoughData as error:
            raise _or_by_directions(error, survey) from error
    else:
        made = inquiry
        inquiry, found, refused = settled(lambda _: made, made.how, None)
    left = unexplained(found, found.record)
    slow = slow_noise_variables(OwnNoise(found.told.residual, None).slow_std())
    outcome: dict[str, Any] = {"unexplained": left, "held_out": _held_out(inquiry, found)}
    found = inquiry.on_every_sample(found)
    calibration, facts, errors = _calibration(survey, found, refused, all_noise=not left["present"])
    names = [a.name for a in inquiry.declared]
    outcome |= {"declared": ["linear", *names], **inquiry.told(found), **facts}
    return {
        **_cleaned(survey, found, calibration),
        **errors,
        **slow,
        **_as_declared(survey, inquiry, found),
        "loop/verdict": ((), json.dumps(outcome, default=float), {}),
        **_flags(survey, found),
    }


def _held_out(inquiry: Inquiry, found: Search) -> dict[str, Any]:
    """The errors on held-out blocks, without what was adopted and with it."""
    from magtensor.calibration.joint import calibrated
    from magtensor.loop.correcting.correction import as_elsewhere
    from magtensor.loop.fitting.errors_before_after import folds_for, held_out, held_out_error

    record, keep, folds = found.record, found.last.fit.keep, folds_for(found.last)
    without = held_out(record, inquiry.declared, inquiry.how, found.first.theta, keep, folds)
    before = held_out_error(record, without, keep)
    if len(found.last.adopted) == len(inquiry.declared):
        return {"before": before, "after": before}
    seen = as_elsewhere(record, calibrated(found.last.fit), found.last)
    together = held_out(seen, found.last.adopted, found.how, found.last.theta, keep, folds)
    return {"before": before, "after": held_out_error(seen, together, keep)}


def _calibration(
    survey: Survey, found: Search, refused: str, *, all_noise: bool
) -> tuple[ArrayCalibration, dict[str, Any], dict[str, Any]]:
    """The calibration, what the verdict has to say of how well it is known, and the errors of the coefficients."""
    from magtensor.calibration.joint import calibrated
    from magtensor.calibration.known import facts_of, known_to
    from magtensor.effect_errors import coefficient_variables, with_coefficients
    from magtensor.loop.fitting.refit import with_colour
    from magtensor.loop.near_nominal import doubt_of, labelled
    from magtensor.loop.remainder.excess import noise_floor

    last, errors = with_colour(found.record, found.last, found.how), {}
    calibration = calibrated(last.fit)
    if last.adopted and last.fit.posterior is None:
        together = with_coefficients(last)
        calibration, errors = together.calibration, coefficient_variables(together, survey.sensors)
    known = known_to(calibration, last.excitation.field[last.fit.keep, 0])
    floor = noise_floor(found.told.residual, all_noise=all_noise)
    doubt = doubt_of(found, found.how, known, refused)
    facts = {"noise_floor_nT": floor, "calibration": doubt.facts() if doubt else facts_of(known, floor)}
    return labelled(calibration, doubt) if doubt else calibration, facts, errors


def _cleaned(survey: Survey, found: Search, calibration: ArrayCalibration) -> dict[str, Any]:
    """The field in the common frame without the effects, and what is stored of these."""
    from magtensor.loop.correcting.stored import cleaned, effect_variables

    last, record = found.last, found.record
    undisturbed = np.array(survey.readings)
    undisturbed[record.samples[~last.fit.keep]] = False
    believed = np.zeros(len(survey.time), dtype=bool)
    believed[record.samples[last.fit.keep]] = True
    clean = cleaned(survey, calibration, last.adopted, last.theta, record.origins, undisturbed)
    effects = effect_variables(last.adopted, last.theta, record.origins, survey, believed)
    return common_frame(clean, calibration, "joint") | effects


def _as_declared(survey: Survey, inquiry: Inquiry, found: Search) -> dict[str, Any]:
    """As a user has it who looks for no effect: without what nothing that was declared explains."""
    from magtensor.calibration.joint import calibrated
    from magtensor.loop.fitting.refit import settled

    same = len(found.last.adopted) == len(inquiry.declared)
    alone = calibrated((found.last if same else settled(found.record, found.first, inquiry.how)).fit)
    before_fit = np.linalg.norm(survey.values("b_raw"), axis=2) - survey.values("total_field")[:, None]
    return {
        "residual/total_field_before": (("time", "sensor"), before_fit, {"units": "nT", "long_name": "|b_raw| - F"}),
        "declared/matrix": (("sensor", "axis", "raw_axis"), alone.matrix, {}),
        "declared/offset": (("sensor", "raw_axis"), alone.offset, {"units": "nT"}),
    }


def _flags(survey: Survey, found: Search) -> dict[str, Any]:
    """The samples that have no part in the fit, and why."""
    from magtensor.loop.correcting.stored import SHIFTED
    from magtensor.loop.fitting.model import unread
    from magtensor.loop.fitting.refit import disturbed

    last, record = found.last, found.record
    if last.fit.keep.all():
        return {}
    doubted = np.zeros(len(survey.time), dtype=bool)
    doubted[record.samples[disturbed(record, last, found.how)]] = True
    doubted = survey.made_from(doubted)
    shifted = unread(last.adopted, survey.time)
    usable = survey.good_by_sensor & ~(doubted | shifted)[:, None]
    return {
        "good": (("time", "sensor"), usable, {"long_name": "may be used"}),
        "flags": [
            *flag_ranges(survey.time, doubted, by="close_loop", reason="no calibration and no noise explain it"),
            *flag_ranges(survey.time, shifted, by="close_loop", reason=SHIFTED),
        ],
    }


def _or_by_directions(error: NotEnoughData, survey: Survey) -> NotEnoughData:
    """A refusal that names what an attitude is good for, where a single sensor has one."""
    if len(survey.sensors) > 1 or "attitude" not in survey:
        return error
    also = "the survey has an attitude: `calibrate_vector` in the place of close_loop calibrates by known directions"
    return type(error)(error.what, where=error.where, hint="; ".join(h for h in (error.hint, also) if h))
