"""Error models that follow a logged channel or a tone."""

from typing import Annotated

import numpy as np
from pydantic import Field

from magtensor.components import error_model
from magtensor.error_models.acting import AXES
from magtensor.error_models.curves import along_a_curve
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel, Choice, Forms, Frequencies, Range
from magtensor.error_models.terms import Terms, joined
from magtensor.errors import UsageError
from magtensor.units import convert
from magtensor_effects.forms import AtStart, BentPower, Delayed, OfField, Smooth

ATTITUDE_ANGLES = ("roll*", "pitch*", "yaw*", "heading*", "azimuth*", "course*", "latitude*", "longitude*")
ENCODER = AnyChannel("encoder*", without=ATTITUDE_ANGLES, or_units="rad", vectors=False)
ANY = AnyChannel("*")
OTHER = AnyChannel("*", without=("temperature*", *ATTITUDE_ANGLES), but_units="degC", vectors=False)


@error_model(
    "instrument", needs=("encoder*",), source="rotating dipole", typical="100 nT for 1 A m2 at 1 m", pointwise=True
)
def moving_part(
    x: Excitation, *, channel: Annotated[str, ENCODER, Field(description="angle channel; '': the only one")] = ""
) -> Terms:
    """A magnetised part that turns about an axis on the platform (gimbal, rudder, winch), its angle logged.

    Cosine and sine of the angle, each a constant vector at each sensor: two coefficients an axis. Harmonics of the
    angle and magnetisation induced in the part are left out. Rival: `current_field` of its motor.
    """
    name = ENCODER.pick(x, channel)
    angle = x.channel(name) * (convert(1.0, x.units[name], "rad") if x.units[name] not in ("", "1") else 1.0)
    return joined([x.offsets(np.cos(angle), "nT", "cos "), x.offsets(np.sin(angle), "nT", "sin ")])


@error_model(
    "instrument", source="sampled sinusoid", typical="a nT of mains beside buildings; tens from a motor", pointwise=True
)
def periodic_interference(
    x: Excitation,
    *,
    frequency_Hz: Annotated[
        float, Frequencies(), Field(gt=0, description="frequency as it appears in the record, aliased or not, Hz")
    ] = 50.0,
) -> Terms:
    """A tone: mains, a motor, a propeller, as it comes out after sampling.

    Cosine and sine of 2 pi f t with t from the survey's start: two coefficients an axis. The phase belongs to this
    survey: on another one only amplitude and frequency carry over. Harmonics are models of their own of this name.
    """
    turn = 2.0 * np.pi * frequency_Hz * x.elapsed
    return joined([x.offsets(np.cos(turn), "nT", "cos "), x.offsets(np.sin(turn), "nT", "sin ")])


@error_model(
    "instrument",
    source="power series of a channel",
    typical="unknown: for channels that nobody wrote a model for",
    pointwise=True,
)
def channel_response(
    x: Excitation,
    *,
    channel: Annotated[str, ANY, Field(description="any logged channel; '': the only one")] = "",
    power: Annotated[int, Choice((1, 2, 3)), Field(ge=1, le=3, description="power of the channel")] = 1,
    lag_s: Annotated[
        float,
        Range(0.0, 300.0, count=5, spacing="log", late=True),
        Field(description="how far the response is behind the channel, s; below 0 the channel's log is so much late"),
    ] = 0.0,
    smooth: Smooth = False,
    delayed: Delayed = False,
    at_start: AtStart = 0.0,
    times_field: Annotated[
        bool,
        Choice((False, True)),
        Field(description="true: it changes the scale factors; false: it adds to the offsets"),
    ] = False,
    of_field: OfField = False,
    lower_powers: Annotated[
        bool,
        Forms((False, True)),
        Field(description="true: its lower powers beside it, as of a power about another zero; of one component only"),
    ] = False,
    bends: BentPower = (),
) -> Terms:
    """The output follows a power of any logged channel, or any curve of it, through a lag, as an offset or as a factor.

    The power is about zero for a current and for what goes both ways, else about the channel's mean. One coefficient an
    axis; nine a sensor for a channel with three components. Rivals: the model that names the cause
    (`temperature_offset`, `current_field`, ...), identical to this one at power 1.
    """
    name = ANY.pick(x, channel)
    course = x.channel(name, lag_s, delayed, smooth, at_start)
    if bends and x.is_vector(name):
        raise UsageError(f"bends: {name} has three components; a curve is of a channel with one")
    per_unit = f"({x.units[name]})^{power}" if power > 1 else x.units[name]
    columns = [("", per_unit, course**power)]
    for k in range(1, power if lower_powers else 1):
        columns.append((f"power {k} ", f"({x.units[name]})^{k}" if k > 1 else x.units[name], course**k))
    columns += [(label, x.units[name], column) for label, column in along_a_curve(course, bends)[1:]]
    if not times_field:
        if x.is_vector(name):
            return x.matrices(course**power, f"nT/{per_unit}")
        return joined([x.offsets(column, f"nT/{unit}", label) for label, unit, column in columns])
    if x.is_vector(name):
        columns = [(f"{AXES[i]} ", per_unit, column) for i, column in enumerate((course**power).T)]
    return joined([x.scales(1e-6 * c, f"ppm/{unit}", label, of_field=of_field) for label, unit, c in columns])


@error_model(
    "instrument",
    source="induction; first-order high-pass",
    typical="unknown: a pick-up loop beside a current, a coupling capacitor, a kick whenever something is switched",
    pointwise=True,
)
def channel_rate(
    x: Excitation,
    *,
    channel: Annotated[
        str,
        OTHER,
        Field(
            description="any logged channel with one component but temperatures and attitude angles; '': the only one"
        ),
    ] = "",
    lag_s: Annotated[
        float,
        Range(0.0, 300.0, count=6, spacing="log"),
        Field(ge=0, description="time constant with which what a change has caused dies away, s"),
    ] = 0.0,
    smooth: Smooth = False,
    at_start: AtStart = 0.0,
) -> Terms:
    """The output follows the rate of change of any logged channel, through a lag: where the channel jumps, a kick that
    dies away.

    Through a lag that is the channel less the lagged one, over lag_s. One coefficient an axis. What a current induces
    in a loop, what comes through a capacitor. Rivals: `channel_response`, ahead by a quarter of a period where the
    channel swings with one. Of a thermometer: `temperature_rate`.
    """
    name = OTHER.pick(x, channel)
    return x.offsets(x.rate_of(name, lag_s, smooth, at_start), f"nT s/{x.units[name]}")
