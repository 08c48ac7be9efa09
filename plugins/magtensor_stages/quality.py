"""The stage that lets metrics judge the survey."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor import MetricsChoice, stage
from magtensor.qc import Verdict, worst

if TYPE_CHECKING:
    from magtensor.survey.model import Survey


@stage(
    uses=("*", "reference/*", "calibrated/*", "calibration/*", "residual/*"),
    gives=("qc/metric", "qc/value", "qc/limit", "qc/state", "qc/words", "qc/units"),
)
def qc(survey: Survey, *, metrics: MetricsChoice = None) -> dict[str, Any]:
    """Judge the survey with QC metrics; all that are installed, or those named.

    A metric is ``f(survey, *, options) -> list[Verdict]``; one whose variables the survey lacks is left out.
    """
    from magtensor.components import component_of

    verdicts: list[Verdict] = []
    for metric in (metrics or {}).values():
        component = component_of(metric.func)
        assert component is not None
        needs = component.declared({}).needs
        if all(survey.matching(need) for need in needs):
            verdicts += metric(survey)
    names = np.array([v.name for v in verdicts], dtype=np.str_)
    columns = {
        "value": np.array([v.value for v in verdicts], dtype=float),
        "limit": np.array([v.limit for v in verdicts], dtype=float),
        "state": np.array([v.state for v in verdicts], dtype=np.str_),
        "words": np.array([v.words for v in verdicts], dtype=np.str_),
        "units": np.array([v.units for v in verdicts], dtype=np.str_),
    }
    given: dict[str, Any] = {f"qc/{k}": (("metric",), v, {}) for k, v in columns.items()}
    given["qc/metric"] = (("metric",), names, {"worst": worst(verdicts)})
    return given
