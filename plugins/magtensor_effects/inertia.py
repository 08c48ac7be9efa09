"""Error models of rates and delays: what comes late, or follows the change of the field."""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from magtensor.calibration.types import Array
from magtensor.components import error_model
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import Beginning, Orders, Range
from magtensor.error_models.terms import Terms
from magtensor_effects.ageing import EventTime, Span

FieldAtStart = Annotated[
    float,
    Beginning("tau_s"),
    Field(
        description="by how much the field that the iron had followed exceeded the first sample's, platform frame, nT"
    ),
]


@error_model(
    "instrument",
    needs=("rotation",),
    source="the field at another instant; time shifts as in Alken (DMSP) and Styp-Rekowski et al. 2021 (GRACE-FO)",
    typical="25 nT for 1 ms at 0.5 rad/s in 50 000 nT",
)
def sampling_lag(
    x: Excitation,
    *,
    per_axis: Annotated[
        bool, Orders((False, True)), Field(description="true: a delay for each axis; false: one for each sensor")
    ] = False,
) -> Terms:
    """Each sensor, or each axis, is sampled late by a constant time.

    The coefficient is the delay; what it adds is, to first order, minus the output's rate of change. A delay common to
    all sensors is a rotation of the field and shows only against a reference. Rivals: `eddy_current`, which contains
    it; `bandwidth`.
    """
    return x.late(np.ones(len(x.time)), "s", "lag", per_axis=per_axis)


@error_model(
    "instrument",
    needs=("rotation",),
    source="Kotsiaros, Connerney and Martos 2020 (Juno); nine terms of Tolles and Lawson",
    typical="25 nT for a plate of time constant 1 ms at 0.5 rad/s",
)
def eddy_current(
    x: Excitation,
    *,
    tau_s: Annotated[
        float,
        Range(0.0, 0.5, count=4, spacing="log"),
        Field(ge=0, description="time constant of the conductor, s; 0 where the motion is too slow to show it"),
    ] = 0.0,
) -> Terms:
    """Conductors near a sensor shield the change of the field: minus dB/dt through a matrix of each sensor.

    The currents decay with L/R, and follow the change through a first-order lag of that time constant. Nine
    coefficients a sensor: coupling times time constant. The part common to all sensors is a rotation of the
    field and shows only against a reference. Rivals: `sampling_lag` and `bandwidth`, both contained in it;
    `viscous_magnetisation` with a short time constant.
    """
    return x.matrices(-x.relaxed(x.rate, tau_s), "s")


@error_model(
    "instrument", needs=("rotation",), source="first-order low-pass filter", typical="a ms between axes; small"
)
def bandwidth(
    x: Excitation,
    *,
    tau_s: Annotated[
        float,
        Range(1e-3, 3.0, count=6, spacing="log"),
        Field(gt=0, description="time constant that shapes the response, s"),
    ] = 1e-3,
) -> Terms:
    """Each axis is a low-pass filter of its own.

    A filter of time constant tau_s adds -tau_s times its own answer to the output's rate of change; the coefficient
    is the time constant found. To first order that is a delay, so `sampling_lag` is its rival wherever tau_s is short
    against the motion. What all axes have in common is then a rotation of the field and stays zero; how much it is
    shortened is told by `averaging`.
    """
    return x.responses(-x.sensed(x.relaxed(x.rate, tau_s)), "s")


@error_model(
    "instrument",
    needs=("rotation",),
    source="the field at another instant",
    typical="one sampling interval: 2500 nT for 0.1 s at 0.5 rad/s",
)
def lag_step(x: Excitation, *, time_s: EventTime = 0.0, span_s: Span = 3600.0) -> Terms:
    """A sensor's samples come late, or early, from a time on: its stream has lost a sample, or holds one twice.

    One coefficient a sensor, the delay; several slips are several models of this name. Recorders begin in step again,
    so the slip is none beyond span_s. Rivals: `sampling_lag` for a slip near the beginning, `clock_drift` for many.
    """
    return x.late(((x.elapsed >= time_s) & (x.elapsed <= span_s)).astype(float), "s", "lag")


def _shortens(_: Excitation, __: Mapping[str, Any], coefficients: Array, ___: float) -> bool:
    """A mean is shorter than what it is made of, in every sensor if each has a coefficient."""
    return bool((coefficients > 0).all())


@error_model(
    "instrument",
    needs=("rotation", "total_field"),
    agrees=_shortens,
    source="Taylor series of a running mean",
    typical="a mean over 0.1 s at 0.7 rad/s is 10 nT too short in 50 000 nT; any recorder's low-pass does the same",
)
def averaging(
    x: Excitation,
    *,
    per_sensor: Annotated[
        bool, Orders((False, True)), Field(description="true: each sensor its own; false: one for all")
    ] = False,
) -> Terms:
    """A row is the mean over some time, or was low-passed, and the mean of a vector that turns is too short.

    The second rate of change of the output. The coefficient is half the variance of what a row is averaged with: of a
    mean over T, T^2 / 24; of a pole of time constant tau, tau^2 / 2. What the mean is late by shows as a delay, if it
    differs between sensors. Rivals: `bandwidth` of all axes alike; `sampling_lag` and `eddy_current` of a long time.
    """
    bent = x.sensed(x.curvature)
    return x.one_each(bent, "s2", "spread") if per_sensor else x.shared(bent, "s2", "spread")


@error_model(
    "instrument",
    needs=("rotation",),
    source="the field at another instant",
    typical="1 ppm over 1 h is 3.6 ms, 90 nT at 0.5 rad/s",
)
def clock_drift(x: Excitation) -> Terms:
    """Each sensor's logger has a clock of its own that runs fast: a sample stamped t was taken at t (1 + drift).

    A delay in proportion to the time since the start; one coefficient a sensor. A drift common to all
    sensors shows only against a reference.
    """
    return x.late(-1e-6 * x.elapsed, "ppm", "drift")


@error_model(
    "instrument",
    needs=("turning",),
    source="Debye relaxation of the magnetisation",
    typical="some 100 ppm of the field beside steel; rarely known",
)
def viscous_magnetisation(
    x: Excitation,
    *,
    tau_s: Annotated[
        float,
        Range(0.5, 500.0, count=7, spacing="log", sampled=True),
        Field(gt=0, description="time constant of the magnetisation, s"),
    ] = 20.0,
    at_start_x_nT: FieldAtStart = 0.0,
    at_start_y_nT: FieldAtStart = 0.0,
    at_start_z_nT: FieldAtStart = 0.0,
) -> Terms:
    """Iron whose magnetisation follows the field late.

    The field through a first-order lag, minus the field, through a matrix of each sensor: nine coefficients, as
    fractions of the field. Before the survey the rig may have stood otherwise, and the iron come from there; between
    recordings the field is taken to change steadily. Rivals: `eddy_current` for short time constants, `hysteresis`.
    """
    b = x.field_or_fields
    before = np.stack([x.dying(tau_s, each) for each in (at_start_x_nT, at_start_y_nT, at_start_z_nT)], axis=-1)
    late = x.lagged(b, tau_s) + before.reshape(len(before), *[1] * (b.ndim - 2), 3)
    return x.matrices(1e-6 * (late - b), "ppm")
