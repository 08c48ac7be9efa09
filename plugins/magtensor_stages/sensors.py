"""The stages that calibrate sensors: each alone against a total field, or all at once, or against a known vector."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from magtensor import DataError, MethodChoice, NotEnoughData, stage
from magtensor.calibrated import contrasts, corrected, stored
from magtensor.calibration.types import ArrayCalibration, SensorCalibration

if TYPE_CHECKING:
    from magtensor.survey.model import Survey

FITTED = ("calibration/*", "calibrated/b", "residual/total_field", "residual/total_field_before")


def usable(survey: Survey, sensor: int) -> np.ndarray:
    """(N,) samples of one sensor that may enter a fit: not flagged, finite, with a total field where one is used."""
    good = survey.good_by_sensor[:, sensor] & np.isfinite(survey.values("b_raw")[:, sensor]).all(axis=1)
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
            raise NotEnoughData("no sample is left in use", where=f"{source} sensor {name}".strip())
        try:
            calibrations.append(fit(i, good))
        except DataError as error:
            place = " ".join(p for p in (source, f"sensor {name}", error.where) if p)
            raise type(error)(error.what, where=place, hint=error.hint) from error
    return calibrations


def side_by_side(calibrations: list[SensorCalibration]) -> ArrayCalibration:
    """Sensors calibrated each alone, each still in a frame of its own."""
    from scipy.linalg import block_diag

    return ArrayCalibration(
        np.stack([c.matrix for c in calibrations]),
        np.stack([c.offset for c in calibrations]),
        block_diag(*[c.covariance for c in calibrations]),
        f"each sensor's own ({calibrations[0].frame})",
        ("a rotation of each sensor",),
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
    return stored(together, survey.sensors, method=method.__name__) | per_sensor(fits) | corrected(together, survey)


@stage(needs=("b_raw", "total_field"), gives=(*FITTED, "calibration/rotation", "residual/contrast"))
def calibrate_array(survey: Survey, *, method: MethodChoice = "li2018") -> dict[str, Any]:
    """Calibrate all sensors at once into one common frame.

    A method is ``f(raw (N, S, 3) nT, total_field (N,) nT, *, options) -> ArrayCalibration``.
    """
    raw, total_field = survey.values("b_raw"), survey.values("total_field")
    good = survey.good & np.isfinite(total_field) & np.isfinite(raw).all(axis=(1, 2))
    return common_frame(survey, method(raw[good], total_field[good]), method.__name__)


def common_frame(survey: Survey, calibration: ArrayCalibration, method: str) -> dict[str, Any]:
    """The variables of a calibration whose sensors share one frame."""
    from magtensor.calibration.factors import rotation_and_upper

    given = stored(calibration, survey.sensors, method=method) | corrected(calibration, survey)
    rotation = np.stack([rotation_and_upper(m)[0] for m in calibration.matrix])
    attributes = {"units": "1", "frame": calibration.frame, "long_name": "sensor (z along its z axis) to common frame"}
    given["calibration/rotation"] = (("sensor", "axis", "sensor_axis"), rotation, attributes)
    return given | contrasts(calibration.apply(np.asarray(survey.values("b_raw"), dtype=float)))
