"""Error models of time: drifts, warming up, jumps."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from magtensor.calibration.types import Array
from magtensor.components import error_model
from magtensor.error_models.acting import AXES
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import Duration, EventTimes, Laws, Orders, Range
from magtensor.error_models.terms import Terms, joined
from magtensor_effects.forms import OfField

Order = Annotated[int, Orders((1, 2, 3)), Field(ge=1, le=3, description="highest power of time, or what it goes as")]
Span = Annotated[
    float,
    Duration(),
    Field(gt=0, description="time from the start over which the course is known, s; later it stays as at the end"),
]

LAWS = ("time", "root", "logarithm")
Law = Annotated[
    Literal["time", "root", "logarithm"],
    Laws(LAWS),
    Field(
        description="powers of the time since the start; of its square root, as what diffuses; "
        "or of the logarithm of 1 + 100 times the part of span_s, as what ages"
    ),
]
PARTS = 100.0  # of the span, the first of which the logarithm begins with

AS_ANOTHER = 0.1  # of a sensor's change: nearer than that to another sensor it is that one

EventTime = Annotated[float, EventTimes(), Field(description="time of the jump, s since the survey's start")]
OneTime = Annotated[float, EventTimes(20), Field(description="begin or end of the part, s since the survey's start")]
OtherTime = Annotated[  # grids without a common time
    float, EventTimes(21, since="time_s"), Field(description="the other one, s")
]


def courses(x: Excitation, order: int, span_s: float, law: str = LAWS[0]) -> list[Array]:
    """Legendre polynomials 1 to `order` of time, or of what a law makes of it, from -1 at the start to 1 after span_s.

    Those of the logarithm follow a drift as log(1 + t / tau) for tau from a third to a thousandth of span_s to 3 % of
    its size or better with order 3.
    """
    part = np.clip(x.elapsed / span_s, 0.0, 1.0)
    if law == "root":
        part = np.sqrt(part)
    elif law == "logarithm":
        part = np.log1p(PARTS * part) / np.log1p(PARTS)
    u = 2.0 * part - 1.0
    return [np.polynomial.legendre.Legendre.basis(k)(u) for k in range(1, order + 1)]


@error_model(
    "instrument",
    source="zero drift of fluxgates",
    typical="some nT/h after switch-on, fluxgate zero drift",
    pointwise=True,
)
def offset_drift(x: Excitation, *, order: Order = 1, span_s: Span = 3600.0, law: Law = "time") -> Terms:
    """Each axis's offset drifts with time.

    Legendre polynomials of time, its square root or its logarithm over span_s: the coefficient of P1 is half the change
    from the start to the end. One coefficient an axis and order. A drift is not predicted beyond span_s. Rivals:
    whatever else changes steadily with time (`warm_up`, `temperature_offset`); `scale_drift` where the attitude hardly
    changes.
    """
    named = enumerate(courses(x, order, span_s, law), start=1)
    return joined([x.offsets(c, "nT", f"P{k} ") for k, c in named])


@error_model(
    "instrument",
    source="Yin and Luhr 2011 (CHAMP); Olsen et al. 2003 (Oersted)",
    typical="-79 ppm/yr (Swarm), as the logarithm of time (CHAMP) after launch",
    pointwise=True,
)
def scale_drift(
    x: Excitation, *, order: Order = 1, span_s: Span = 3600.0, law: Law = "time", of_field: OfField = False
) -> Terms:
    """Each axis's scale factor drifts with time.

    Legendre polynomials of time, its square root or its logarithm over span_s, times the axis's own output: the
    coefficient of P1 is half the change from the start to the end. Rivals: `reference_scale` where the total field
    changes steadily; `temperature_scale`.
    """
    named = enumerate(courses(x, order, span_s, law), start=1)
    return joined([x.scales(1e-6 * c, "ppm", f"P{k} ", of_field=of_field) for k, c in named])


@error_model("instrument", source="exponential settling", typical="a few nT over 15 min", pointwise=True)
def warm_up(
    x: Excitation,
    *,
    tau_s: Annotated[
        float,
        Range(0.02, 1.0, count=7, spacing="log", of_duration=True),
        Field(gt=0, description="time constant, s"),
    ] = 300.0,
) -> Terms:
    """Each axis's offset settles exponentially after the electronics were switched on.

    exp(-t / tau_s) with t from the survey's start; a switch-on before that only changes the coefficient, which is
    what is left at the start. Rivals: `offset_drift` where tau_s is not short against the survey,
    `temperature_offset` where the electronics' heat reaches the thermometer.
    """
    return x.offsets(np.exp(-x.elapsed / tau_s), "nT")


@error_model(
    "instrument",
    source="perming of fluxgate cores",
    typical="1 to 10 nT after a shock, or from one posture to the next",
    pointwise=True,
)
def offset_step(x: Excitation, *, time_s: EventTime = 0.0) -> Terms:
    """Each axis's offset jumps at a time: a core was magnetised by a shock, a connector touched.

    One coefficient an axis; several jumps are several models of this name. Rival: `offset_drift` for a jump in the
    middle of a short survey.
    """
    return x.offsets((x.elapsed >= time_s).astype(float), "nT")


@error_model(
    "instrument",
    source="two jumps of opposite sign",
    typical="13 000 nT from a small magnet at 3 cm; some nT from a tool or a telephone left on the platform",
    pointwise=True,
)
def offset_while(
    x: Excitation,
    *,
    time_s: OneTime = 0.0,
    until_s: OtherTime = 60.0,
) -> Terms:
    """Each axis's offset is another one between two times: a tool, a telephone or a magnet lay on the platform.

    One coefficient an axis. Rivals: `offset_step` where one of the two times is near an end of the survey;
    `latent_source` where it comes and goes more than once.
    """
    first, last = sorted((time_s, until_s))
    return x.offsets(((x.elapsed >= first) & (x.elapsed < last)).astype(float), "nT")


@error_model(
    "instrument",
    source="diagonal part of a jump of C",
    typical="5 nT for 100 ppm: a range switched, a feedback resistor or reference voltage that has changed",
    pointwise=True,
)
def scale_step(x: Excitation, *, time_s: EventTime = 0.0, of_field: OfField = False) -> Terms:
    """Each axis's scale factor jumps at a time: a range, a feedback resistor or a reference voltage changed.

    One coefficient an axis times its own output; several jumps are several models of this name. Rivals: `scale_drift`
    for a jump in the middle of a short survey, `offset_step` where the attitude hardly changes.
    """
    return x.scales(np.where(x.elapsed >= time_s, 1e-6, 0.0), "ppm", of_field=of_field)


def _in_whose_place(x: Excitation, settings: Mapping[str, Any], found: Mapping[tuple[str, str], float]) -> str:
    """Which sensors read from the time on what others had read before it."""
    strength = float(np.mean(np.linalg.norm(x.field_or_fields, axis=-1)))
    offset = x.output.mean(axis=0) - x.sensed(x.field_or_fields).mean(axis=0)
    before = {s: np.column_stack([strength * c, o]) for s, c, o in zip(x.sensors, x.matrix, offset, strict=True)}
    place = {}
    for sensor in dict.fromkeys(s for s, _ in found):
        change = np.eye(3) + 1e-6 * np.array([[found[sensor, a + b] for b in AXES] for a in AXES])
        after = change @ before[sensor]
        after[:, 3] += [found[sensor, a] for a in AXES]
        apart = {s: float(np.linalg.norm(after - each)) for s, each in before.items()}
        nearest = min(set(apart) - {sensor}, key=lambda s: apart[s], default=sensor)
        if apart[nearest] < AS_ANOTHER * apart[sensor]:
            place[sensor] = nearest
    pairs = [(s, t) for s, t in place.items() if place.get(t) == s and s < t]
    words = [f"{s} and {t} have changed places" for s, t in pairs]
    words += [f"{s} is what {t} was" for s, t in place.items() if place.get(t) != s]
    return f"from {round(settings['time_s'], 1):.7g} s on {', '.join(words)}" if words else ""


@error_model(
    "instrument",
    source="jump of C and o as a whole",
    typical="per mille to per cent: two sensors changed places, one was put back or replaced, an axis lost a turn",
    pointwise=True,
    means=_in_whose_place,
)
def calibration_step(
    x: Excitation,
    *,
    time_s: Annotated[float, EventTimes(20), Field(description="time of the change, s since the survey's start")] = 0.0,
) -> Terms:
    """Each sensor has another C and another offset from a time on: what reads it is another sensor, or it was changed.

    Twelve coefficients a sensor: what every axis shows more of the sensor's own three outputs, and a jump of its
    offset; it is exact however large the change is. Rivals, with fewer coefficients: `offset_step`, `scale_step`, and
    `turn_step` for turns so small that their square does not show.
    """
    since = (x.elapsed >= time_s).astype(float)
    return joined([x.offsets(since, "nT"), x.matrices(1e-6 * since[:, None, None] * x.output, "ppm")])
