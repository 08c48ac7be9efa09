"""The stages that work on calibrated sensors: alignment to one frame, and the tensor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from magtensor import DataError, MethodChoice, NotEnoughData, stage
from magtensor.calibrated import restored
from magtensor.calibration.types import PARAMETERS_PER_SENSOR, SensorCalibration
from magtensor.components import Declares
from magtensor.errors import did_you_mean
from magtensor_stages.sensors import common_frame, naming

if TYPE_CHECKING:
    from magtensor.survey.model import Survey


@stage(
    needs=("b_raw", "calibrated/b", "calibration/matrix", "calibration/offset", "calibration/covariance"),
    uses=("total_field", "calibration/fit_rms"),
    gives=("calibration/*", "calibration/rotation", "calibrated/b"),
    may_give=("residual/contrast", "residual/total_field", "residual/total_field_before"),
)
def align(
    survey: Survey,
    *,
    method: MethodChoice = "procrustes",
    to: Annotated[
        str | None, Field(description="the sensor whose frame becomes the common one; the first if left out")
    ] = None,
) -> dict[str, Any]:
    """Rotate the calibrated sensors into the frame of one of them.

    A method is ``f(b (N, S, 3) nT, calibrations, reference, *, options) -> ArrayCalibration``; the rotation of the
    whole array stays free.
    """
    sensors = survey.sensors
    if to is not None and to not in sensors:
        raise DataError(
            f"align: no sensor is called {to}{did_you_mean(to, sensors)}", hint=f"the survey has {', '.join(sensors)}"
        )
    single = restored(survey)
    size = PARAMETERS_PER_SENSOR
    fit_rms = survey.values("calibration/fit_rms") if "calibration/fit_rms" in survey else np.full(len(sensors), np.nan)
    calibrations = [
        SensorCalibration(
            single.matrix[i],
            single.offset[i],
            single.covariance[i * size : (i + 1) * size, i * size : (i + 1) * size],
            single.frame,
            float(fit_rms[i]),
        )
        for i in range(len(sensors))
    ]
    b = survey.values("calibrated/b")
    good = survey.good & np.isfinite(b).all(axis=(1, 2))
    if "total_field" in survey:
        good &= np.isfinite(survey.values("total_field"))
    reference = sensors.index(to) if to is not None else 0
    with naming(survey):
        aligned = method(b[good], calibrations, reference)
    return common_frame(survey, aligned, method.__name__)


CALIBRATED = (
    "calibrated/b", "calibration/rotation", "calibration/matrix", "calibration/offset", "calibration/covariance",
)  # fmt: skip
TENSOR = (
    "calibrated/tensor", "calibrated/tensor_std", "calibrated/mean_field", "calibrated/mean_field_std",
    "calibrated/invariants", "calibrated/invariants_std", "calibration/tensor_gain", "calibration/field_gain",
    "calibration/position",
)  # fmt: skip
BESIDE_TENSOR = (
    "residual/closure", "residual/identity", "calibrated/row", "calibrated/column", "calibrated/invariant",
    "calibration/row", "calibration/column",
)  # fmt: skip


USED = ("total_field", "calibration/slow_noise_std")


def touched_by_assembly(options: Mapping[str, Any]) -> Declares:
    """A tensor that is required needs positions; one that is not may stay away."""
    if options.get("required", True):
        return Declares((*CALIBRATED, "position"), USED, (*TENSOR, "calibration/noise_std"), BESIDE_TENSOR)
    return Declares(CALIBRATED, (*USED, "position"), ("calibration/noise_std",), (*TENSOR, *BESIDE_TENSOR))


@stage(declares=touched_by_assembly)
def assemble_tensor(
    survey: Survey,
    *,
    method: MethodChoice = "least_squares",
    required: Annotated[
        bool, Field(description="refuse an array that cannot measure a tensor; false goes on without one")
    ] = True,
) -> dict[str, Any]:
    """Assemble the gradient tensor, its standard deviation and its invariants from the calibrated sensors.

    A method is ``f(position (S, 3) m, noise_covariance (3 S, 3 S) nT^2 or None, *, options) -> Assembly``. The
    standard deviation holds the sensors' noise, slow noise too where `close_loop` has measured it, and the uncertainty
    of the calibration.
    """
    from magtensor.calibration.noise import noise_std
    from magtensor.tensors import assembled, assembly_variables, noise_of_a_sample, noise_variables

    b = survey.values("calibrated/b")
    good = survey.good & np.isfinite(b).all(axis=(1, 2))
    total_field = survey.values("total_field") if "total_field" in survey else None
    noise = noise_std(b[good], None if total_field is None else total_field[good])
    known = bool(np.isfinite(noise).all() and (noise > 0).all())
    if not required and "position" not in survey:
        return noise_variables(noise)
    position = np.asarray(survey.values("position"), dtype=float)
    try:
        with naming(survey):
            assembly = method(position, np.diag(noise.ravel() ** 2) if known else None)
    except NotEnoughData as error:
        if required:
            leave_out = "`assemble_tensor: {required: false}` goes on without a tensor"
            raise NotEnoughData(error.what, where=error.where, hint=f"{error.hint}; {leave_out}") from error
        return noise_variables(noise)
    each = noise_of_a_sample(survey, noise)
    return assembly_variables(assembly, position, noise) | assembled(assembly, b, position, each, restored(survey))
