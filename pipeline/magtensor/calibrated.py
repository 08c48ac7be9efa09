"""Between the mathematics of a calibration and the survey's variables: one place that stores and applies it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import ArrayCalibration
from magtensor.errors import DataError
from magtensor.survey.model import AXES, Survey, Variable

MATRIX_ENTRIES = tuple(f"matrix_{i}{j}" for i in AXES for j in AXES)
OFFSET_ENTRIES = tuple(f"offset_{j}" for j in AXES)

SAME_PLACE_M = 1e-3  # positions nearer than this are the same place: a gradient changes by this share of its baseline

B = ("time", "sensor", "axis")
LEFT_FREE = "left free: "  # how the attribute `common_rotation` of a matrix begins where nothing fixed it


def stored(calibration: ArrayCalibration, sensors: list[str], **facts: Any) -> dict[str, Variable]:
    """A calibration as the variables of the group `calibration`.

    `matrix` (sensor, axis, raw_axis), `offset` (sensor, raw_axis) nT, `covariance` (parameter, parameter) with
    the parameters named `<sensor>:matrix_xx` ... `<sensor>:offset_z`; the frame and what is unobservable are
    attributes of `matrix`.
    """
    names = [f"{s}:{e}" for s in sensors for e in (*MATRIX_ENTRIES, *OFFSET_ENTRIES)]
    attributes = {
        "units": "1",
        "frame": calibration.frame,
        "unobservable": json.dumps(list(calibration.unobservable)),
        "diagnostics": json.dumps(calibration.diagnostics, default=float),
        "long_name": "correction matrix: b = matrix (raw - offset)",
    } | facts
    return {
        "calibration/raw_axis": (("raw_axis",), np.array(AXES), {"long_name": "axis of the raw output"}),
        "calibration/parameter": (("parameter",), np.array(names), {}),
        "calibration/matrix": (("sensor", "axis", "raw_axis"), calibration.matrix, attributes),
        "calibration/offset": (("sensor", "raw_axis"), calibration.offset, {"units": "nT"}),
        "calibration/covariance": (
            ("parameter", "parameter_"), calibration.covariance,
            {"units": "products of the parameters' units (1, nT)"},
        ),
    }  # fmt: skip


def left_open(survey: Survey) -> tuple[str, ...]:
    """What the calibration of a survey could not determine, in words."""
    if "calibration/matrix" not in survey:
        return ()
    attributes = survey["calibration/matrix"].attrs
    rotation = str(attributes.get("common_rotation", ""))
    reason = (f"the common rotation: {rotation.removeprefix(LEFT_FREE)}",) if rotation.startswith(LEFT_FREE) else ()
    return (*json.loads(str(attributes.get("unobservable", "[]"))), *reason)


def told_of_fit(survey: Survey) -> tuple[str, ...]:
    """What a fit says of its own doubts: surveys that disagree about one C, attitudes too poor for their number."""
    if "calibration/matrix" not in survey:
        return ()
    told = json.loads(str(survey["calibration/matrix"].attrs.get("diagnostics", "{}")))
    return tuple(str(told[name]) for name in ("disagreement", "caution") if told.get(name))


def restored(survey: Survey) -> ArrayCalibration:
    """The calibration that `stored` put into a survey.

    Raises:
        DataError: it is not complete, or its numbers cannot be a calibration.
    """
    matrix = survey["calibration/matrix"]
    values, offset = (np.asarray(survey.values(f"calibration/{n}"), dtype=float) for n in ("matrix", "offset"))
    if not (np.isfinite(values).all() and np.isfinite(offset).all() and (np.linalg.det(values) != 0).all()):
        raise DataError(
            "the stored calibration is damaged: its matrices and offsets are not all finite and regular",
            where=str(survey.attributes.get("source", "")),
        )
    return ArrayCalibration(
        values,
        offset,
        np.asarray(survey.values("calibration/covariance"), dtype=float),
        str(matrix.attrs["frame"]),
        tuple(json.loads(str(matrix.attrs.get("unobservable", "[]")))),
        json.loads(matrix.attrs["diagnostics"]),
    )


def corrected(calibration: ArrayCalibration, survey: Survey, **words: str) -> dict[str, Variable]:
    """`calibrated/b` of every sample and, where the total field is known, `residual/total_field`, after and before.

    `words` become attributes where they say something: `not_taken_off` names effects that are still in it,
    `extrapolated` those taken off beyond what the calibration has seen, `bridged` those that follow a channel which is
    missing for a while, `begins_anew` those of a time that goes on from the calibration's survey to another one as a
    rule, and with this one began again, `not_as_dated` those that had happened before it, or not yet, though the
    dates say otherwise, `held` those that stay as they were when what is known of them ended, `in_equilibrium`
    responses that lag and are taken to have begun so, `not_on_this_survey` those that the survey's own outputs refute,
    `total_field_as_read` those of the base station that were left in its total field, `contradicted` those without
    which |b| would be nearer to it.
    """
    raw = np.asarray(survey.values("b_raw"), dtype=float)
    b = calibration.apply(raw)
    attributes = {"units": "nT", "frame": calibration.frame, "long_name": "calibrated field"}
    given: dict[str, Variable] = {"calibrated/b": (B, b, attributes | {k: v for k, v in words.items() if v})}
    if "total_field" in survey:
        reference = survey.values("total_field")[:, None]
        for name, field in (("total_field", b), ("total_field_before", raw)):
            long_name = f"|{'b' if field is b else 'b_raw'}| - total field"
            residual = np.linalg.norm(field, axis=2) - reference
            given[f"residual/{name}"] = (("time", "sensor"), residual, {"units": "nT", "long_name": long_name})
    return given


def contrasts(b: np.ndarray) -> dict[str, Variable]:
    """`residual/contrast`: each sensor's field less the mean of all, nT; zero in a uniform field."""
    values = b - b.mean(axis=1, keepdims=True)
    return {"residual/contrast": (B, values, {"units": "nT", "long_name": "sensor less the mean of all sensors"})}


