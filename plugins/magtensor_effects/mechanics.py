"""Error models of the frame and of sensors that disturb each other."""

from typing import Annotated

import numpy as np
from pydantic import Field

from magtensor.attitude import into_platform
from magtensor.calibration.types import Array
from magtensor.components import error_model
from magtensor.error_models.acting import AXES
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import LagsOf, Orders, Range
from magtensor.error_models.terms import Terms, joined
from magtensor.units import GRAVITY
from magtensor_effects.ageing import EventTime, Span
from magtensor_effects.channels import OTHER
from magtensor_effects.forms import AtStart, Delayed, Smooth
from magtensor_effects.temperature import THERMOMETER, ThermalLag, Thermometer

ARCMIN = np.pi / (180.0 * 60.0)
UP = np.array([0.0, 0.0, 1.0])

Angles = Annotated[
    int,
    Orders((3, 6)),
    Field(description="3: each sensor turns as a whole; 6: the angles between its axes change too"),
]


@error_model(
    "instrument",
    needs=("acceleration|attitude",),
    source="small rotation in proportion to the specific force",
    typical="1 arcmin is 14.5 nT, 29 nT/m on a baseline of 0.5 m",
)
def frame_flexure(
    x: Excitation,
    *,
    lag_s: Annotated[
        float,
        LagsOf(0.0, 30.0, count=6, spacing="log", channel="acceleration"),
        Field(ge=0, description="time constant of a frame that gives way late, s"),
    ] = 0.0,
) -> Terms:
    """The frame bends under gravity and acceleration and turns each sensor by a small angle.

    C (b x e g) with the specific force g in units of standard gravity and a matrix e of each sensor: nine
    coefficients, the turn about one axis for a force along another. The force is that of the logged acceleration, or
    gravity alone from the attitude where none is logged; a damped frame follows it through a first-order lag. Rivals:
    `fixed_source` and `site_gradient`, for gravity and a source are both fixed to the ground; the sag common to all
    sensors is not visible without a vector reference.
    """
    if "acceleration" in x.logged:
        force = x.channel("acceleration") / GRAVITY
    elif x.attitude is not None:
        force = into_platform(x.attitude, UP)
    else:
        raise KeyError("the survey has neither acceleration nor attitude")
    force = x.relaxed(force, lag_s)
    bends = []
    for about in range(3):
        turned = x.sensed(np.cross(x.field, np.eye(3)[about] * ARCMIN))
        for along in range(3):
            bent = turned * force[:, None, None, along]
            bends.append(x.one_each(bent, "arcmin/g", AXES[about] + AXES[along]))
    return joined(bends)


@error_model(
    "instrument",
    source="small rotation of the field at the sensor",
    typical="14.5 nT for 1 arcmin in 50 000 nT",
    pointwise=True,
)
def turn_step(x: Excitation, *, time_s: EventTime = 0.0, angles: Angles = 3) -> Terms:
    """Each sensor turns in its mount at a time: a knock, a screw that gave way.

    C (b x e) from the time on: three coefficients a sensor, the angles about x, y and z of the platform; with six
    angles also the symmetric part, as of `temperature_alignment`: iron that was moved, a core that has slipped. Several
    knocks are several models of this name. A turn common to all sensors is not visible without a vector reference.
    Rivals: `scale_step` and `offset_step` where the attitude hardly changes.
    """
    return joined(_by_an_arcmin(x, (x.elapsed >= time_s).astype(float), "arcmin", angles))


@error_model(
    "instrument",
    needs=("temperature*",),
    source="small rotation in proportion to the temperature",
    typical="seconds of arc per degC: 1 arcsec is 0.24 nT in 50 000 nT",
    pointwise=True,
)
def temperature_alignment(
    x: Excitation,
    *,
    channel: Thermometer = "",
    lag_s: ThermalLag = 0.0,
    delayed: Delayed = False,
    at_start: AtStart = 0.0,
    angles: Angles = 3,
) -> Terms:
    """Each sensor's axes turn as its temperature changes: a mount that expands, a core that warps.

    C (b x e) times the lagged temperature, e the rotation vector in the platform frame; with six angles also the
    symmetric part, by which two axes of a sensor lean towards each other. What turns all sensors alike is not visible
    without a vector reference. Rivals: `temperature_scale` where few attitudes are seen; `alignment_drift` where the
    temperature rises steadily; `turn_step`.
    """
    name = THERMOMETER.pick(x, channel)
    course = x.thermometer(name, lag_s, delayed, at_start)
    return joined(_by_an_arcmin(x, course, f"arcmin/{x.units[name]}", angles))


