"""Error models of where the sensors are. They show in a gradient only: no calibration in a uniform field tests them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from magtensor.calibration.types import Array
from magtensor.components import error_model
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import Choice
from magtensor.error_models.terms import Terms, joined
from magtensor_effects.temperature import THERMOMETER, Thermometer

LEAST_TURNED = 3  # sensors: the shifts of two are a turn but for what is along the line between them
MOST_OF_A_TURN = 0.9  # of the squares of the shifts; by chance of three sensors in 5 %, of four in 0.3 %


def _positions(x: Excitation) -> Array:
    if x.position is None:
        raise KeyError("the survey has no positions")
    return x.position


def _turned_together(x: Excitation, settings: Mapping[str, Any], found: Mapping[tuple[str, str], float]) -> str:
    """How much of the shifts is one turn of the whole array, which attitudes that are turned against it show too."""
    sensors = list(dict.fromkeys(s for s, _ in found))
    if len(sensors) < LEAST_TURNED:
        return ""
    places = dict(zip(x.sensors, 1e3 * _positions(x), strict=True))  # mm
    place = np.array([places[s] for s in sensors])
    shift = np.array([[found[s, axis] for axis in "xyz"] for s in sensors])
    place, shift = place - place.mean(axis=0), shift - shift.mean(axis=0)
    by_each = np.stack([np.cross(axis, place).ravel() for axis in np.eye(3)], axis=1)  # of a turn by one
    turn = np.linalg.lstsq(by_each, shift.ravel(), rcond=1e-6)[0]
    share = float(np.sum((by_each @ turn) ** 2) / max(np.sum(shift**2), 1e-300))
    if share < MOST_OF_A_TURN:
        return ""
    angle = np.rad2deg(float(np.linalg.norm(turn)))
    return f"{share:.0%} of it is one turn of all places by {angle:.2g} deg: the attitudes may be turned by that"


@error_model(
    "instrument",
    needs=("position", "gradient"),
    source="Taylor series of the field",
    typical="1 nT for 1 mm in 1000 nT/m",
    pointwise=True,
    means=_turned_together,
)
def position_error(x: Excitation) -> Terms:
    """A sensor's centre is not where the survey says: it sees the gradient times the offset.

    Three coefficients a sensor, true minus stated position. The gradient is that of the whole array, so a shift
    common to all sensors does not show; beside an unknown source at the site, an array larger than it should be does
    not, for a stronger source is the same. Attitudes that are turned against the array are nearly the same as an array
    that is turned against them.
    """
    place = _positions(x)
    per_mm = [x.sensed(np.broadcast_to(1e-3 * x.gradient[:, None, :, axis], x.output.shape)) for axis in range(3)]
    each = joined([x.one_each(series, "mm", name) for series, name in zip(per_mm, "xyz", strict=True)])
    if x.site is None:
        return each
    larger = sum(series * place[:, axis, None] for axis, series in enumerate(per_mm))
    return _without_common_part(each, np.reshape(larger, (len(x.time), -1)), place.T.ravel() / np.sum(place**2))


def _without_common_part(each: Terms, larger: Array, shares: Array) -> Terms:
    """Terms of which one combination makes nothing: what it makes, `larger` (N, outputs), is taken off each of them in
    its share (P,)."""
    having, outputs = np.flatnonzero(shares), np.arange(larger.shape[1])
    return replace(
        each,
        series=np.hstack([each.series, *(-shares[k] * larger for k in having)]),
        part_term=np.concatenate([each.part_term, np.repeat(having, len(outputs))]),
        part_output=np.concatenate([each.part_output, np.tile(outputs, len(having))]),
        part_series=np.concatenate([each.part_series, each.series.shape[1] + np.arange(len(having) * len(outputs))]),
        part_weight=np.concatenate([each.part_weight, np.ones(len(having) * len(outputs))]),
    )


@error_model(
    "instrument",
    needs=("position", "gradient", "temperature*"),
    source="thermal expansion",
    typical="23 ppm/degC for aluminium",
    pointwise=True,
)
def baseline_expansion(x: Excitation, *, channel: Thermometer = "") -> Terms:
    """The frame grows with temperature about the platform's origin: each sensor sees the gradient times its shift.

    One coefficient. Rival: `position_error` where the temperature hardly changes.
    """
    name = THERMOMETER.pick(x, channel)
    logged = x.thermometer(name)
    warmth = logged.mean(axis=1) if logged.ndim == 2 else logged
    shift = np.einsum("nij,sj->nsi", x.gradient, _positions(x))
    return x.shared(x.sensed(1e-6 * warmth[:, None, None] * shift), f"ppm/{x.units[name]}", "expansion")


@error_model(
    "instrument",
    needs=("position", "travel"),
    source="Taylor series of the field; dipole on the axis",
    typical="0.83 (d/r)^2 of the gradient beside a dipole: 0.8 % at ten baselines",
)
def finite_baseline(
    x: Excitation,
    *,
    travel: Annotated[
        str, Choice(("x", "y", "z")), Field(pattern="^[xyz]$", description="platform axis along which it moves")
    ] = "x",
) -> Terms:
    """The field between the sensors is not linear: half the second derivative times the square of the distance.

    On a line the change of the gradient in time, over the speed, is its derivative along the line. That gives all of
    the bend for sensors before and behind the centre, and for those beside it the component along the line; their other
    components depend on two second derivatives across the line that no single pass shows, and are left out. Small
    swings of the attitude are taken as changes of the gradient. One coefficient, the inverse of the speed. An array of
    eight sensors measures all of it (`least_squares` with `highest_order`).
    """
    place = _positions(x) - _positions(x).mean(axis=0)
    along = x.derivative(x.gradient)
    axis = "xyz".index(travel)
    before, beside = place[:, axis], place * (np.arange(3) != axis)
    bend = 0.5 * before[None, :, None] ** 2 * along[:, None, :, axis]
    bend = bend + before[None, :, None] * np.einsum("nij,sj->nsi", along, beside)
    bend[:, :, axis] += 0.5 * np.einsum("nij,si,sj->ns", along, beside, beside)
    return x.shared(x.sensed(bend), "s/m", "slowness")