def require_sensors(survey: Survey, wanted: list[str], where: str) -> None:
    """A calibration fits only the sensors it was made from, in their order.

    Raises:
        DataError: the survey has other sensors.
    """
    if survey.sensors != wanted:
        another_order = sorted(survey.sensors) == sorted(wanted)
        raise DataError(
            f"the calibration is for the sensors {', '.join(wanted)}, the survey has {', '.join(survey.sensors)}",
            where=where,
            hint="put the survey's sensors, with all that it holds of each, in the calibration's order"
            if another_order
            else "name the calibration that was made with these sensors, or give the survey's sensors these names",
        )


def require_positions(survey: Survey, wanted: NDArray[np.float64], where: str) -> None:
    """A tensor is assembled with the places of the calibration's sensors; a survey that states others is refused.

    Args:
        survey: positions may be absent or NaN, then nothing is compared.
        wanted: (S, 3) m.

    Raises:
        DataError: a sensor stands elsewhere.
    """
    if "position" not in survey:
        return
    apart = np.nan_to_num(np.linalg.norm(survey.values("position") - wanted, axis=1))
    if apart.max() > SAME_PLACE_M:
        worst = int(apart.argmax())
        raise DataError(
            f"sensor {survey.sensors[worst]} is {apart[worst]:.4g} m away from where it was when calibrated",
            where=f"{where}: position",
            hint="its tensor would be wrong: calibrate this array, or correct the positions",
        )


def plain_attributes(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes that netCDF can hold: text, numbers and arrays of them; the rest as JSON text."""
    plain: dict[str, Any] = {}
    for key, value in attributes.items():
        if isinstance(value, (bool, np.bool_)):
            plain[key] = int(value)
        elif value is None:
            continue
        elif isinstance(value, (str, int, float, np.integer, np.floating, np.ndarray)):
            plain[key] = value
        else:
            plain[key] = json.dumps(value, default=str)
    return plain
