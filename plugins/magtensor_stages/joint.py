"""The stage that calibrates all sensors and the reference in one fit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from magtensor import NotEnoughData, stage
from magtensor.calibration.coverage import WORST_ERROR
from magtensor.survey.flags import flag_ranges
from magtensor_methods.scalar_options import WorstError
from magtensor_stages.sensors import COMMON, common_frame, naming

if TYPE_CHECKING:
    from magtensor.calibration.recording import Recording
    from magtensor.survey.model import Survey

NoiseOfReference = Annotated[float, Field(ge=0, description="white noise of the total field, nT")]
Robust = Annotated[bool, Field(description="leave out samples that no noise explains")]


def calibrate_recording(
    survey: Survey,
    recording: Recording,
    *,
    reference_noise_nT: NoiseOfReference = 0.0,
    robust: Robust = True,
    worst_error: WorstError = WORST_ERROR,
) -> tuple[dict[str, Any], np.ndarray]:
    """The variables of a survey calibrated by a recording, and which samples (N,) of the recording no noise explains.

    The recording is the survey itself, or a longer one of which it is a selection.
    """
    from magtensor.calibration.joint import calibrated, fit_recording

    usable = np.ones(recording.count, dtype=bool) if recording.usable is None else recording.usable
    if not usable.any():
        raise NotEnoughData(
            "no sample has all sensors in use and a total field", where=str(survey.attributes.get("source", ""))
        )
    with naming(survey):
        fit = fit_recording(recording, reference_noise=reference_noise_nT, robust=robust, worst_error=worst_error)
        calibration = calibrated(fit)
    return common_frame(survey, calibration, "joint"), usable & ~fit.keep


@stage(
    needs=("b_raw", "total_field"),
    gives=COMMON,
    may_give=("residual/contrast", "good"),
    long=calibrate_recording,
)
def calibrate_joint(
    survey: Survey,
    *,
    reference_noise_nT: NoiseOfReference = 0.0,
    robust: Robust = True,
    worst_error: WorstError = WORST_ERROR,
) -> dict[str, Any]:
    """Calibrate all sensors and the reference in one fit: maximum likelihood over every C and o, the unknown field of
    each sample eliminated.

    One common frame, the nearest to the raw axes; the covariance of all parameters. Samples that no noise explains
    are flagged. A recording of any length is read once (`--memory`).
    """
    from magtensor.calibration.recording import InMemory

    raw, total_field = survey.values("b_raw"), survey.values("total_field")
    usable = survey.good & np.isfinite(total_field) & np.isfinite(raw).all(axis=(1, 2))
    given, doubted = calibrate_recording(
        survey,
        InMemory(raw, total_field, usable),
        reference_noise_nT=reference_noise_nT,
        robust=robust,
        worst_error=worst_error,
    )
    if doubted.any():
        given["good"] = (("time", "sensor"), survey.good_by_sensor & ~doubted[:, None], {"long_name": "may be used"})
        given["flags"] = flag_ranges(survey.time, doubted, by="calibrate_joint", reason=DOUBTED)
    return given


DOUBTED = "no calibration and no noise explain it"
