"""From a survey to the samples and channels that the loop works on."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from magtensor.attitude import continuous
from magtensor.between_readings import COURSES
from magtensor.calibration.types import Array
from magtensor.error_models.held_logs import LEAST_HELD, LEAST_READINGS
from magtensor.error_models.quiet import quieted
from magtensor.error_models.station import Station
from magtensor.errors import NotEnoughData
from magtensor.loop.fitting.model import Record
from magtensor.survey.model import Survey
from magtensor.survey.recorded_numbers import resolution
from magtensor.survey.reference import spikes
from magtensor.units import CURRENT, TEMPERATURE, UNITS

NOT_CHANNELS = (
    "time", "sensor", "axis", "b_raw", "position", "good", "segment", "attitude", "quaternion", "total_field",
    "total_field_std", "diurnal",
)  # fmt: skip
CLEARANCE = 10.0  # the reference's noise is in the residual too: what held it would seem to explain it
GAP = 5.0  # median steps: a longer one begins a new run
FURTHER_APART = 1.5  # median steps of the base station
FEW = 0.05  # of the samples
MOSTLY = 0.5  # of the samples: a channel that is known at fewer is not searched


def record_of(
    survey: Survey,
    origins: Mapping[str, Array] | None = None,
    *,
    every: bool = False,
    use: NDArray[np.bool_] | None = None,
) -> Record:
    """The samples of a survey that may be used, with its logged channels.

    Args:
        survey: with `b_raw` and, where there is one, `total_field`.
        origins: what to take off each channel (a stored calibration's); this survey's own if None.
        every: all samples, flagged or not, as a correction needs; else those a fit may use.
        use: (N,) those samples, where a fit of several surveys has chosen them. Channels that never change are then
            kept: another survey may hold another value.

    Raises:
        NotEnoughData: no samples are left in use, and neither all nor chosen ones were asked for.
    """
    raw = np.asarray(survey.values("b_raw"), dtype=float)
    time = survey.time
    total_field = np.asarray(survey.values("total_field"), dtype=float) if "total_field" in survey else None
    station = _station(survey)
    steady = every or use is not None
    if use is None and every:
        use = np.ones(len(time), dtype=bool)
    elif use is None:
        use = survey.readings & np.isfinite(raw).all(axis=(1, 2))
        if total_field is not None:
            use &= np.isfinite(total_field)
            use = _where_read(use, time, station)
    logged, units = channels_of(survey)
    absent = []
    attitude, known = _attitude(survey)
    if attitude is not None and known[use].sum() < MOSTLY * use.sum():
        attitude = None
        absent.append("attitude")
    elif not steady and (~known)[use].sum() <= FEW * use.sum():
        use &= known
    for name, values in list(logged.items()):
        finite = np.asarray(np.isfinite(values.reshape(len(values), -1)).all(axis=1))
        if not finite.all():
            if _known(time, finite)[use].sum() < MOSTLY * max(use.sum(), 1):
                absent.append(name)
                del logged[name]
            else:
                logged[name] = _filled(time, values, finite)
    keep = np.flatnonzero(use)
    if not steady and len(keep) < 2:
        needed = "readings of all sensors" + " and a total field" * (total_field is not None)
        raise NotEnoughData(f"no samples with {needed} are left in use", where=str(survey.attributes.get("source", "")))
    if origins is None:
        origins = {name: origin(values[keep], units[name]) for name, values in logged.items()}
    centred = {name: values - origins[name] for name, values in logged.items() if name in origins}
    if not steady:  # what never changes says nothing
        centred = {n: v for n, v in centred.items() if np.ptp(v[keep], axis=0).max(initial=0.0) > 0}
    segment = np.asarray(survey.values("segment"), dtype=int) if "segment" in survey else np.zeros(len(time), dtype=int)
    whole = Record(
        time=time,
        start=float(time[0]),
        raw=raw,
        total_field=total_field,
        quiet_field=_quiet(station, time, total_field),
        station=None if total_field is None else station,
        sensors=tuple(survey.sensors),
        logged=centred,
        origins={n: origins[n] for n in centred},
        units={n: units[n] for n in centred},
        run=runs(time, segment),
        segment=segment,
        position=np.asarray(survey.values("position"), dtype=float) if "position" in survey else None,
        attitude=attitude,
        samples=np.arange(len(time)),
        absent=tuple(absent),
        readings=survey.readings_by_sensor if every else None,
    )
    return whole if len(keep) == len(time) else whole.at(keep)


def origin(values: Array, units: str) -> Array:
    """What is taken off a channel (N, ...), (...): zero where it has one of its own, else the mean.

    Heat goes with the square of a current, not with that of its excess over the mean; and what goes both ways is zero
    in between. A temperature's zero is a convention.
    """
    mean, known = values.mean(axis=0), UNITS.get(units)
    dimension = "" if known is None else known.dimension
    if dimension == TEMPERATURE:
        return np.asarray(mean)
    both_ways = (values.min(axis=0) <= 0.0) & (values.max(axis=0) >= 0.0)
    return np.where((dimension == CURRENT) | both_ways, 0.0, mean)


def channels_of(survey: Survey) -> tuple[dict[str, Array], dict[str, str]]:
    """Every logged numeric channel (N,), (N, S) or (N, 3) and its units."""
    count, sensors = len(survey.time), len(survey.sensors)
    values: dict[str, Array] = {}
    units: dict[str, str] = {}
    for path in survey.paths():
        if "/" in path or path in NOT_CHANNELS:
            continue
        variable = survey[path]
        if variable.dtype.kind not in "iufb" or variable.shape not in ((count,), (count, sensors), (count, 3)):
            continue
        if variable.dims[0] != "time":
            continue
        values[path] = np.asarray(variable.values, dtype=float)
        units[path] = str(variable.attrs.get("units", ""))
    return values, units


def runs(time: Array, segment: NDArray[np.int_]) -> NDArray[np.int_]:
    """(N,) number of the contiguous run each sample belongs to."""
    if len(time) < 2:
        return np.zeros(len(time), dtype=int)
    step = np.diff(time)
    breaks = (step > GAP * np.median(step)) | (np.diff(segment) != 0)
    return np.concatenate([[0], np.cumsum(breaks)])


def _station(survey: Survey) -> Station | None:
    """The base station's readings without their noise; None where the survey holds none."""
    if not {"total_field", "reference/total_field", "reference/time"} <= set(survey.paths()):
        return None
    at = np.asarray(survey.values("reference/time"), dtype=float)
    values = np.asarray(survey.values("reference/total_field"), dtype=float)
    known = np.isfinite(at) & np.isfinite(values)
    if known.sum() < 2:
        return None
    at, values = at[known], values[known]
    made = survey["total_field"].attrs
    if "despike" in made:
        good = ~spikes(values, float(made["despike"]), at)
        at, values = at[good], values[good]
    at = at - float(made.get("latency_s", 0.0))
    how = made.get("interpolation")
    return Station(at, quieted(values, CLEARANCE, resolution(values)), how if how in COURSES else "linear")


def _where_read(use: NDArray[np.bool_], time: Array, station: Station | None) -> NDArray[np.bool_]:
    """Without the samples between two readings of the base station that are further apart than usual, where these are
    few: what the field did there, in all sensors alike, would look like something that passed."""
    if station is None:
        return use
    gap = station.between(time)
    between = (gap.apart_s > FURTHER_APART * station.step_s) & (gap.share > 0.0) & (gap.share < 1.0)
    return use & ~between if between[use].sum() <= FEW * use.sum() else use


def _quiet(station: Station | None, time: Array, total_field: Array | None) -> Array | None:
    """The total field without the base station's own noise, at the survey's times."""
    if total_field is None or station is None:
        return total_field
    return np.where(np.isfinite(total_field), station.at(time), np.nan)


def _attitude(survey: Survey) -> tuple[Array | None, NDArray[np.bool_]]:
    """Quaternions (N, 4), and whether each is known (N,): between two that are, what lies between them stands in."""
    time = survey.time
    if "attitude" not in survey:
        return None, np.ones(len(time), dtype=bool)
    values = np.asarray(survey.values("attitude"), dtype=float)
    finite: NDArray[np.bool_] = np.asarray(np.linalg.norm(np.nan_to_num(values), axis=1) > 0)
    finite &= np.isfinite(values).all(axis=1)
    if finite.all() or not finite.any():
        return values, finite
    read = continuous(values[finite])
    filled = np.column_stack([np.interp(time, time[finite], column) for column in read.T])
    filled /= np.linalg.norm(filled, axis=1, keepdims=True)
    return np.where(finite[:, None], values, filled), _known(time, finite)


def _known(time: Array, finite: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) whether a channel that is missing at some samples is known at each: read there, or at the usual interval
    around it; at none where that is too seldom for a course."""
    at = time[finite]
    if len(at) < LEAST_READINGS:
        return np.zeros(len(time), dtype=bool)
    edges = np.concatenate([[-np.inf], at, [np.inf]])
    after = np.clip(np.searchsorted(edges, time), 1, len(edges) - 1)
    nearest = np.minimum(time - edges[after - 1], edges[after] - time)
    return finite | (nearest <= np.median(np.diff(at)))


def _filled(time: Array, values: Array, finite: NDArray[np.bool_]) -> Array:
    """Missing values of a channel from their neighbours in time; of one that is read seldom the last reading, as a log
    that is written with every sample holds it."""
    flat = values.reshape(len(values), -1)
    if finite.sum() * LEAST_HELD <= len(values):
        last = np.maximum.accumulate(np.where(finite, np.arange(len(values)), np.argmax(finite)))
        return flat[last].reshape(values.shape)
    out = np.column_stack([np.interp(time, time[finite], column[finite]) for column in flat.T])
    return out.reshape(values.shape)
