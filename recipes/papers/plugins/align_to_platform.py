"""A stage of one file: sensors turned into the platform's frame by a known field vector, as Li's comparison does it."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import block_diag

from magtensor import stage
from magtensor.attitude import into_platform
from magtensor.calibrated import contrasts, corrected, restored, stored
from magtensor.calibration.alignment import linear_elements
from magtensor.calibration.types import ArrayCalibration
from magtensor.survey.model import Survey


@stage(
    needs=("b_raw", "attitude", "reference/world_field", "calibrated/b", "calibration/matrix", "calibration/offset",
           "calibration/covariance"),
    uses=("total_field",),
    gives=("calibration/*", "calibration/rotation", "calibrated/b", "residual/contrast"),
    may_give=("residual/total_field", "residual/total_field_before"),
)  # fmt: skip
def align_to_platform(survey: Survey) -> dict[str, Any]:
    """Turn each calibrated sensor into the platform's frame by angles read from a linear matrix (Yin 2014).

    The noise of the alignment itself is left out of the covariance: the reference vector has none.
    """
    single = restored(survey)
    field = into_platform(survey.values("attitude"), survey.values("reference/world_field"))
    b, use = survey.values("calibrated/b"), survey.good
    rotation = np.stack([linear_elements(field[use], b[use, s]).rotation for s in range(b.shape[1])])
    carried = block_diag(*[block_diag(np.kron(r, np.eye(3)), np.eye(3)) for r in rotation])
    aligned = ArrayCalibration(
        rotation @ single.matrix, single.offset, carried @ single.covariance @ carried.T, "platform"
    )
    given = stored(aligned, survey.sensors, method="align_to_platform") | corrected(aligned, survey)
    given["calibration/rotation"] = (("sensor", "axis", "sensor_axis"), rotation, {"units": "1", "frame": "platform"})
    return given | contrasts(aligned.apply(np.asarray(survey.values("b_raw"), dtype=float)))
