"""Error models of the calibration site: real fields that are not the Earth's uniform one.

World frame as in `attitude`, which also tells the rotation between the platform's frame, in which positions are, and
the common one. They are modelled while calibrating and never taken off another survey's field.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from magtensor.calibration.types import Array
from magtensor.components import error_model
from magtensor.error_models.acting import AXES
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import EventTimes, Orders, Range
from magtensor.error_models.terms import Terms, joined
from magtensor.tensor.elements import COMPONENTS, NINE_OF_FIVE
from magtensor.tensor.geometry import field_polynomials, term_names

APART = 3.0  # times the usual mean square between the sensors: a field that differs among them
LEAST_MEANWHILE = 4  # samples that tell
MOST_OF_A_DEGREE = 3.0  # rms, over what lower degrees make
FEW = 500  # attitudes that tell how much that is


def _places(x: Excitation) -> Array:
    """(N, S, 3) m: the sensors in the world about the platform's origin."""
    if x.position is None:
        raise KeyError("the survey has no positions")
    out: Array = np.einsum("nki,si->nsk", x.world_axes, x.position)
    return out


def _seen(x: Excitation, world: Array) -> Array:
    """(N, S, 3) nT on the raw outputs of a field (N, S, 3) in the world frame."""
    turned = x.world_axes @ x.from_platform.T
    return x.sensed(world @ turned)


@error_model(
    "site",
    needs=("attitude", "position"),
    source="linear part of a harmonic potential; site of Li et al. 2018",
    typical="10 to 100 nT/m indoors; total field +-10 nT over the site of Li 2018",
    pointwise=True,
)
def site_gradient(x: Excitation) -> Terms:
    """The field at the site has a constant gradient: G R rho_i in the world frame, turned into the platform frame.

    Five coefficients for all sensors, xx, xy, xz, yy, yz in the world frame. The platform's origin is taken to stay in
    place. Rivals: `fixed_source`, which contains it, and `frame_flexure`.
    """
    places = _places(x)
    found = []
    for name, element in zip(COMPONENTS, NINE_OF_FIVE.T.reshape(5, 3, 3), strict=True):
        found.append(x.shared(_seen(x, places @ element), "nT/m", name))
    return joined(found)


