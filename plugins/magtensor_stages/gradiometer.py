"""The stage for instruments that measure the gradients themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from magtensor import DataError, stage
from magtensor.survey.flags import flag_ranges

if TYPE_CHECKING:
    from magtensor.survey.model import Survey

BY = "load_tensor"


class Components(BaseModel):
    """The channel of each independent component."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    xx: str = "gradient_xx"
    xy: str = "gradient_xy"
    xz: str = "gradient_xz"
    yy: str = "gradient_yy"
    yz: str = "gradient_yz"


@stage(
    uses=("*",),
    gives=("calibrated/tensor", "calibrated/invariants"),
    may_give=("calibrated/row", "calibrated/column", "calibrated/invariant", "good"),
)
def load_tensor(
    survey: Survey,
    *,
    channels: Annotated[
        Components, Field(description="name of the channel of each component; gradient_xx, ... if left out")
    ] = Components(),  # noqa: B008  frozen
) -> dict[str, Any]:
    """The tensor of an instrument with elemental gradiometers, from five channels of the survey.

    Nothing is corrected; `refine_invariants` does that. Samples in which a channel is missing are flagged.
    """
    from magtensor.tensor.elements import full
    from magtensor.tensor.invariants import invariants
    from magtensor.tensors import invariant_variables, tensor_variables
    from magtensor.units import UnitError, convert

    measured = np.empty((len(survey.time), 5))
    for i, (component, name) in enumerate(channels.model_dump().items()):
        where = f"{survey.attributes.get('source', '')}: {name}"
        channel = survey[name]
        if channel.dims != ("time",):
            raise DataError(f"{name} is ({', '.join(map(str, channel.dims))}), not (time)", where=where)
        units = str(channel.attrs.get("units", ""))
        try:
            measured[:, i] = convert(np.asarray(channel.values, dtype=float), units, "nT/m")
        except UnitError as error:
            raise DataError(f"component {component}: {error}", where=where, hint="nT/m is right") from error
    known = np.asarray(np.isfinite(measured).all(axis=1))
    if not known.any():
        raise DataError("no sample has all five components", where=str(survey.attributes.get("source", "")))
    tensor = full(measured)
    given: dict[str, Any] = tensor_variables(tensor) | invariant_variables(np.stack(invariants(tensor), axis=1))
    if not known.all():
        given["good"] = (("time", "sensor"), survey.good_by_sensor & known[:, None], {"long_name": "may be used"})
        given["flags"] = flag_ranges(survey.time, ~known, by=BY, reason="a gradient is missing", sensor="gradiometers")
    return given
