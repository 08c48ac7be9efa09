"""Error models of currents and supply voltages."""

from typing import Annotated

from pydantic import Field

from magtensor.components import error_model
from magtensor.error_models.curves import along_a_curve
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel, Range
from magtensor.error_models.terms import Terms, joined
from magtensor_effects.forms import Bent, Delayed, OfField, Smooth

CURRENT = AnyChannel("current_*", or_units="A", vectors=False)
SUPPLY = AnyChannel("supply*", or_units="V", vectors=False)

Supply = Annotated[str, SUPPLY, Field(description="supply voltage channel; '': the only one")]


@error_model(
    "instrument",
    needs=("current_*",),
    source="Springmann and Cutler 2012 (RAX); Olsen et al. 2020 (CryoSat-2)",
    typical="16 nT for 1 A in a loop of 100 cm2 at 0.5 m; CryoSat-2 1 to 2 nT",
    pointwise=True,
)
def current_field(
    x: Excitation,
    *,
    channel: Annotated[str, CURRENT, Field(description="current channel; '': the only one")] = "",
    lag_s: Annotated[
        float,
        Range(0.0, 10.0, count=5, spacing="log", late=True),
        Field(description="how far the current is behind the logged one, s; below 0 the log is so much late"),
    ] = 0.0,
    smooth: Smooth = False,
    delayed: Delayed = False,
    bends: Bent = (),
) -> Terms:
    """The magnetic field of a logged current: a constant vector at each sensor, in proportion to it, or to any curve of
    it (a rectifier, a meter that saturates).

    One coefficient an axis: the field as the axis senses it, C times the field at the sensor (by which a simulated one
    is given). Rivals: other currents that switch together; `supply_offset`, for the supply sags under the current.
    """
    name = CURRENT.pick(x, channel)
    course = x.channel(name, lag_s, delayed, smooth)
    return joined([x.offsets(c, f"nT/{x.units[name]}", label) for label, c in along_a_curve(course, bends)])


@error_model(
    "instrument",
    needs=("supply*",),
    source="dependence of the excitation on the supply",
    typical="10 ppm/V",
    pointwise=True,
)
def supply_scale(
    x: Excitation, *, channel: Supply = "", smooth: Smooth = False, of_field: OfField = False, bends: Bent = ()
) -> Terms:
    """Each axis's scale factor follows the supply voltage.

    The voltage times the axis's own output. Rivals: `supply_offset` where the attitude hardly changes;
    `scale_drift` for a battery that discharges steadily.
    """
    name = SUPPLY.pick(x, channel)
    course = x.channel(name, smooth=smooth)
    units = f"ppm/{x.units[name]}"
    return joined([x.scales(1e-6 * c, units, label, of_field=of_field) for label, c in along_a_curve(course, bends)])


@error_model(
    "instrument",
    needs=("supply*",),
    source="dependence of the electronics on the supply",
    typical="a nT/V",
    pointwise=True,
)
def supply_offset(x: Excitation, *, channel: Supply = "", smooth: Smooth = False, bends: Bent = ()) -> Terms:
    """Each axis's offset follows the supply voltage.

    Rivals: `current_field` of the current under which the supply sags; `supply_scale` where the attitude hardly
    changes; `offset_drift` for a battery that discharges steadily.
    """
    name = SUPPLY.pick(x, channel)
    course = x.channel(name, smooth=smooth)
    return joined([x.offsets(c, f"nT/{x.units[name]}", label) for label, c in along_a_curve(course, bends)])
