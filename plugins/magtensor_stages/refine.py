"""The stage that refines the tensor with its rotation invariants."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from magtensor import DataError, MethodChoice, NotEnoughData, stage
from magtensor.calibrated import restored

if TYPE_CHECKING:
    from magtensor.calibration.types import Array
    from magtensor.survey.model import Survey


@stage(
    needs=("calibrated/tensor",),
    uses=(
        "segment", "calibrated/b", "calibration/matrix", "calibration/offset", "calibration/covariance",
        "calibration/tensor_gain", "calibration/field_gain", "calibration/noise_std", "calibration/position",
    ),
    gives=(
        "calibrated/tensor", "calibrated/tensor_std", "calibrated/invariants", "calibrated/invariants_std",
        "calibration/tensor_matrix", "calibration/tensor_offset", "calibration/tensor_covariance",
    ),
    may_give=(
        "calibration/component", "calibration/coefficient", "calibrated/*", "residual/closure", "residual/identity",
    ),
)  # fmt: skip
def refine_invariants(
    survey: Survey,
    *,
    method: MethodChoice = "sui2017",
    invariant_1: Annotated[
        float | None,
        Field(lt=0, description="I1 = -1/2 sum G^2 at the place of rotation, (nT/m)^2; left out: constant, not known"),
    ] = None,
    invariant_2: Annotated[
        float | None,
        Field(description="I2 = det G at the place of rotation, (nT/m)^3; left out: constant, not known"),
    ] = None,
    segments: Annotated[
        list[int] | None,
        Field(description="numbers of the segments in which the array was rotated near the source; default: all"),
    ] = None,
) -> dict[str, Any]:
    """Refine the tensor so that its invariants stay what they are while the array rotates in one place near a source.

    The tensor is that of an array of sensors (`assemble_tensor`) or one measured as such (`load_tensor`). A method is
    ``f(tensor (N, 3, 3) nT/m, invariant_1, invariant_2, noise_covariance (5, 5) or None, *, options) ->
    TensorCalibration``. It leaves a common rotation of the tensor's frame open, which no invariant shows, and the scale
    where the invariants are not given.
    """
    from magtensor.tensor.elements import five
    from magtensor.tensors import assembled, noise_of_a_sample, refined, refinement_variables, stored_assembly

    tensor = survey.values("calibrated/tensor")
    use = survey.good & np.isfinite(tensor).all(axis=(1, 2))
    if segments is not None:
        if "segment" not in survey:
            raise DataError("refine_invariants: `segments` are named, but the survey has no segment")
        number = survey.values("segment")
        missing = [s for s in segments if s not in number]
        if missing:
            raise DataError(
                f"refine_invariants: the survey has no segment {missing[0]}",
                hint=f"its segments are {', '.join(str(s) for s in np.unique(number)[:20])}",
            )
        use &= np.isin(number, segments)
    if not use.any():
        raise NotEnoughData("refine_invariants: no sample is left in use")
    refinement = method(tensor[use], invariant_1, invariant_2, _noise_covariance(survey))
    facts = {
        "method": method.__name__,
        "rank": refinement.rank,
        "nullity": refinement.nullity,
        "triaxiality": refinement.triaxiality,
        "gauge_angle_rad": refinement.gauge_angle,
        "noise_std": refinement.noise_std,
        "verdict": json.dumps(list(refinement.verdict)),
        "diagnostics": json.dumps(dict(refinement.diagnostics), default=float),
    }
    stored = refinement_variables(refinement.matrix, refinement.offset, refinement.covariance, facts)
    coefficients = refinement.matrix, refinement.offset, refinement.covariance
    if "calibration/tensor_gain" not in survey:
        return stored | refined(five(tensor), refinement.noise_std, coefficients)
    b, noise = survey.values("calibrated/b"), noise_of_a_sample(survey, survey.values("calibration/noise_std"))
    position = survey.values("calibration/position")
    return stored | assembled(stored_assembly(survey), b, position, noise, restored(survey), coefficients)


def _noise_covariance(survey: Survey) -> Array | None:
    """(5, 5) (nT/m)^2 of the components from the noise of an array's sensors; None where it is not known."""
    from magtensor.tensor.uncertainty import noise_covariance_of_components
    from magtensor.tensors import stored_assembly

    if "calibration/tensor_gain" not in survey:
        return None
    noise = survey.values("calibration/noise_std")
    if not (np.isfinite(noise) & (noise > 0)).all():
        return None
    return noise_covariance_of_components(stored_assembly(survey).symmetrised(), np.diag(noise.ravel() ** 2))
