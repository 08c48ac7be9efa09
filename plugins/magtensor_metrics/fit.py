"""Metrics of a calibrated survey: its residuals held against the noise found in the data themselves."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field

from magtensor import metric
from magtensor.accuracy import COMPONENTS, error_block, figure, rms
from magtensor.calibrated import left_open
from magtensor.calibration.common_scale import COMMON_SCALE
from magtensor.calibration.noise import noise_std
from magtensor.qc import Verdict

if TYPE_CHECKING:
    from magtensor.survey.model import Survey

Ratio = Annotated[float, Field(gt=1, description="times the noise above which the figure is worth a look")]
Share = Annotated[float, Field(gt=0, lt=1, description="share of the samples")]


@metric(needs=("calibrated/b", "total_field"), uses=("calibration/matrix", "residual/total_field"))
def total_field(survey: Survey, *, warn_ratio: Ratio = 1.5, fail_ratio: Ratio = 30.0) -> list[Verdict]:
    """RMS of |b| - F of each sensor against its noise along the field.

    The noise is that of second differences of the residual: what the fit leaves above it is slower than noise. An error
    of the base station that was found is taken off F. Where the calibration says that its scale was not measured, |b|
    is compared after the one scale that fits F best.
    """
    b, reference = survey.values("calibrated/b"), survey.values("total_field")
    if "residual/total_field" in survey:
        seen = np.linalg.norm(b, axis=2) - survey.values("residual/total_field")
        count = np.isfinite(seen).sum(axis=1)
        reference = np.where(count > 0, np.nansum(seen, axis=1) / np.maximum(count, 1), np.nan)
    known = survey.readings_by_sensor & np.isfinite(reference)[:, None]
    free = any(words.startswith(COMMON_SCALE) for words in left_open(survey))
    if free and known.any():
        size, field = np.linalg.norm(b, axis=2)[known], np.broadcast_to(reference[:, None], known.shape)[known]
        b = b * float(np.dot(size, field) / np.dot(size, size))
    verdicts = []
    for i, sensor in enumerate(survey.sensors):
        good = known[:, i]
        residual = np.linalg.norm(b[good, i], axis=1) - reference[good]
        floor = float(noise_std(b[good, i : i + 1], reference[good])[0, 0])
        verdicts.append(_against_noise(f"total_field_rms {sensor}", rms(residual), floor, "nT", warn_ratio, fail_ratio))
    if free:
        verdicts = [replace(v, words=f"{v.words} (after the scale that was not measured)") for v in verdicts]
    return verdicts


@metric(needs=("residual/contrast",), uses=("total_field",))
def contrast(survey: Survey, *, warn_ratio: Ratio = 1.5, fail_ratio: Ratio = 30.0) -> list[Verdict]:
    """RMS of each sensor's field less the mean of all, against the noise; both are zero-mean in a uniform field."""
    values = survey.values("residual/contrast")[survey.readings]
    n = len(survey.sensors)
    if n < 2:
        return []
    noise = noise_std(values)
    # the contrast of white noise: (1 - 2/S) of the own variance and the mean variance of all over S
    expected = np.sqrt((1 - 2 / n) * noise**2 + (noise**2).sum(axis=0) / n**2)
    return [
        _against_noise(
            f"contrast_rms {sensor}",
            rms(values[:, i]),
            float(np.sqrt(np.mean(expected[i] ** 2))),
            "nT",
            warn_ratio,
            fail_ratio,
        )
        for i, sensor in enumerate(survey.sensors)
    ]


@metric(needs=("calibrated/tensor", "calibration/tensor_gain", "calibration/noise_std"))
def closure(survey: Survey, *, warn_ratio: Ratio = 1.5, fail_ratio: Ratio = 30.0) -> list[Verdict]:
    """Tensor rms of each component against what the sensors' noise makes of it; zero in a uniform field."""
    gain = survey.values("calibration/tensor_gain")
    noise = survey.values("calibration/noise_std")
    if not np.isfinite(noise).all():
        return []
    expected = np.sqrt(np.einsum("rcsa,sa->rc", gain**2, noise**2))
    b, tensor = survey.values("calibrated/b"), survey.values("calibrated/tensor")
    block = error_block(b, None, tensor, survey.readings_by_sensor, survey.sensors)["tensor_rms_nT_per_m"]
    index = {"x": 0, "y": 1, "z": 2}
    return [
        _against_noise(
            f"tensor_rms {c}", block[c], float(expected[index[c[0]], index[c[1]]]), "nT/m", warn_ratio, fail_ratio
        )
        for c in COMPONENTS
    ]


@metric(needs=("b_raw",))
def flagged(survey: Survey, *, warn_share: Share = 0.01, fail_share: Share = 0.3) -> list[Verdict]:
    """The share of each sensor's samples that stages took out of use."""
    verdicts = []
    for i, sensor in enumerate(survey.sensors):
        share = 1.0 - float(survey.good_by_sensor[:, i].mean())
        state = "pass" if share <= warn_share else "warn" if share <= fail_share else "fail"
        words = f"{share:.2%} of the samples are flagged" + (
            "" if state == "pass" else "; the flag record says by whom and why"
        )
        verdicts.append(Verdict(f"flagged {sensor}", share, "1", state, words, warn_share))  # type: ignore[arg-type]
    return verdicts


@metric(needs=("calibration/matrix",))
def determined(survey: Survey) -> list[Verdict]:
    """Fails a calibration that its attitudes did not determine.

    Its value is what |b| is known to in the worst direction.
    """
    facts = json.loads(str(survey["calibration/matrix"].attrs.get("diagnostics", "{}")))
    if "undetermined" not in facts:
        return []
    further = [w for w in left_open(survey) if w.startswith("what would help most")]
    words = "; ".join([str(facts["undetermined"]), *further])
    return [Verdict("calibration determined", float(facts["worst_error_nT"]), "nT", "fail", words)]


def _against_noise(
    name: str, value: float | None, noise: float, units: str, warn_ratio: float, fail_ratio: float
) -> Verdict:
    if value is None or not np.isfinite(noise):
        return Verdict(name, float("nan"), units, "warn", "no samples, or too few to find their noise")
    ratio = value / noise if noise > 0 else np.inf
    shown = f"{figure(value)} {units} rms, {figure(ratio)} times what noise alone gives ({figure(noise)})"
    if ratio <= warn_ratio:
        return Verdict(name, value, units, "pass", shown, warn_ratio * noise)
    advice = "an effect that the model lacks, or a field that is not uniform"
    state = "warn" if ratio <= fail_ratio else "fail"
    return Verdict(name, value, units, state, f"{shown}: {advice}", warn_ratio * noise)  # type: ignore[arg-type]
