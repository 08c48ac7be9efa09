"""Error models of temperature."""

from typing import Annotated

from pydantic import Field

from magtensor.calibration.types import Array
from magtensor.components import error_model
from magtensor.error_models.curves import along_a_curve
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel, Beginning, Orders, Range
from magtensor.error_models.terms import Terms, joined
from magtensor_effects.forms import AtStart, BentOrder, Delayed, OfField

THERMOMETER = AnyChannel("temperature*", or_units="degC", vectors=False)

Thermometer = Annotated[
    str, THERMOMETER, Field(description="temperature channel, one for all sensors or one for each; '': the only one")
]
Order = Annotated[int, Orders((1, 2)), Field(ge=1, le=2, description="highest power of the temperature")]
ThermalLag = Annotated[
    float,
    Range(-300.0, 3600.0, count=11, spacing="log"),
    Field(description="how far the sensor is behind the thermometer, s; below 0 the thermometer is behind the sensor"),
]


@error_model(
    "instrument",
    needs=("temperature*",),
    source="first-order thermal lag; coefficients as in Olsen et al. 2020 (CryoSat-2)",
    typical="0.1 nT/degC for a good fluxgate; thermal lags of minutes",
    pointwise=True,
)
def temperature_offset(
    x: Excitation,
    *,
    order: Order = 1,
    channel: Thermometer = "",
    lag_s: ThermalLag = 0.0,
    delayed: Delayed = False,
    at_start: AtStart = 0.0,
    bends: BentOrder = (),
) -> Terms:
    """Each axis's offset follows the temperature of the sensor, which lags the thermometer.

    The thermometer is seen through a first-order lag, also across gaps in the recording. One coefficient an axis and
    power; powers are of the difference from the calibration survey's mean. Rivals: `offset_drift` and `warm_up` where
    the temperature rises steadily; `temperature_scale` where the attitude hardly changes; `temperature_rate` for
    short lags.
    """
    name = THERMOMETER.pick(x, channel)
    course = x.thermometer(name, lag_s, delayed, at_start)
    columns = _columns(course, x.units[name], order, bends)
    return joined([x.offsets(column, f"nT/{units}", label) for units, label, column in columns])


@error_model(
    "instrument",
    needs=("temperature*",),
    source="Toffner-Clausen et al. 2016 (Swarm); Olsen et al. 2020 (CryoSat-2)",
    typical="20 ppm/degC for a fluxgate, 100 for an orthogonal one, below 1 for Swarm after correction",
    pointwise=True,
)
def temperature_scale(
    x: Excitation,
    *,
    order: Order = 1,
    channel: Thermometer = "",
    lag_s: ThermalLag = 0.0,
    delayed: Delayed = False,
    at_start: AtStart = 0.0,
    of_field: OfField = False,
    bends: BentOrder = (),
) -> Terms:
    """Each axis's scale factor follows the temperature of the sensor, which lags the thermometer.

    The lagged temperature times the axis's own output. One coefficient an axis and power. Rivals:
    `temperature_offset` where the attitude hardly changes; `scale_drift` where the temperature rises steadily.
    """
    name = THERMOMETER.pick(x, channel)
    course = x.thermometer(name, lag_s, delayed, at_start)
    columns = _columns(course, x.units[name], order, bends)
    return joined([x.scales(1e-6 * c, f"ppm/{units}", label, of_field=of_field) for units, label, c in columns])


@error_model(
    "instrument",
    needs=("temperature*",),
    source="Toffner-Clausen et al. 2016 (Swarm: currents driven by the Sun)",
    typical="a nT where sun and shade alternate (Swarm: 1.05 nT rms with it, 0.55 without)",
    pointwise=True,
)
def temperature_rate(
    x: Excitation,
    *,
    channel: Thermometer = "",
    tau_s: Annotated[
        float,
        Range(5.0, 600.0, count=6, spacing="log"),
        Field(gt=0, description="time constant of the core behind the skin, s"),
    ] = 20.0,
    at_start: Annotated[
        float,
        Beginning("tau_s"),
        Field(description="by how much the core was warmer than the logged temperature when the survey began"),
    ] = 0.0,
) -> Terms:
    """Thermoelectric currents follow the temperature difference between the skin of a body and its core.

    The core follows the logged temperature with a first-order lag; for changes slower than that the difference is
    tau_s times the rate of change, without the noise that a numerical derivative would bring. One coefficient an
    axis. What was brought from elsewhere began with a difference. Rivals: `temperature_offset` with a lag; `warm_up`
    where such a beginning is all there is.
    """
    name = THERMOMETER.pick(x, channel)
    return x.offsets(x.thermometer(name) - x.thermometer(name, tau_s, at_start=at_start), f"nT/{x.units[name]}")


def _columns(course: Array, unit: str, order: int, bends: tuple[float, ...]) -> list[tuple[str, str, Array]]:
    """Powers of a temperature up to an order and how far it is beyond each bend: the unit of each, what the names of
    its coefficients begin with, and its values."""
    powers = [
        (unit if k == 1 else f"({unit})^{k}", "" if k == 1 else f"power {k} ", course**k) for k in range(1, order + 1)
    ]
    return powers + [(unit, label, column) for label, column in along_a_curve(course, bends)[1:]]
