"""Offsets that scatter between the surveys of a fit, where a stored calibration holds those of one of them."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from magtensor.calibration.surveys.corrections import with_scatter
from magtensor.calibration.types import ArrayCalibration
from magtensor.survey.model import Survey, Variable

SCATTER = "calibration/offset_scatter"
NOT_HELD = "which their standard deviations do not hold"
HELD = "which their standard deviations hold"
_FOR_ANOTHER = f"{HELD} with twice the variance in this survey, whose offsets are others (`offset_of: mean` is nearer)"
_BEGINNING = 16  # samples that tell a survey from others


def scatter_variable(survey: Survey, scatter: float) -> Variable:
    """The scatter, nT, of offsets about those of all surveys, and the survey whose offsets the calibration holds."""
    return (), np.array(scatter), {"units": "nT", "long_name": "scatter of offsets between surveys", **_named(survey)}


def scatter_for(survey: Survey, calibration: Survey) -> float:
    """nT: by how much the offsets of a survey, as it was loaded, scatter about those that a stored calibration holds;
    0 in the survey that they are of, and where the calibration tells no scatter.

    The offsets of two surveys differ by twice the variance of either.
    """
    if SCATTER not in calibration:
        return 0.0
    if calibration[SCATTER].attrs["survey_begins"] == _named(survey)["survey_begins"]:
        return 0.0
    return float(np.sqrt(2.0) * calibration.values(SCATTER))


def without_scatter(calibration: ArrayCalibration, scatter: float) -> ArrayCalibration:
    """The inverse of `with_scatter`."""
    added = with_scatter(calibration, scatter).covariance - calibration.covariance
    return replace(calibration, covariance=calibration.covariance - added)


def for_another(words: str, scatter: float) -> str:
    """Whose offsets were taken off, said of a survey whose covariance holds so large a scatter."""
    return words.replace(NOT_HELD, _FOR_ANOTHER) if scatter else words


def _named(survey: Survey) -> dict[str, str]:
    raw = np.ascontiguousarray(survey.values("b_raw")[:_BEGINNING], dtype="<f8")
    return {"survey_begins": hashlib.sha256(raw.tobytes()).hexdigest()}