@error_model(
    "instrument",
    source="small rotation in proportion to a load",
    typical="a boom under load, a hull under pressure: 1 arcmin is 14.5 nT in 50 000 nT",
    pointwise=True,
)
def channel_alignment(
    x: Excitation,
    *,
    channel: Annotated[
        str,
        OTHER,
        Field(description="any logged channel with one component but temperatures and angles; '': the only one"),
    ] = "",
    lag_s: Annotated[
        float,
        Range(0.0, 300.0, count=4, spacing="log"),
        Field(ge=0, description="time constant of a frame that gives way late, s"),
    ] = 0.0,
    smooth: Smooth = False,
    angles: Angles = 3,
) -> Terms:
    """Each sensor's axes turn as a logged channel changes: a load, a pressure, a tension that bends what holds it.

    As `temperature_alignment`, of any other channel, through a first-order lag. A load that nobody logs shows as a
    matrix that changes with time. Rivals: `temperature_alignment` where the temperature goes with the channel,
    `alignment_drift` where it rises steadily, `channel_response` where few attitudes are seen.
    """
    name = OTHER.pick(x, channel)
    course = x.channel(name, lag_s, smooth=smooth)
    return joined(_by_an_arcmin(x, course, f"arcmin/{x.units[name]}", angles))


@error_model(
    "instrument",
    source="small rotation that grows with time",
    typical="a glue that creeps, a screw that settles: arcmin, 14.5 nT each in 50 000 nT",
    pointwise=True,
)
def alignment_drift(
    x: Excitation,
    *,
    tau_s: Annotated[
        float,
        Range(0.05, 5.0, count=5, spacing="log", of_duration=True),
        Field(gt=0, description="time constant with which it comes to rest, s; long: it turns steadily"),
    ] = 3600.0,
    span_s: Span = 3600.0,
    angles: Angles = 3,
) -> Terms:
    """Each sensor's axes turn with time and come to rest.

    As `temperature_alignment`, with a course from 0 at the start to 1 after span_s that settles with tau_s in the place
    of the temperature: the coefficients are the angles turned by in the survey. It is not predicted beyond span_s.
    Rivals: `temperature_alignment` where the temperature rises steadily; `turn_step`; `scale_drift` where few attitudes
    are seen.
    """
    course = np.expm1(-np.clip(x.elapsed, 0.0, span_s) / tau_s) / np.expm1(-span_s / tau_s)
    return joined(_by_an_arcmin(x, course, "arcmin", angles))


def _by_an_arcmin(x: Excitation, course: Array, units: str, angles: int) -> list[Terms]:
    """What each sensor reads more when it turns by an arcmin about an axis of the platform, times a course (N,) or that
    of each sensor (N, S), and of six angles also when two of its own axes lean by as much towards each other."""
    turned = [
        x.one_each_sensing(course, np.cross(x.field_or_fields, axis * ARCMIN), units, name)
        for name, axis in zip(AXES, np.eye(3), strict=True)
    ]
    if angles == 3:
        return turned
    leaning = []
    for i, j in ((0, 1), (0, 2), (1, 2)):
        axes = np.zeros((3, 3))
        axes[i, j] = axes[j, i] = ARCMIN
        leaning.append(x.one_each_sensing(course, x.field_or_fields, units, AXES[i] + AXES[j], axes))
    return [*turned, *leaning]


@error_model(
    "instrument",
    needs=("position", "gradient"),
    source="dipole field of a feedback coil",
    typical="5 nT between sensors 0.25 m apart with coils of 20 mm, 75 nT at 0.1 m",
    pointwise=True,
)
def crosstalk(x: Excitation) -> Terms:
    """The feedback coil of each sensor, which cancels the field there, is a dipole at the other sensors.

    A coil of k cm3 adds k (3 n n - 1) b_j / r^3 at a sensor at distance r in direction n. Its part in proportion to
    the other sensor's own field b_i is inside that sensor's C, so only b_j - b_i counts: nothing in a uniform field.
    One coefficient for each coil.
    """
    if x.position is None:
        raise KeyError("the survey has no positions")
    b, coils = x.local_field, []
    for j in range(len(x.sensors)):
        stray = np.zeros_like(b)
        for i in range(len(x.sensors)):
            if i != j:
                stray[:, i] = (b[:, j] - b[:, i]) @ _dipole(x.position[i] - x.position[j])
        coils.append(x.sensed(1e-6 * stray))
    number = np.arange(len(coils))
    outputs = np.arange(3 * len(coils))
    return Terms(
        ("coil",) * len(coils),
        x.sensors,
        ("cm3",) * len(coils),
        np.hstack([c.reshape(len(x.time), -1) for c in coils]),
        np.repeat(number, len(outputs)),
        np.tile(outputs, len(coils)),
        np.arange(len(coils) * len(outputs)),
    )


def _dipole(r: Array) -> Array:
    """(3, 3) 1/m3: 3 n n - 1 over the distance cubed."""
    distance = float(np.linalg.norm(r))
    n = r / distance
    out: Array = (3.0 * np.outer(n, n) - np.eye(3)) / distance**3
    return out
