"""From surveys to the samples of one fit, and from the fit to a survey's variables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor import DataError, NotEnoughData
from magtensor.calibrated import require_sensors
from magtensor.offsets_apart import HELD, NOT_HELD

if TYPE_CHECKING:
    from magtensor.calibration.surveys.corrections import SurveysCalibration
    from magtensor.calibration.surveys.fit import SurveysFit
    from magtensor.calibration.surveys.samples import Samples
    from magtensor.calibration.types import ArrayCalibration
    from magtensor.survey.model import Survey, Variable


@dataclass(frozen=True)
class Field:
    """What is known of the field.

    Attributes:
        kind: "measured", "constant", "per_survey" or "per_segment", the last three without a scalar reference.
        declared: nT, of a total field that was not measured; None where nobody says.
        vector: whether the attitude and the world field tell its direction.
    """

    kind: str
    declared: float | None
    vector: bool

    @property
    def measured(self) -> bool:
        return self.kind == "measured"


def has_measured_field(survey: Survey) -> bool:
    """Whether a reference tells the size of the field; a number that somebody gave does not."""
    found = next((p for p in ("total_field", "reference/total_field") if p in survey), None)
    return found is not None and survey[found].attrs.get("origin") != "constant"


def usable_samples(survey: Survey, field: Field, name: str) -> np.ndarray:
    """(N,) samples that may enter the fit.

    Raises:
        DataError: a variable that the fit needs is not there.
        NotEnoughData: there is none.
    """
    needed = ["b_raw"]
    needed += ["total_field"] if field.measured and not field.vector else []
    needed += ["segment"] if field.kind == "per_segment" else []
    needed += ["attitude", "reference/world_field"] if field.vector else []
    for path in needed:
        if path not in survey:
            raise DataError(f"calibrate_joint needs {path}, which this survey does not have", where=name)
    use = survey.readings & np.isfinite(survey.values("b_raw")).all(axis=(1, 2))
    if field.measured and "total_field" in survey:
        use &= np.isfinite(survey.values("total_field"))
    if field.vector:
        use &= np.isfinite(survey.values("attitude")).all(axis=1)
    if not use.any():
        lacking = " and a total field" if field.measured else ""
        raise NotEnoughData(f"no sample has all sensors in use{lacking}", where=name)
    return use


def samples_of(survey: Survey, use: np.ndarray, field: Field) -> Samples:
    """The samples of one survey; a total field that is not known is the size of the raw outputs."""
    from magtensor.attitude import into_platform
    from magtensor.calibration.surveys.samples import Samples
    from magtensor.loop.fitting.record import runs

    raw = np.asarray(survey.values("b_raw"), dtype=float)[use]
    segment = np.asarray(survey.values("segment"), dtype=int) if "segment" in survey else np.zeros(len(use), dtype=int)
    direction = None
    if field.vector:
        world = np.asarray(survey.values("reference/world_field"), dtype=float)
        direction = into_platform(survey.values("attitude"), world / np.linalg.norm(world))[use]
    if field.measured and "total_field" in survey:
        total_field = np.asarray(survey.values("total_field"), dtype=float)[use]
    elif field.declared is not None:
        total_field = np.full(len(raw), field.declared)
    elif field.vector:
        total_field = np.full(len(raw), float(np.linalg.norm(survey.values("reference/world_field"))))
    else:
        total_field = np.full(len(raw), float(np.median(np.linalg.norm(raw, axis=2))))
    level = None
    if field.kind == "per_survey":
        level = np.zeros(len(raw), dtype=int)
    elif field.kind == "per_segment":
        level = np.unique(segment[use], return_inverse=True)[1]
    none = np.zeros(len(raw), dtype=int)
    return Samples(raw, total_field, runs(survey.time, segment)[use], none, level, direction)


def named_surveys(survey: Survey) -> list[tuple[str, Survey]]:
    """This survey and the further ones that its recipe names."""
    further = survey.source.further_surveys() if survey.source is not None else []
    own = str(survey.attributes.get("source", ""))
    return [(own.rsplit("/", 1)[-1] or "this survey", survey), *further]


def gathered(surveys: Sequence[tuple[str, Survey]], field: Field) -> tuple[list[str], list[np.ndarray], Samples]:
    """Names of all surveys, which samples of each are used, and those samples."""
    from magtensor.calibration.surveys.samples import joined

    survey = surveys[0][1]
    names, uses, parts = [], [], []
    for i, (name, one) in enumerate(surveys):
        for _, other in surveys[:i]:
            if np.array_equal(one.values("b_raw"), other.values("b_raw"), equal_nan=True):
                both = " and ".join(str(s.attributes.get("source", "this survey")) for s in (other, one))
                raise DataError(f"{both} hold the same samples, which would count twice", hint="name one of them")
        require_sensors(one, survey.sensors, name)
        uses.append(usable_samples(one, field, name))
        parts.append(samples_of(one, uses[-1], field))
        names.append(name)
    size = float(np.median(np.concatenate([p.total_field for p in parts])))
    if not field.measured and not field.vector:  # one number for all: a scale of its own for each would be a claim
        parts = [replace(p, total_field=np.full(len(p.raw), size)) for p in parts]
    return names, uses, joined(parts)


@contextmanager
def attitude_suspected(
    surveys: Sequence[tuple[str, Survey]], uses: Sequence[np.ndarray], field: Field
) -> Iterator[None]:
    """Where a fit with a vector reference is refused, ask first whether the attitude (`misread`) is to blame."""
    from magtensor.calibration.coverage import coverage_alone
    from magtensor.misread import require_following

    try:
        yield
    except DataError:
        if not field.vector:
            raise
        for (name, one), use in zip(surveys, uses, strict=True):
            world = np.asarray(one.values("reference/world_field"), dtype=float)
            b = np.asarray(one.values("b_raw"), dtype=float)[use].mean(axis=1)
            found, centre = coverage_alone(b, np.full(len(b), np.linalg.norm(world)))
            try:
                require_following(one.values("attitude")[use], b - centre if found.determined else b, world)
            except DataError as error:
                where = name if len(surveys) > 1 else error.where
                raise DataError(error.what, where=where, hint=error.hint) from error
        raise


def with_declared_size(survey: Survey, field: Field, calibration: ArrayCalibration) -> ArrayCalibration:
    """The calibration that says so where the size of the field is the world field's, which somebody gave."""
    from magtensor.calibration.common_scale import COMMON_SCALE

    if not field.vector or has_measured_size(survey):
        return calibration
    words = f"{COMMON_SCALE}: the size of the world field was declared, not measured"
    return replace(calibration, unobservable=(*calibration.unobservable, words))


