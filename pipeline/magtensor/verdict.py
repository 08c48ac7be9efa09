"""`verdict.json`: what a run or the loop has to say, as the contract wants it."""

from __future__ import annotations

import json
from typing import Any

from magtensor.accuracy import error_block
from magtensor.survey.model import Survey

SCHEMA = 1


def verdict(survey: Survey, verify: dict[str, Any] | None = None) -> dict[str, Any]:
    """The outcome of a run: of the loop where the recipe closes it, else of the declared model alone.

    Args:
        survey: after the last stage.
        verify: `{"before": block, "after": block}` of a verification survey.
    """
    found: dict[str, Any] = {
        "schema": SCHEMA,
        "declared": ["linear"] if {"calibration/matrix", "calibration/tensor_matrix"} & set(survey) else [],
        "noise_floor_nT": noise_floor(survey),
        "adopted": [],
        "rejected": [],
        "not_tested": [],
        "unexplained": {
            "present": None,
            "excess_rms_nT": None,
            "description": "not looked for: the recipe closes no loop",
            "findings": [],
            "notes": [],
            "looks_like": [],
        },
        "error": {"fit": survey_block(survey)},
    }
    if "calibration/effects" in survey:
        found["declared"] += [json.loads(str(text))["error_model"] for text in survey.values("calibration/effects")]
    if "loop/verdict" in survey:
        loop = json.loads(str(survey.values("loop/verdict")))
        found["error"]["held_out"] = loop.pop("held_out")
        found |= loop
    if verify is not None:
        found["error"]["verify"] = verify
    told = [
        str(survey[name].attrs[attribute])
        for name, attribute in (
            ("calibration/common_rotation", "attitude_delay"), ("calibration/matrix", "attitude_refuted")
        )
        if name in survey and survey[name].attrs.get(attribute)
    ]  # fmt: skip
    return found | ({"attitude": {"description": "; ".join(told)}} if told else {})


def survey_block(survey: Survey) -> dict[str, Any] | None:
    """The error block of a survey after calibration; None before."""
    if "calibrated/b" not in survey:
        return None
    return error_block(
        survey.values("calibrated/b"),
        survey.values("total_field") if "total_field" in survey else None,
        survey.values("calibrated/tensor") if "calibrated/tensor" in survey else None,
        survey.good_by_sensor,
        survey.sensors,
    )


def noise_floor(survey: Survey) -> float | None:
    """RMS over sensors and axes of the noise found in the data, nT; None where no stage estimated it."""
    import numpy as np

    if "calibration/noise_std" not in survey:
        return None
    values = survey.values("calibration/noise_std")
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else None
