"""The stages that calibrate sensors: each alone against a total field, or all at once, or against a known vector."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor import DataError, MethodChoice, NotEnoughData, stage
from magtensor.calibrated import contrasts, corrected, stored
from magtensor.calibration.types import PARAMETERS_PER_SENSOR, ArrayCalibration, SensorCalibration

if TYPE_CHECKING:
    from magtensor.survey.model import Survey

FITTED = ("calibration/*", "calibrated/b", "residual/total_field", "residual/total_field_before")


def usable(survey: Survey, sensor: int) -> np.ndarray:
    """(N,) samples of one sensor that may enter a fit: not flagged, finite, with a total field where one is used."""
    good = survey.readings_by_sensor[:, sensor] & np.isfinite(survey.values("b_raw")[:, sensor]).all(axis=1)
    if "total_field" in survey:
        good = good & np.isfinite(survey.values("total_field"))
    return good


def each_sensor(survey: Survey, fit: Callable[[int, np.ndarray], SensorCalibration]) -> list[SensorCalibration]:
    """Fit sensor after sensor; a refusal names the sensor."""
    calibrations = []
    for i, name in enumerate(survey.sensors):
        good = usable(survey, i)
        source = str(survey.attributes.get("source", ""))
        if not good.any():
            raise NotEnoughData("no sample is left in use", where=": ".join(p for p in (source, f"sensor {name}") if p))
        try:
            calibrations.append(fit(i, good))
        except DataError as error:
            place = ": ".join(p for p in (source, f"sensor {name}", error.where) if p)
            raise type(error)(error.what, where=place, hint=error.hint) from error
    return calibrations


def by_name(text: str, sensors: list[str]) -> str:
    """A method's words with the sensors' names for its numbers: `sensors 2, 3` to `sensors S2, S3`."""
    import re

    def named(found: re.Match[str]) -> str:
        return re.sub(r"\d+", lambda n: sensors[int(n[0]) - 1] if 0 < int(n[0]) <= len(sensors) else n[0], found[0])

    # "sensors 1 to 4" speaks of a layout, not of these sensors; "contrast_rms_3_nT" is a diagnostic's key
    return re.sub(r"\bsensors? \d+\b(?! to )((, | and )\d+\b)*|(?<=_)\d+(?=_nT$)", named, text)


@contextmanager
def naming(survey: Survey) -> Iterator[None]:
    """Methods know no file and count the sensors from 1; what they refuse, the user reads with the names of both."""
    try:
        yield
    except DataError as error:
        what, where, hint = (by_name(text, survey.sensors) for text in (error.what, error.where, error.hint))
        source = str(survey.attributes.get("source", ""))
        raise type(error)(what, where=": ".join(p for p in (source, where) if p), hint=hint) from error


def side_by_side(calibrations: list[SensorCalibration]) -> ArrayCalibration:
    """Sensors calibrated each alone, each still in a frame of its own."""
    from scipy.linalg import block_diag

    own = (f"sensor {i}: {words}" for i, c in enumerate(calibrations, 1) for words in c.unobservable)
    return ArrayCalibration(
        np.stack([c.matrix for c in calibrations]),
        np.stack([c.offset for c in calibrations]),
        block_diag(*[c.covariance for c in calibrations]),
        f"each sensor's own ({calibrations[0].frame})",
        ("a rotation of each sensor", *own),
    )


def per_sensor(calibrations: list[SensorCalibration]) -> dict[str, Any]:
    """What the fits say of themselves."""
    rms = np.array([c.residual_rms for c in calibrations])
    figures: dict[str, Any] = {
        "calibration/fit_rms": (
            ("sensor",),
            rms,
            {"units": "nT", "long_name": "rms of |b| - F over the samples fitted"},
        )
    }
    for key in sorted({k for c in calibrations for k, v in c.diagnostics.items() if isinstance(v, (int, float))}):
        values = np.array([float(c.diagnostics.get(key, np.nan)) for c in calibrations])
        figures[f"calibration/{key}"] = (("sensor",), values, {"long_name": key.replace("_", " ")})
    return figures


@stage(needs=("b_raw", "total_field"), gives=FITTED)
def calibrate_scalar(survey: Survey, *, method: MethodChoice = "chi2017") -> dict[str, Any]:
    """Calibrate each sensor alone against the total field: nine parameters, its frame free up to a rotation.

    A method is ``f(raw (N, 3) nT, total_field (N,) nT, *, options) -> SensorCalibration``.
    """
    raw, total_field = survey.values("b_raw"), survey.values("total_field")
    fits = each_sensor(survey, lambda i, good: method(raw[good, i], total_field[good]))
    together = side_by_side(fits)
    together = replace(together, unobservable=tuple(by_name(w, survey.sensors) for w in together.unobservable))
    return stored(together, survey.sensors, method=method.__name__) | per_sensor(fits) | corrected(together, survey)


COMMON = (*FITTED, "calibration/rotation")


@stage(needs=("b_raw", "total_field"), gives=COMMON, may_give=("residual/contrast",))
def calibrate_array(survey: Survey, *, method: MethodChoice) -> dict[str, Any]:
    """Calibrate all sensors at once into one common frame, as a published method does; ours is `calibrate_joint`.

    A method is ``f(raw (N, S, 3) nT, total_field (N,) nT, *, options) -> ArrayCalibration``.
    """
    raw, total_field = survey.values("b_raw"), survey.values("total_field")
    good = survey.readings & np.isfinite(total_field) & np.isfinite(raw).all(axis=(1, 2))
    if not good.any():
        raise NotEnoughData(
            "no sample has all sensors in use and a total field", where=str(survey.attributes.get("source", ""))
        )
    with naming(survey):
        calibration = method(raw[good], total_field[good])
    return common_frame(survey, calibration, method.__name__)


@stage(
    needs=("b_raw", "attitude"),
    uses=("total_field", "reference/world_field"),
    gives=("calibration/*", "calibration/rotation", "calibrated/b", "residual/vector"),
    may_give=("residual/contrast", "residual/total_field", "residual/total_field_before"),
)
def calibrate_vector(survey: Survey, *, method: MethodChoice = "linear_regression") -> dict[str, Any]:
    """Calibrate each sensor against a known vector: the world field turned into the platform by the attitude.

    A method is ``f(raw (N, 3) nT, field (N, 3) nT in the platform frame, *, options) -> SensorCalibration``. All
    twelve parameters are determined, the rotation too. Where the reference names no `world_field`, its magnitude is
    the total field and its direction is estimated along with the parameters; a wrong total field is then a scale
    error that all sensors share.
    """
    from magtensor.attitude import into_platform

    given: dict[str, Any] = {}
    if "reference/world_field" in survey:
        free: tuple[str, ...] = ()
        field = into_platform(survey.values("attitude"), survey.values("reference/world_field"))
    else:
        free = ("a scale that all sensors share: the size of the world field is that of the total field",)
        field, given = estimated_field(survey)
    known = np.isfinite(field).all(axis=1)
    raw = survey.values("b_raw")
    fits = each_sensor(survey, lambda i, good: method(raw[good & known, i], field[good & known]))
    together = replace(side_by_side(fits), frame="platform", unobservable=free)
    given |= common_frame(survey, together, method.__name__) | per_sensor(fits)
    residual = together.apply(np.asarray(raw, dtype=float)) - field[:, None]
    attributes = {"units": "nT", "long_name": "b - known field"}
    given["residual/vector"] = (("time", "sensor", "axis"), residual, attributes)
    return given


def estimated_field(survey: Survey) -> tuple[np.ndarray, dict[str, Any]]:
    """(N, 3) nT, the field in the platform frame with the world direction that the sensors tell; and that direction."""
    from magtensor.attitude import into_platform
    from magtensor.calibration.world_field import world_direction

    if "total_field" not in survey:
        raise DataError(
            "neither the world field nor its size is known",
            where=str(survey.attributes.get("source", "")),
            hint="give `world_field` in the recipe's reference, or a total field and the stage detrend_diurnal",
        )
    attitude, total_field = survey.values("attitude"), np.asarray(survey.values("total_field"), dtype=float)
    raw = np.asarray(survey.values("b_raw"), dtype=float)
    turn = np.stack([into_platform(attitude, axis) for axis in np.eye(3)], axis=2)
    use = survey.readings & np.isfinite(total_field)
    use &= np.isfinite(turn).all(axis=(1, 2)) & np.isfinite(raw).all(axis=(1, 2))
    if not use.any():
        raise NotEnoughData("no sample has all sensors in use, an attitude and a total field")
    found = world_direction(raw[use], turn[use], total_field[use])
    attributes = {"units": "nT", "direction_std_deg": float(np.degrees(found.std)), "long_name": "field in the world"}
    vector = found.direction * float(np.mean(total_field[use]))
    field: np.ndarray = (turn @ found.direction) * total_field[:, None]
    return field, {"calibration/world_field": (("axis",), vector, attributes)}


def common_frame(survey: Survey, calibration: ArrayCalibration, method: str) -> dict[str, Any]:
    """The variables of a calibration whose sensors share one frame."""
    from magtensor.calibration.factors import rotation_and_upper

    names = survey.sensors
    calibration = replace(
        calibration,
        frame=by_name(calibration.frame, names),
        unobservable=tuple(by_name(words, names) for words in calibration.unobservable),
        diagnostics={
            by_name(key, names): by_name(value, names) if isinstance(value, str) else value
            for key, value in calibration.diagnostics.items()
        },
    )
    given = stored(calibration, survey.sensors, method=method) | corrected(calibration, survey)
    rotation = np.stack([rotation_and_upper(m)[0] for m in calibration.matrix])
    attributes = {"units": "1", "frame": calibration.frame, "long_name": "sensor (z along its z axis) to common frame"}
    given["calibration/rotation"] = (("sensor", "axis", "sensor_axis"), rotation, attributes)
    if len(survey.sensors) > 1:
        given |= contrasts(calibration.apply(np.asarray(survey.values("b_raw"), dtype=float)))
    return given | published_parameters(calibration, survey.sensors)


def published_parameters(calibration: ArrayCalibration, sensors: list[str]) -> dict[str, Any]:
    """Scale factors, angles and offsets in Chi's and in Li's parameters, with standard deviations.

    A sensor that the correction mirrors has no such angles: its row is NaN.
    """
    from magtensor.calibration.parameters import CHI, LI, UNITS, parameters

    given: dict[str, Any] = {}
    size = PARAMETERS_PER_SENSOR
    for key, convention in (("chi2017", CHI), ("li2018", LI)):
        values, std = np.full((2, len(sensors), size), np.nan)
        for s in range(len(sensors)):
            block = slice(size * s, size * (s + 1))
            try:
                found = parameters(
                    calibration.matrix[s], calibration.offset[s], calibration.covariance[block, block], convention
                )
            except DataError:
                continue
            values[s], std[s] = found.values, found.std
        dims = ("sensor", f"{key}_parameter")
        names = (dims[1:], np.array(convention.names), {"units_of_each": list(UNITS), "convention": convention.name})
        given[f"calibration/{key}_parameter"] = names
        given[f"calibration/{key}"] = (dims, values, {"units": f"see {key}_parameter"})
        given[f"calibration/{key}_std"] = (dims, std, {"units": f"see {key}_parameter"})
    return given
