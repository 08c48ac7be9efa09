"""The stage that fixes the rotation which scalar calibration leaves free."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from magtensor import DataError, UsageError, stage
from magtensor.calibrated import LEFT_FREE, restored
from magtensor.errors import NotEnoughData, did_you_mean
from magtensor_stages.sensors import COMMON, naming, published_parameters

if TYPE_CHECKING:
    from magtensor.survey.model import Survey

SourceName = Literal["attitude", "sensor", "axis", "symmetry"]
Axis = Literal["x", "y", "z"]


@stage(
    needs=(
        "calibrated/b", "calibration/matrix", "calibration/offset", "calibration/covariance", "calibration/rotation",
    ),
    uses=(
        "attitude", "reference/world_field", "position", "segment", "calibration/noise_std", "declared/matrix",
        "calibration/common_rotation", "calibrated/tensor",
    ),
    gives=("calibration/matrix",),
    may_give=(*COMMON, "calibration/*", "calibration/common_rotation", "residual/contrast", "declared/matrix"),
)  # fmt: skip
def fix_rotation(
    survey: Survey,
    *,
    source: Annotated[
        Literal["auto"] | SourceName | list[SourceName],
        Field(
            description="what tells the rotation: attitude, sensor (declared below), axis (turns declared below), "
            "symmetry of the tensor, or a list of these, weighed by their noise; auto takes what is declared and the "
            "attitude where the survey has one, else the symmetry"
        ),
    ] = "auto",
    sensor: Annotated[str | None, Field(description="a sensor whose axes are the platform's by construction")] = None,
    sensor_axis: Annotated[
        Axis | None, Field(description="only this axis of that sensor is; the rotation about it stays open")
    ] = None,
    mounted_to_deg: Annotated[
        float, Field(gt=0, description="how well that sensor is mounted, one standard deviation, deg")
    ] = 0.5,
    turns: Annotated[
        dict[Axis, list[int]] | None,
        Field(description="platform axis -> segments in which the platform turned about it; [] for the whole survey"),
    ] = None,
    segments: Annotated[
        list[int] | None, Field(description="segments whose gradients the symmetry is sought in; default: all")
    ] = None,
    worst_deg: Annotated[
        float, Field(gt=0, le=10, description="refuse a rotation whose standard deviation about an axis reaches this")
    ] = 2.0,
    required: Annotated[
        bool, Field(description="refuse a survey that does not determine the rotation; false leaves it free")
    ] = True,
) -> dict[str, Any]:
    """Turn the common frame of the calibrated sensors into the platform's, where their positions are known.

    Scalar calibration leaves this rotation free: a uniform field does not show it, in a gradient the tensor errs by
    1.4 times its angle. Comes before `assemble_tensor`.
    """
    from magtensor.platform_frame import Declared, as_platform, tie, tied

    if "calibrated/tensor" in survey:
        raise UsageError("fix_rotation turns the field that the tensor is made of: put it before assemble_tensor")
    if sensor is not None and sensor not in survey.sensors:
        raise DataError(
            f"fix_rotation: no sensor is called {sensor}{did_you_mean(sensor, survey.sensors)}",
            hint=f"the survey has {', '.join(survey.sensors)}",
        )
    about: dict[str, list[int]] = {str(axis): parts for axis, parts in (turns or {}).items()}
    declared = Declared(sensor, sensor_axis, float(np.radians(mounted_to_deg)), about, segments)
    calibration = restored(survey)
    sources: list[str] = list(source) if isinstance(source, list) else [source]
    if source == "auto":
        by_attitude = "attitude" in survey and not tied(calibration)  # or else it has been used already
        there = {"attitude": by_attitude, "sensor": sensor is not None, "axis": bool(turns)}
        sources = [name for name, known in there.items() if known] or ["symmetry"]
    for option, given, name in (("sensor", sensor is not None, "sensor"), ("turns", bool(turns), "axis")):
        if given and name not in sources:
            raise UsageError(
                f"fix_rotation: {option} is declared, but source {', '.join(sources)} leaves it out; name {name} in "
                f"`source` too (a list), or leave {option} away"
            )
    if segments is not None and "symmetry" not in sources:
        raise UsageError(
            f"fix_rotation: segments are for the symmetry of the tensor, and source {', '.join(sources)} leaves it "
            "out; name symmetry in `source` too (a list), or leave segments away"
        )
    try:
        with naming(survey):
            done = tie(survey, calibration, sources, declared, float(np.radians(worst_deg)))
    except DataError as error:
        if required:
            hint = "; ".join(p for p in (error.hint, "`fix_rotation: {required: false}` leaves it free") if p)
            raise type(error)(error.what, where=error.where, hint=hint) from error
        matrix = survey["calibration/matrix"]
        attributes = dict(matrix.attrs) | {"common_rotation": f"{LEFT_FREE}{error.what}"}
        if "attitude" in (error.where or "") and not isinstance(error, NotEnoughData):
            attributes["attitude_refuted"] = "; ".join(p for p in (error.what, error.hint) if p)
        return {"calibration/matrix": (matrix.dims, matrix.values, attributes)}
    return as_platform(survey, done) | published_parameters(done.calibration, survey.sensors)
