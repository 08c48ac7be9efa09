"""From surveys to the samples of one fit, and from the fit to a survey's variables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor import DataError, NotEnoughData
from magtensor.calibrated import require_sensors

if TYPE_CHECKING:
    from magtensor.calibration.surveys.corrections import SurveysCalibration
    from magtensor.calibration.surveys.fit import SurveysFit
    from magtensor.calibration.surveys.samples import Samples
    from magtensor.survey.model import Survey


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
    use = survey.good & np.isfinite(survey.values("b_raw")).all(axis=(1, 2))
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
    from magtensor.loop.record import runs

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


def gathered(survey: Survey, field: Field) -> tuple[list[str], list[np.ndarray], Samples]:
    """Names of all surveys, which samples of each are used, and those samples."""
    from magtensor.calibration.surveys.samples import joined

    further = survey.source.further_surveys() if survey.source is not None else []
    own = str(survey.attributes.get("source", ""))
    surveys = [(own.rsplit("/", 1)[-1] or "this survey", survey), *further]
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


def offset_words(names: Sequence[str], calibration: SurveysCalibration, mean: bool) -> str:
    """Whose offsets a calibration holds, and how far those of the surveys lie apart."""
    count = len(calibration.offset)
    if len(names) == 1:
        return ""
    if count == 1:
        return f"one for all of the {len(names)} surveys fitted"
    apart = float(np.sqrt(np.mean(np.var(calibration.offset, axis=0, ddof=1))))
    scatter = f"they scatter by {apart:.3g} nT between the {count} surveys"
    if mean:
        return f"the mean of {', '.join(names)}; {scatter}, which their standard deviations hold"
    return f"those of {names[0]}; {scatter}, which their standard deviations do not hold"


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
    elements = [f"{s}:matrix_{i}{j}" for s in sensors for i in "xyz" for j in "xyz"]
    parameters = elements + [f"{n}:{s}:offset_{j}" for n in names for s in sensors for j in "xyz"]
    facts = {"units": "products of the parameters' units (1, nT)", "frame": calibration.common.frame}
    return given | {
        "calibration/survey": (("survey",), np.array(names), {"long_name": "surveys fitted together"}),
        "calibration/survey_offset": (("survey", "sensor", "raw_axis"), calibration.offset, {"units": "nT"}),
        "calibration/survey_parameter": (("survey_parameter",), np.array(parameters), {}),
        "calibration/survey_covariance": (
            ("survey_parameter", "survey_parameter_"), calibration.covariance, facts,
        ),
    }  # fmt: skip
