"""Error models of the reference total field: base station, its clock, its place."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from magtensor.calibration.types import Array
from magtensor.components import error_model
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.independent import independent
from magtensor.error_models.settings import Delays
from magtensor.error_models.terms import Terms, joined
from magtensor_effects.ageing import EventTime, Law, OneTime, Order, OtherTime, Span, courses

MOST_EXCESS = 0.75  # of the recorded variation: four times that of the site
BY_CHANCE = 0.01  # probability; noise that is as strong as the variation is rare by itself
LEAST_FREEDOM = 3.0  # of a steady variation none is left, and a drift of the base station is its rival
NEARBY_S = 2.0  # shorter delays show as the slope over this time
LONGEST_S = 7200.0  # two time zones
BETWEEN_NOISE_AND_DELAY = 0.75  # of the lag: half of it is what noise makes, all of it a delay
AS_RESTLESS = 0.25  # times the size of the recorded variation, at least, that of the readings which would be right


def _more_than_noise(x: Excitation, _: Mapping[str, Any], coefficients: Array, explained: float) -> bool:
    """Whether an excess of the recorded variation, or a lack, explains more than noise of the base station would.

    Noise w beside a variation v is recorded and not seen at the site: the excess is fitted as k = w^2 / (v^2 + w^2) and
    explains the share k of the residual, which is w, whatever the weights; a true excess explains all that is not of
    the sensors. Half way between is sqrt(k), and twice the share is beyond the chance likeness of v and w; near 1 the
    two are one. Where both are slow chance makes them alike or opposite, and k negative if opposite: k and the share
    say how much w would be correlated with v, and that has to be beyond what it is between courses of so few
    independent values.
    """
    excess = 0.01 * float(coefficients[0])
    if explained <= 0.0 or excess >= MOST_EXCESS:
        return False
    if excess > 0.0 and explained <= min(np.sqrt(excess), 2.0 * excess):
        return False
    return explained >= 1.0 or abs(_correlation_of_noise(excess, explained)) > _by_chance(independent(x.reference))


def _correlation_of_noise(excess: float, explained: float) -> float:
    """Between noise of the base station and the variation, if that were all that the excess is."""
    noise = excess**2 / explained  # its variance and that of the variation, in units of the recorded variation's
    variation = 1.0 - 2.0 * excess + noise
    return float((excess - noise) / np.sqrt(max(noise * variation, 1e-300)))


def _by_chance(independent_values: float) -> float:
    """A correlation that so many independent values have by chance with a probability `BY_CHANCE`."""
    from scipy.special import stdtrit

    freedom = max(independent_values - 2.0, LEAST_FREEDOM)
    t = float(stdtrit(freedom, 1.0 - BY_CHANCE))
    return t / float(np.hypot(t, np.sqrt(freedom)))


@error_model(
    "reference",
    needs=("base_station",),
    agrees=_more_than_noise,
    source="spatial change of the diurnal variation",
    typical="0.1 to 1 nT; some per cent of the variation over tens of km or beside a coast",
)
def reference_scale(x: Excitation) -> Terms:
    """The variation at the base station is larger or smaller than at the site.

    The total field about its mean; the coefficient is the part of the recorded variation that the site does not see.
    Common to all sensors, so the tensor does not feel it. A constant difference between the base station and the site
    that nobody took off does the same: it passes for a scale factor of all sensors, and 500 nT of 50 000 nT for 1 % of
    the variation. Rival: `scale_drift` where the variation is steady.
    """
    f = x.reference
    return x.on_reference(0.01 * (f - f.mean()), "%", "excess")


def _delayed_by_its_lag(x: Excitation, settings: Mapping[str, Any], coefficients: Array, _: float) -> bool:
    """Whether the delay is the lag that the difference was taken over, and the readings that would be right vary too.

    Noise of the base station, slow or fast, seems to be explained by half of that difference, for it is in both. What
    disturbs the station for a while is in one of the two: readings of a quiet time in its place take all of it off, as
    leaving them out would, and tell nothing of a clock.
    """
    lag = float(settings["lag_s"])
    if abs(lag) < NEARBY_S:
        return True
    read = (x.time + lag >= x.readings.time[0]) & (x.time + lag <= x.readings.time[-1])
    if not read.any() or coefficients[0] / lag <= BETWEEN_NOISE_AND_DELAY:
        return False
    recorded, right = x.readings.at(x.time[read]), x.readings.at(x.time[read] + lag)
    return bool(np.std(right) >= AS_RESTLESS * np.std(recorded))


def _about_its_delay(settings: Mapping[str, Any], coefficients: Array) -> dict[str, Any]:
    return {**settings, "lag_s": float(np.clip(coefficients[0], -LONGEST_S, LONGEST_S))}


@error_model(
    "reference",
    needs=("base_station",),
    agrees=_delayed_by_its_lag,
    about=_about_its_delay,
    source="shift in time",
    typical="a leap second, a time zone, or the station's own filter; 0.1 nT for 1 s in a 10 nT pulsation of 10 min",
)
def reference_clock(
    x: Excitation,
    *,
    lag_s: Annotated[
        float,
        Delays(-LONGEST_S, LONGEST_S, count=17),
        Field(description="delay about which it is linear, s: positive where the stamps are late"),
    ] = 0.0,
) -> Terms:
    """The base station's time stamps are late or early.

    A reading stamped t was taken at t - d, so that F(t + d) would be right at t: the recorded F(t) minus F(t + lag_s),
    over lag_s; the coefficient is the delay d. Beyond the station's own readings the field is held. Shows on active
    days only.
    """
    begin, end = (0.0, lag_s) if abs(lag_s) >= NEARBY_S else (-NEARBY_S / 2, NEARBY_S / 2)
    earlier, later = x.readings.at(x.time + begin), x.readings.at(x.time + end)
    return x.on_reference((earlier - later) / (end - begin), "s", "delay")


@error_model(
    "reference",
    needs=("base_station",),
    source="drift of the base station",
    typical="below 1 nT a day for a proton magnetometer, some nT in an hour where its place or its sensor warms up",
    pointwise=True,
)
def reference_drift(x: Excitation, *, order: Order = 1, span_s: Span = 3600.0, law: Law = "time") -> Terms:
    """The base station's total field drifts.

    Legendre polynomials of time, its square root or its logarithm over span_s, less their values at the start, when the
    station is taken to be right: the coefficient of P1 is half the change from the start to the end. Common to all
    sensors, so the tensor does not feel it. Rival: `scale_drift` with one course for all axes of all sensors, which
    nothing but another reference would tell from it.
    """
    named = enumerate(courses(x, order, span_s, law), start=1)
    return joined([x.on_reference(course - (-1.0) ** k, "nT", f"P{k}") for k, course in named])


def _or_at_the_site(x: Excitation, _: Mapping[str, Any], __: Mapping[tuple[str, str], float]) -> str:
    """Where else something magnetic may have been put, or taken away: where all sensors see it alike."""
    return "in |b| - F alone: it may have happened at the site instead"


@error_model(
    "reference",
    needs=("base_station",),
    source="shift in level",
    typical="any: the station's new place",
    pointwise=True,
    means=_or_at_the_site,
)
def reference_step(x: Excitation, *, time_s: EventTime = 0.0) -> Terms:
    """The base station was moved or retuned: its total field jumps at a time.

    One coefficient; the jump lies between two of the station's readings, and the field in between is interpolated.
    Rival: a jump of all scale factors, which nothing else would tell from it.
    """
    since = (x.readings.time - x.start >= time_s).astype(float)
    return x.on_reference(replace(x.readings, field=since).at(x.time), "nT", "step")


@error_model(
    "reference",
    needs=("base_station",),
    source="two shifts in level of opposite sign",
    typical="some nT: a car parked beside the station, a tool left at its sensor, a sensor moved and put back",
    pointwise=True,
    means=_or_at_the_site,
)
def reference_while(x: Excitation, *, time_s: OneTime = 0.0, until_s: OtherTime = 60.0) -> Terms:
    """The base station's level is another one between two times: something magnetic stood beside it.

    One coefficient; each of the two jumps lies between two of the station's readings, as that of `reference_step`.
    Rivals: `reference_step` where one of the two times is near an end of the survey; `passing_source` for a short
    time.
    """
    first, last = sorted((time_s, until_s))
    since = x.readings.time - x.start
    during = ((since >= first) & (since < last)).astype(float)
    return x.on_reference(replace(x.readings, field=during).at(x.time), "nT", "shift")