def has_measured_size(survey: Survey) -> bool:
    """Whether the total field at the samples was measured."""
    return "total_field" in survey and survey["total_field"].attrs.get("origin") != "constant"


def doubted_in(survey: Survey, used: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """(N,) samples of a survey that a fit left out, of those used (N,) in it; it is the first of the samples kept."""
    doubted = np.zeros(len(survey.time), dtype=bool)
    own = np.flatnonzero(used)
    doubted[own[~keep[: len(own)]]] = True
    return doubted


def offset_words(names: Sequence[str], offset: np.ndarray, mean: bool) -> str:
    """Whose offsets a calibration holds, and how far those of the surveys, (K, S, 3) nT, lie apart."""
    count = len(offset)
    if len(names) == 1:
        return ""
    if count == 1:
        return f"one for all of the {len(names)} surveys fitted"
    apart = float(np.sqrt(np.mean(np.var(offset, axis=0, ddof=1))))
    scatter = f"they scatter by {apart:.3g} nT between the {count} surveys"
    if mean:
        return f"the mean of {', '.join(names)}; {scatter}, {HELD}"
    return f"those of {names[0]}; {scatter}, {NOT_HELD}"


def survey_variables(
    names: Sequence[str], fit: SurveysFit, calibration: SurveysCalibration, sensors: list[str], factor: float
) -> dict[str, Any]:
    """The offsets of every survey with the covariance of all parameters, and the unknown constants of the field,
    which are the fit's times a factor."""
    given: dict[str, Any] = {}
    if fit.data.level is not None:
        levels, first = np.unique(fit.data.level, return_index=True)
        attributes = {"units": "nT", "long_name": "total field, an unknown constant, in the scale of this calibration"}
        given["calibration/level"] = (("level",), levels, {"long_name": "number of the constant, survey by survey"})
        given["calibration/total_field"] = (("level",), fit.found.sums.total_field[first] * factor, attributes)
    if len(names) == 1 or len(calibration.offset) == 1:
        return given
    given["calibration/survey"] = survey_names(names)
    return given | offset_variables(names, sensors, calibration.offset, calibration.covariance, calibration.common)


def survey_names(names: Sequence[str]) -> Variable:
    """The surveys of a fit."""
    return ("survey",), np.array(names), {"long_name": "surveys fitted together"}


def offset_variables(
    names: Sequence[str], sensors: list[str], offset: np.ndarray, covariance: np.ndarray, common: ArrayCalibration
) -> dict[str, Any]:
    """The offsets (K, S, 3) nT of every survey, and the covariance of this survey's matrices and all offsets."""
    elements = [f"{s}:matrix_{i}{j}" for s in sensors for i in "xyz" for j in "xyz"]
    parameters = elements + [f"{n}:{s}:offset_{j}" for n in names for s in sensors for j in "xyz"]
    facts = {"units": "products of the parameters' units (1, nT)", "frame": common.frame}
    return {
        "calibration/survey_offset": (("survey", "sensor", "raw_axis"), offset, {"units": "nT"}),
        "calibration/survey_parameter": (("survey_parameter",), np.array(parameters), {}),
        "calibration/survey_covariance": (("survey_parameter", "survey_parameter_"), covariance, facts),
    }