def _falls_off(x: Excitation, settings: Mapping[str, Any], coefficients: Array, _: float) -> bool:
    """Whether the highest degree makes no more of the field at the sensors than three times what all lower ones make.

    Of a dipole at distance d the field of degree n is to that of degree n - 1 as (n + 1) r / ((n - 1) d) or less: at
    most twice as large for a source just outside the sensors' reach r, where the series ends to converge. A law of the
    attitude that is of high degree and nothing else is no source.
    """
    places = _places(x.at(np.arange(0, len(x.time), max(len(x.time) // FEW, 1))))
    fields = [np.zeros_like(places) for _ in range(2, int(settings["degree"]) + 1)]
    named = [(degree, name) for degree in range(2, len(fields) + 2) for name in term_names(degree)]
    for (degree, name), coefficient in zip(named, coefficients, strict=True):
        fields[degree - 2] += coefficient * _harmonic(name, places)
    *lower, highest = (float(np.sum(field**2)) for field in fields)
    return highest <= MOST_OF_A_DEGREE**2 * sum(lower)


@error_model(
    "site",
    needs=("attitude", "position"),
    agrees=_falls_off,
    source="harmonic potential about the centre of the rig",
    typical="10 to 100 nT/m indoors",
    pointwise=True,
)
def fixed_source(
    x: Excitation,
    *,
    degree: Annotated[
        int, Orders((3, 4)), Field(ge=2, le=4, description="highest degree of the harmonic potential")
    ] = 3,
) -> Terms:
    """A magnetic thing on the ground near the rig: its field about the rig's centre, as harmonic polynomials.

    Degree 2 is a gradient (`site_gradient`), degree 3 and 4 the curvature that a source within a few array sizes has.
    The constant vector of degree 1 is left out: it is part of the uniform field at the site. The coefficients, shared
    by all sensors, are the derivatives of the field in the world frame. Rivals: `site_gradient` for far sources,
    `frame_flexure`.
    """
    places = _places(x)
    units = {2: "nT/m", 3: "nT/m2", 4: "nT/m3"}
    return joined(
        [
            x.shared(_seen(x, _harmonic(name, places)), units[each], name)
            for each in range(2, degree + 1)
            for name in term_names(each)
        ]
    )


def _harmonic(name: str, places: Array) -> Array:
    """(N, S, 3) field of a harmonic term at places (N, S, 3) m."""
    out = np.zeros_like(places)
    for i, polynomial in enumerate(field_polynomials(name)):
        for powers, value in polynomial.items():
            product = np.full(places.shape[:2], value)
            for axis, power in enumerate(powers):
                for _ in range(power):  # many times quicker than a power of floating-point numbers
                    product *= places[..., axis]
            out[..., i] += product
    return out


def _or_at_the_station(x: Excitation, settings: Mapping[str, Any], _: Mapping[tuple[str, str], float]) -> str:
    """Where else it may have passed; or what tells that it did not: a gradient at the rig."""
    if settings.get("whole"):
        return ""
    if x.apart is not None:
        meanwhile = np.abs(x.elapsed - settings["time_s"]) < settings["passage_s"]
        least = APART * float(np.median(x.apart[~meanwhile])) if (~meanwhile).any() else np.inf
        if meanwhile.sum() >= LEAST_MEANWHILE and float(np.median(x.apart[meanwhile])) > least:
            return "the sensors differ meanwhile: it passed these"
    return "in |b| - F alone: it may have passed the base station instead"


@error_model(
    "site",
    source="dipole on a straight track: Anderson functions",
    typical="a car of 200 A m2: 20 nT at 10 m for some seconds",
    pointwise=True,
    means=_or_at_the_station,
)
def passing_source(
    x: Excitation,
    *,
    time_s: Annotated[
        float, EventTimes(100), Field(description="when it is nearest, s since the survey's start")
    ] = 0.0,
    passage_s: Annotated[
        float,
        Range(0.004, 0.04, count=3, spacing="log", of_duration=True),
        Field(gt=0, description="smallest distance over speed, s"),
    ] = 5.0,
    whole: Annotated[
        bool,
        Field(description="true: all components and its gradient, which needs attitude; false: along the field only"),
    ] = False,
) -> Terms:
    """A dipole that passes on a straight track, such as a vehicle.

    With u = (t - time_s) / passage_s its field is a combination of 1, u, u^2 over (1 + u^2)^(5/2) in every component,
    whatever the moment, the track and the distance; its gradient one of 1, u, u^2, u^3 over (1 + u^2)^(7/2). Of the
    field common to all sensors only the component along the Earth's shows beside a base station: three coefficients.
    With `whole` nine for the vector in the world and twenty for its gradient. Without it the same that passes the base
    station, with the other sign, is not told from it; nor is a base station that is restless for as long.
    """
    u = (x.elapsed - time_s) / passage_s
    dipole = [u**k / (1 + u**2) ** 2.5 for k in range(3)]
    if not whole:
        return joined([x.shared_sensing(f, x.direction, "nT", f"u{k}") for k, f in enumerate(dipole)])
    places = _places(x)
    patterns = [(AXES[i], "nT", np.broadcast_to(axis, x.output.shape), dipole) for i, axis in enumerate(np.eye(3))]
    steeper = [u**k / (1 + u**2) ** 3.5 for k in range(4)]
    for name, element in zip(COMPONENTS, NINE_OF_FIVE.T.reshape(5, 3, 3), strict=True):
        patterns.append((name, "nT/m", places @ element, steeper))
    return joined(
        [
            x.shared(f[:, None, None] * _seen(x, world), units, f"{name} u{k}")
            for name, units, world, shapes in patterns
            for k, f in enumerate(shapes)
        ]
    )
