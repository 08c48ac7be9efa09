"""Metrics of the calibrated field's frame."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field

from magtensor import metric
from magtensor.accuracy import figure
from magtensor.qc import Verdict

if TYPE_CHECKING:
    from magtensor.survey.model import Survey


@metric(needs=("calibration/common_rotation",))
def common_rotation(
    survey: Survey,
    *,
    warn_deg: Annotated[float, Field(gt=0, description="standard deviation of the frame worth a look, deg")] = 1.0,
) -> list[Verdict]:
    """How well the array's common frame is tied to the platform, where a stage fixed it.

    A tensor in a gradient errs by 2.5 % for each degree. Worth a look also where the tensors whose symmetry was used
    are less alike to gradients than their noise allows.
    """
    known = survey["calibration/common_rotation"].attrs
    value = float(np.sqrt(np.sum(np.square(known["std_deg"]))))
    words, state = str(known["words"]), "pass" if value <= warn_deg else "warn"
    by_source = dict(zip(json.loads(known["sources"]), np.atleast_1d(known["noise_over_nominal"]), strict=True))
    excess = float(np.sqrt(by_source.get("symmetry", 1.0)))
    if excess > 1.0:
        words += (
            f"; what is left of the tensors' asymmetry is {figure(excess)} times what noise makes of it, so that a "
            "source was too near or the sensors err in another way"
        )
        state = "warn"
    return [Verdict("common_rotation std", value, "deg", state, words, warn_deg)]  # type: ignore[arg-type]
