"""`verdict.json` and its one sentence."""

from __future__ import annotations

from typing import Any

from magtensor.accuracy import error_block
from magtensor.survey.model import Survey

SCHEMA = 1


def verdict(survey: Survey, verify: dict[str, Any] | None = None) -> dict[str, Any]:
    """The outcome of a run without the loop: the declared model and its errors, nothing searched for.

    Args:
        survey: after the last stage.
        verify: the error block of a verification survey.
    """
    block = survey_block(survey)
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
            "looks_like": [],
        },
        "error": {"fit": block},
    }
    if verify is not None:
        found["error"]["verify"] = {"before": verify, "after": verify}
    return found


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


def sentence(outcome: dict[str, Any]) -> str:
    """The verdict in one sentence."""
    parts = []
    block = outcome["error"].get("verify", {}).get("after") or outcome["error"].get("fit")
    if not block and not outcome["declared"]:
        return "Nothing was calibrated."
    if not block:
        return "The tensor was refined; its error cannot be told without a tensor that is known."
    where = "on the verification survey" if "verify" in outcome["error"] else "on the survey it was fitted to"
    if block["total_field_rms_nT"]:
        parts.append(f"total field {_figure(block['total_field_rms_nT']['all'])} nT rms")
    if block["tensor_rms_nT_per_m"]:
        parts.append(f"tensor {_figure(block['tensor_rms_nT_per_m']['all'])} nT/m rms")
    floor = outcome["noise_floor_nT"]
    noise = f"; sensor noise {_figure(floor)} nT" if floor is not None else ""
    if not parts:
        return f"Calibrated; no error figure can be given without a total field or three sensors{noise}."
    return f"Calibrated with {' and '.join(outcome['declared'])}: {', '.join(parts)} {where}{noise}."


def _figure(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"
