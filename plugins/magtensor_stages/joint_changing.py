"""Several surveys whose C or offsets change linearly with the date, from their samples to a survey's variables."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor_stages import joint_surveys
from magtensor_stages.sensors import naming

if TYPE_CHECKING:
    from magtensor.calibration.types import ArrayCalibration
    from magtensor.survey.model import Survey


def changing_with_date(
    survey: Survey,
    field: joint_surveys.Field,
    how: tuple[float, float | None, bool, float],
    matrices: str,
    offsets: str,
    mean: bool,
) -> tuple[ArrayCalibration, dict[str, Any], np.ndarray]:
    """The calibration at this survey's date, what else is told of it and how it changes, and the samples (N,) of this
    survey that no noise explains.

    Raises:
        DataError: a survey's clock does not tell its date, or they all have one.
    """
    from magtensor.calibration.surveys.changing import fit_changing
    from magtensor.calibration.surveys.dated import dated, offset_scatter, survey_covariance
    from magtensor.calibration.surveys.straight import in_words, straight
    from magtensor.dated import change_variables, date_of, span_facts, years_between
    from magtensor.offsets_apart import SCATTER, scatter_variable

    reference_noise, attitude_std_deg, robust, worst_error = how
    surveys = joint_surveys.named_surveys(survey)
    dates = [date_of(one) for _, one in surveys]
    names, uses, samples = joint_surveys.gathered(surveys, field)
    with naming(survey), joint_surveys.attitude_suspected(surveys, uses, field):
        fit = fit_changing(
            samples,
            np.array([years_between(min(dates), date) for date in dates]),
            matrices=matrices,
            offsets=offsets,
            reference_noise=reference_noise,
            attitude=None if attitude_std_deg is None else float(np.radians(attitude_std_deg)),
            robust=robust,
            worst_error=worst_error,
        )
        line = straight(fit)
        found = dated(fit, line, 0, mean)
    words = in_words(line, found.change.rate, found.change.offset_rate, survey.sensors)
    calibration = joint_surveys.with_declared_size(survey, field, found.calibration)
    calibration.diagnostics["change"] = words
    calibration.diagnostics["scatter_about_line"] = line.scatter
    extra: dict[str, Any] = change_variables(found.change, survey.sensors, dates[0], span_facts(dates, words))
    extra["calibration/survey"] = joint_surveys.survey_names(names)
    text = np.array([f"{date:%Y-%m-%dT%H:%M:%SZ}" for date in dates])
    extra["calibration/survey_date"] = (("survey",), text, {"long_name": "date of the first sample"})
    if offsets == "own":
        own = fit.parameters[-3 * len(names) * len(survey.sensors) :].reshape(len(names), -1, 3)
        extra |= joint_surveys.offset_variables(
            names, survey.sensors, own, survey_covariance(fit, line, 0), calibration
        )
        if not mean:
            extra[SCATTER] = scatter_variable(survey, offset_scatter(fit, line))
        extra["offset_of"] = joint_surveys.offset_words(names, own, mean)
    return calibration, extra, joint_surveys.doubted_in(survey, uses[0], fit.alike.keep)
