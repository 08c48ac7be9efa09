"""Error models of where the sensors are. They show in a gradient only: no calibration in a uniform field tests them."""

from typing import Annotated

import numpy as np
from pydantic import Field

from magtensor.calibration.types import Array
from magtensor.components import error_model
from magtensor.loop.excitation import Excitation
from magtensor.loop.settings import Choice
from magtensor.loop.terms import Terms, joined
from magtensor_effects.temperature import THERMOMETER, Thermometer


def _positions(x: Excitation) -> Array:
    if x.position is None:
        raise KeyError("the survey has no positions")
    return x.position


@error_model(
    "instrument", needs=("position", "gradient"), source="METHODS A3, 32", typical="1 nT for 1 mm in 1000 nT/m"
)
def position_error(x: Excitation) -> Terms:
    """A sensor's centre is not where the survey says: it sees the gradient times the offset.

    Three coefficients a sensor, true minus stated position. The gradient is that of the whole array, so a shift
    common to all sensors does not show.
    """
    _positions(x)
    each = []
    for axis, name in enumerate("xyz"):
        per_mm = np.broadcast_to(1e-3 * x.gradient[:, None, :, axis], x.output.shape)
        each.append(x.one_each(x.sensed(per_mm), "mm", name))
    return joined(each)


@error_model(
    "instrument",
    needs=("position", "gradient", "temperature*"),
    source="METHODS A3, 33",
    typical="23 ppm/degC for aluminium",
)
def baseline_expansion(x: Excitation, *, channel: Thermometer = "") -> Terms:
    """The frame grows with temperature about the platform's origin: each sensor sees the gradient times its shift.

    One coefficient. Rival: `position_error` where the temperature hardly changes.
    """
    name = THERMOMETER.pick(x, channel)
    logged = x.channel(name)
    warmth = logged.mean(axis=1) if logged.ndim == 2 else logged
    shift = np.einsum("nij,sj->nsi", x.gradient, _positions(x))
    return x.shared(x.sensed(1e-6 * warmth[:, None, None] * shift), f"ppm/{x.units[name]}", "expansion")


@error_model(
    "instrument",
    needs=("position", "gradient"),
    source="METHODS A3, 31",
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

    On a line the change of the gradient in time, over the speed, is its derivative along the line, which gives five of
    the seven second derivatives; the two that lie across the line are taken as the smallest that Laplace's equation
    allows. One coefficient, the inverse of the speed. An array of eight sensors measures all of it
    (`least_squares` with `highest_order`).
    """
    place = _positions(x) - _positions(x).mean(axis=0)
    rate = x.derivative(x.gradient)
    curvature = _completed(rate, "xyz".index(travel))
    bend = 0.5 * np.einsum("nijk,sj,sk->nsi", curvature, place, place)
    return x.shared(x.sensed(bend), "s/m", "slowness")


def _completed(along: Array, l: int) -> Array:  # noqa: E741
    """(N, 3, 3, 3) symmetric and traceless from its slices (N, 3, 3) with one index l.

    The field derivatives d_a d_b B_c are symmetric in all three indices; those without l have fixed traces and are
    else zero in their two harmonic directions.
    """
    m, n = (i for i in range(3) if i != l)
    out = np.zeros((len(along), 3, 3, 3))
    for a in range(3):
        for b in range(3):
            out[:, l, a, b] = out[:, a, l, b] = out[:, a, b, l] = along[:, a, b]
    for p, q in ((m, n), (n, m)):
        trace = -along[:, l, p]  # of the block without l: d_p (d_m d_m + d_n d_n) = -d_p d_l d_l
        out[:, p, p, p] = 0.75 * trace
        for order in ((p, q, q), (q, p, q), (q, q, p)):
            out[(slice(None), *order)] = 0.25 * trace
    return out
