"""The stage that calibrates all sensors and the reference in one fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from magtensor import ErrorModelsChoice, NotEnoughData, UsageError, stage
from magtensor.calibration.coverage import WORST_ERROR
from magtensor.components import Declares
from magtensor.survey.flags import flag_ranges
from magtensor_methods.scalar_options import WorstError
from magtensor_stages import joint_effects, joint_surveys
from magtensor_stages.joint_changing import changing_with_date
from magtensor_stages.sensors import COMMON, common_frame, naming

if TYPE_CHECKING:
    from magtensor.calibration.recording import Recording
    from magtensor.calibration.types import ArrayCalibration
    from magtensor.survey.model import Survey

NoiseOfReference = Annotated[float, Field(ge=0, description="white noise of the total field, nT")]
Robust = Annotated[
    bool, Field(description="leave out samples that no noise explains; of fewer than 50 none is, they bend the fit")
]
TotalField = Annotated[
    Literal["measured", "constant", "per_survey", "per_segment"],
    Field(
        description="the reference's total field, or, without one, an unknown constant: over all samples, of each "
        "survey, or of each segment. What is then unobservable is one scale of all sensors"
    ),
]
DeclaredField = Annotated[
    float | None,
    Field(
        gt=1000,
        lt=1e6,
        description="size of a total field that was not measured (a model's value), nT; on average, where it is an "
        "unknown constant of each survey or segment. Default: the mean sensitivity is nominal",
    ),
]
VectorReference = Annotated[
    bool, Field(description="use the logged attitude and the reference's world field, which tell the rotation too")
]
AttitudeStd = Annotated[
    float | None,
    Field(gt=0, lt=30, description="standard deviation of the attitude about each axis, deg; default: from the data"),
]
MatricesOf = Annotated[
    Literal["common", "linear"],
    Field(
        description="with further surveys: all share one C (scale factors and angles), or C changes linearly with the "
        "date of the survey; `magtensor apply` then takes the date of the survey that it is applied to"
    ),
]
OffsetsOf = Annotated[
    Literal["own", "common", "linear"],
    Field(
        description="with further surveys: each has its own offsets, or all share one, or offsets change linearly with "
        "the date"
    ),
]
OffsetTaken = Annotated[
    Literal["this", "mean"],
    Field(
        description="the offsets that this result and `magtensor apply` use: those of this survey, or the mean of all, "
        "the guess for a survey that was not in the fit, with the scatter between surveys in their covariance"
    ),
]


NOT_DATED = "calibrate_joint: error_models are not fitted together with {}: linear; leave one of them out"
DATED = "calibrate_joint: {}: linear needs further surveys (survey: {{with: [...]}}), at other dates"
UNMEASURED = (
    "calibrate_joint: a change with the date needs a measured total field; one that is unknown in each survey hides a "
    "change of all sensitivities"
)
TWO_SIZES = (
    "calibrate_joint: vector_reference: true knows the size of the world field, which total_field: {} would put aside; "
    "leave total_field out, or declare another size with total_field_nT"
)
MEAN_OF_OWN = "calibrate_joint: offset_of: mean needs further surveys with offsets of their own"


def declares(options: Mapping[str, Any], *, several: bool = False) -> Declares:
    """What is needed depends on what is known of the field; what agrees, on whether there are further surveys too.

    Raises:
        UsageError: options contradict each other.
    """
    field = _field(options["total_field"], options["total_field_nT"], options["vector_reference"])
    together = (options[name] for name in ("attitude_std_deg", "matrices", "offsets", "offset_of", "error_models"))
    _require_agreement(field, *together, several=several)
    needs = ["b_raw", "total_field"] if field.measured and not field.vector else ["b_raw"]
    needs += ["segment"] if field.kind == "per_segment" else []
    needs += ["attitude", "reference/world_field"] if field.vector else []
    always = tuple(p for p in COMMON if not p.startswith("residual/"))
    gives = COMMON if "total_field" in needs else always
    uses: tuple[str, ...] = ("total_field", "reference/total_field", "segment", "attitude", "reference/world_field")
    if options["error_models"]:
        uses = ("*", *uses, "reference/time")
    return Declares(
        tuple(needs),
        uses,
        gives,
        ("residual/contrast", "residual/total_field", "residual/total_field_before", "good"),
    )


def _require_agreement(
    field: joint_surveys.Field,
    attitude_std_deg: float | None,
    matrices: str,
    offsets: str,
    offset_of: str,
    error_models: object,
    *,
    several: bool,
) -> None:
    if attitude_std_deg is not None and not field.vector:
        raise UsageError("calibrate_joint: attitude_std_deg needs vector_reference: true; no attitude is used without")
    if field.vector and not field.measured and field.declared is None:
        raise UsageError(TWO_SIZES.format(field.kind))
    for name, value in (("matrices", matrices), ("offsets", offsets)):
        if value == "linear" and not several:
            raise UsageError(DATED.format(name))
        if value == "linear" and not field.measured:
            raise UsageError(UNMEASURED)
    if offset_of == "mean" and (offsets != "own" or not several):
        raise UsageError(MEAN_OF_OWN)
    for name, value in (("matrices", matrices), ("offsets", offsets)):
        if value == "linear" and error_models:
            raise UsageError(NOT_DATED.format(name))


def calibrate_recording(
    survey: Survey,
    recording: Recording,
    *,
    reference_noise_nT: NoiseOfReference = 0.0,
    robust: Robust = True,
    worst_error: WorstError = WORST_ERROR,
    **others: Any,
) -> tuple[dict[str, Any], np.ndarray]:
    """The variables of a survey calibrated by a recording, and which samples (N,) of the recording no noise explains.

    The recording is the survey itself, or a longer one of which it is a selection.

    Raises:
        UsageError: other options than these are set.
    """
    for name, value in others.items():
        if value != _PLAIN[name]:
            said = value if isinstance(value, str | bool | float | int) else f"[{', '.join(value)}]"
            raise UsageError(f"calibrate_joint: {name}: {said} needs the whole survey at once; leave --memory away")
    with naming(survey):
        calibration, doubted = _from_recording(recording, reference_noise_nT, robust, worst_error)
    return common_frame(survey, calibration, "joint"), doubted


_PLAIN: dict[str, Any] = {
    "total_field": "measured", "total_field_nT": None, "vector_reference": False, "attitude_std_deg": None,
    "matrices": "common", "offsets": "own", "offset_of": "this", "error_models": {},
}  # fmt: skip


@stage(declares=declares, several=True, long=calibrate_recording)
def calibrate_joint(
    survey: Survey,
    *,
    reference_noise_nT: NoiseOfReference = 0.0,
    robust: Robust = True,
    worst_error: WorstError = WORST_ERROR,
    total_field: TotalField = "measured",
    total_field_nT: DeclaredField = None,
    vector_reference: VectorReference = False,
    attitude_std_deg: AttitudeStd = None,
    matrices: MatricesOf = "common",
    offsets: OffsetsOf = "own",
    offset_of: OffsetTaken = "this",
    error_models: ErrorModelsChoice = (),
) -> dict[str, Any]:
    """Calibrate all sensors and the reference in one fit: maximum likelihood over every C and o, the unknown field of
    each sample eliminated.

    One common frame, the nearest to the raw axes, or the platform's with a vector reference; the covariance of all
    parameters. Samples that no noise explains are flagged. Further surveys that the recipe names (`survey: {with:
    [...]}`) are fitted together with this one. `error_models` names effects whose coefficients are fitted together with
    C and o, each with its settings, without asking whether the data want them (`close_loop` asks); what is not set has
    the error model's default. A recording of any length is read once (`--memory`).
    """
    from magtensor.calibration.recording import InMemory

    field = _field(total_field, total_field_nT, vector_reference)
    several = survey.source is not None and bool(survey.source.further_files())
    _require_agreement(field, attitude_std_deg, matrices, offsets, offset_of, error_models, several=several)
    if total_field == "measured" and total_field_nT is not None and joint_surveys.has_measured_field(survey):
        raise UsageError(
            f"calibrate_joint: total_field_nT: {total_field_nT:g} would put the survey's measured total field aside; "
            "leave it out, or say total_field: constant"
        )
    chosen, effects = dict(error_models), None
    extra: dict[str, Any] = {}
    if chosen or several or field.vector or field.kind.startswith("per_"):
        how = (reference_noise_nT, attitude_std_deg, robust, worst_error)
        if "linear" in (matrices, offsets):
            calibration, extra, doubted = changing_with_date(survey, field, how, matrices, offsets, offset_of == "mean")
        else:
            calibration, extra, doubted, effects = _from_surveys(
                survey, field, how, offsets == "common", offset_of == "mean", chosen
            )
    else:
        where = str(survey.attributes.get("source", ""))
        usable = joint_surveys.usable_samples(survey, field, where)
        raw = survey.values("b_raw")
        if field.measured:
            size = survey.values("total_field")
        else:
            typical = float(np.median(np.linalg.norm(raw[usable], axis=2)))
            size = np.full(len(raw), typical if field.declared is None else field.declared)
        with naming(survey):
            recording = InMemory(raw, size, usable)
            calibration, doubted = _from_recording(recording, reference_noise_nT, robust, worst_error)
        if not field.measured:
            aside = joint_surveys.has_measured_field(survey)
            calibration, _ = _without_reference(calibration, field, float(size[0]), aside)
    clean = survey if effects is None else effects.cleaned(survey)
    given = common_frame(clean, calibration, "joint") | extra
    if effects is not None:
        given |= effects.variables(survey) | _before(survey)
    if offsets_of := extra.pop("offset_of", ""):
        dims, values, attributes = given["calibration/matrix"]
        given["calibration/matrix"] = (dims, values, dict(attributes) | {"offset_of": offsets_of})
        del given["offset_of"]
    return given | _flagged(survey, doubted)


ALL_THE_SAME = "close_loop looks for effects all the same, with sensors taken near nominal (undetermined: nominal)"
DOUBTED = "no calibration and no noise explain it"


def _field(kind: str, declared: float | None, vector: bool) -> joint_surveys.Field:
    """A declared size says that nothing was measured."""
    return joint_surveys.Field("constant" if kind == "measured" and declared is not None else kind, declared, vector)


def _from_recording(
    recording: Recording, reference_noise: float, robust: bool, worst_error: float
) -> tuple[ArrayCalibration, np.ndarray]:
    from magtensor.calibration.joint import calibrated, fit_recording

    usable = np.ones(recording.count, dtype=bool) if recording.usable is None else recording.usable
    if not usable.any():
        raise NotEnoughData("no sample has all sensors in use and a total field")
    try:
        fit = fit_recording(recording, reference_noise=reference_noise, robust=robust, worst_error=worst_error)
    except NotEnoughData as error:
        hint = "; ".join(p for p in (error.hint, ALL_THE_SAME) if p)
        raise type(error)(error.what, where=error.where, hint=hint) from error
    return calibrated(fit), usable & ~fit.keep


def _before(survey: Survey) -> dict[str, Any]:
    """|b| - F of the survey as it was, where `common_frame` gives that of the survey without the effects."""
    if "total_field" not in survey:
        return {}
    before = np.linalg.norm(survey.values("b_raw"), axis=2) - survey.values("total_field")[:, None]
    attributes = {"units": "nT", "long_name": "|b_raw| - F"}
    return {"residual/total_field_before": (("time", "sensor"), before, attributes)}


def _flagged(survey: Survey, doubted: np.ndarray) -> dict[str, Any]:
    """The samples (N,) that no noise explains."""
    if not doubted.any():
        return {}
    doubted = survey.made_from(doubted)
    good = survey.good_by_sensor & ~doubted[:, None]
    return {
        "good": (("time", "sensor"), good, {"long_name": "may be used"}),
        "flags": flag_ranges(survey.time, doubted, by="calibrate_joint", reason=DOUBTED),
    }


def _without_reference(
    calibration: ArrayCalibration, field: joint_surveys.Field, size: float, aside: bool
) -> tuple[ArrayCalibration, float]:
    """The scale that nothing tells put by declaration or by convention, said to be so, and the factor it took; aside:
    a measured total field would have told it."""
    from magtensor.calibration.common_scale import ASIDE, DECLARED, UNMEASURED, nominal_scale

    why = ASIDE if aside else UNMEASURED

    if field.declared is not None:
        words = (*calibration.unobservable, f"{DECLARED} ({field.declared:g} nT); {why}")
        return replace(calibration, unobservable=words), 1.0
    scaled, factor, std = nominal_scale(calibration)
    facts: dict[str, float | str] = {"total_field_nT": size * factor, "total_field_std_nT": size * std}
    *others, scale = scaled.unobservable
    words = (*others, f"{scale}; {why} (it is then {size * factor:.6g} nT, to {size * std:.2g} nT)")
    return replace(scaled, diagnostics=calibration.diagnostics | facts, unobservable=words), factor


def _from_surveys(
    survey: Survey,
    field: joint_surveys.Field,
    how: tuple[float, float | None, bool, float],
    common_offsets: bool,
    mean: bool,
    chosen: joint_effects.Chosen,
) -> tuple[ArrayCalibration, dict[str, Any], np.ndarray, joint_effects.Effects | None]:
    """The calibration, what else is told of it, the samples (N,) of this survey that no noise explains, and the effects
    that were chosen."""
    from magtensor.calibration.surveys.agreeing import disagreement_in_words
    from magtensor.calibration.surveys.corrections import calibrated_surveys
    from magtensor.calibration.surveys.fit import fit_surveys
    from magtensor.effect_errors import surveys_with_coefficients
    from magtensor.offsets_apart import SCATTER, scatter_variable

    reference_noise, attitude_std_deg, robust, worst_error = how
    surveys = joint_surveys.named_surveys(survey)
    names, uses, samples = joint_surveys.gathered(surveys, field)
    options: dict[str, Any] = {
        "common_offsets": common_offsets,
        "reference_noise": reference_noise,
        "attitude": None if attitude_std_deg is None else float(np.radians(attitude_std_deg)),
        "robust": robust,
        "worst_error": worst_error,
        "mean_field": field.declared,
    }
    beside = None
    with naming(survey), joint_surveys.attitude_suspected(surveys, uses, field):
        if chosen:
            state, means = joint_effects.surveys_fitted(surveys, uses, samples, field, chosen, options)
            fit, samples = state.fit, state.samples
            beside = surveys_with_coefficients(state, calibrated_surveys(fit))
            found = beside.calibration
        else:
            fit = fit_surveys(samples, **options)
            found = calibrated_surveys(fit)
    calibration, factor = found.of_another() if mean else found.of_survey(0), 1.0
    if not field.measured:
        aside = any(joint_surveys.has_measured_field(one) for _, one in surveys)
        typical = float(np.mean(fit.found.sums.total_field))
        calibration, factor = _without_reference(calibration, field, typical, aside)
        if field.declared is None:
            found, beside = found.nominal(), None if beside is None else beside.nominal()
    else:
        calibration = joint_surveys.with_declared_size(survey, field, calibration)
    extra = joint_surveys.survey_variables(names, fit, found, survey.sensors, factor)
    if len(found.offset) > 1 and not mean:
        extra[SCATTER] = scatter_variable(survey, found.scatter)
    if words := disagreement_in_words(fit, samples, names):
        calibration.diagnostics["disagreement"] = words
    if words := joint_surveys.offset_words(names, found.offset, mean):
        extra["offset_of"] = words
    if beside is None:
        effects = None
    else:
        effects = joint_effects.Effects(state.adopted, state.theta, means, beside.beside(calibration, mean))
    return calibration, extra, joint_surveys.doubted_in(survey, uses[0], fit.keep), effects
