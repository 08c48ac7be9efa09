"""Metrics of what disturbs single samples: noise too large for a survey, and samples that no noise explains."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field

from magtensor import metric
from magtensor.accuracy import figure
from magtensor.calibration.noise import MAD_TO_SIGMA, noise_std
from magtensor.qc import Verdict

if TYPE_CHECKING:
    from magtensor.survey.model import Survey

Share = Annotated[float, Field(gt=0, lt=1, description="share of the samples")]
FieldShare = Annotated[float, Field(gt=0, lt=1, description="fraction of the total field")]


@metric(needs=("calibrated/b", "total_field"))
def noise_level(survey: Survey, *, warn_share: FieldShare = 1e-3, fail_share: FieldShare = 1e-2) -> list[Verdict]:
    """Noise of |b| - F of each sensor, from second differences, as a fraction of the field.

    Residuals are judged against the noise; where most samples are disturbed, the disturbance passes for noise, and
    only its size tells.
    """
    reference = survey.values("total_field")
    verdicts = []
    for i, sensor in enumerate(survey.sensors):
        good = _residual(survey, i)[0]
        if good.sum() < 4:
            continue
        found = float(noise_std(survey.values("calibrated/b")[good, i : i + 1], reference[good])[0, 0])
        share = found / float(np.mean(reference[good]))
        state = "pass" if share <= warn_share else "warn" if share <= fail_share else "fail"
        of_field = f"{1e6 * share:.2g} ppm" if share < 1e-4 else f"{share:.2%}"
        words = f"{figure(found)} nT, {of_field} of the field" + (
            "" if state == "pass" else ": a coarse or disturbed sensor; its calibration is no better"
        )
        limit = warn_share * float(np.mean(reference[good]))
        verdicts.append(Verdict(f"noise {sensor}", found, "nT", state, words, limit))  # type: ignore[arg-type]
    return verdicts


@metric(needs=("calibrated/b", "total_field"))
def outliers(
    survey: Survey,
    *,
    deviations: Annotated[float, Field(gt=3, description="robust standard deviations that noise does not reach")] = 7.0,
    warn_share: Share = 1e-3,
    fail_share: Share = 0.05,
) -> list[Verdict]:
    """The share of samples in use whose |b| - F no noise explains: spikes that bent a fit which is not robust."""
    verdicts = []
    for i, sensor in enumerate(survey.sensors):
        residual = _residual(survey, i)[1]
        if len(residual) < 20:
            continue
        away = np.abs(residual - np.median(residual))
        scale = MAD_TO_SIGMA * float(np.median(away))
        count = int((away > deviations * scale).sum()) if scale > 0 else 0
        share = count / len(away)
        state = "pass" if share <= warn_share else "warn" if share <= fail_share else "fail"
        words = f"{count} of {len(away)} samples lie beyond {deviations:g} standard deviations" + (
            "" if state == "pass" else ": spikes; leave them out, or calibrate with a robust method (joint)"
        )
        verdicts.append(Verdict(f"outliers {sensor}", share, "1", state, words, warn_share))  # type: ignore[arg-type]
    return verdicts


def _residual(survey: Survey, sensor: int) -> tuple[np.ndarray, np.ndarray]:
    """(N,) samples in use, and |b| - F of those."""
    b, reference = survey.values("calibrated/b")[:, sensor], survey.values("total_field")
    good = survey.readings_by_sensor[:, sensor] & np.isfinite(reference) & np.isfinite(b).all(axis=1)
    return good, np.linalg.norm(b[good], axis=1) - reference[good]
