"""The joint estimator: all sensors and the reference in one fit."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from magtensor import method
from magtensor.calibration.coverage import WORST_ERROR
from magtensor.calibration.types import Array, ArrayCalibration
from magtensor_methods.scalar_options import WorstError


@method("calibrate_array", source="maximum likelihood with the unknown field eliminated")
def joint(
    raw: Array,
    total_field: Array,
    *,
    reference_noise_nT: Annotated[float, Field(ge=0, description="white noise of the total field, nT")] = 0.0,
    robust: Annotated[bool, Field(description="leave out samples that no noise explains")] = True,
    worst_error: WorstError = WORST_ERROR,
) -> ArrayCalibration:
    """Maximum likelihood over C and o of every sensor, the unknown field of each sample eliminated.

    Parameters
    ----------
    raw: (N, S, 3) nT; total_field: (N,) nT.

    Raises
    ------
    NotEnoughData: the attitudes do not determine the parameters; the message says which are missing.
    """
    from magtensor.calibration.joint import calibrated, fit_joint

    fit = fit_joint(raw, total_field, reference_noise=reference_noise_nT, robust=robust, worst_error=worst_error)
    return calibrated(fit)
