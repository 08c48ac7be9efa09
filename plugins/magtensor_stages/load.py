"""The stage that reads the survey and refuses what cannot be used."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magtensor.components import stage
from magtensor.errors import DataError, NotEnoughData, UsageError, did_you_mean
from magtensor.survey import checks, recorded_numbers, repeated, time_base
from magtensor.survey.flags import Flag, flag_ranges
from magtensor.survey.lone_readings import lone_readings
from magtensor.survey.model import AXES, Survey
from magtensor.units import TEMPERATURE, UNITS, convert
from magtensor_stages.faults import refuse_faults

BY = "load"
LEFT_BEHIND = "repeats its reading while other sensors go on"
_READ_TOGETHER = 0.5  # of the readings of the sensor that has the fewest


@stage(
    gives=("time", "sensor", "axis", "b_raw", "good"),
    may_give=(
        "position", "reference/time", "reference/total_field", "reference/world_field", "temperature", "current_*",
        "acceleration", "angular_rate", "attitude", "segment", "is_reading",
    ),
)  # fmt: skip
def load(
    survey: Survey,
    *,
    sensors: Annotated[
        tuple[str, ...] | None, Field(min_length=1, description="use only these sensors; default: all")
    ] = None,
    window_s: Annotated[
        tuple[float, float] | None, Field(description="use only this span, s after the first sample")
    ] = None,
    time_faults: Annotated[
        Literal["refuse", "drop"],
        Field(description="samples whose time repeats, steps back or is missing: refuse the survey, or drop them"),
    ] = "refuse",
    magnitude: Annotated[
        Literal["refuse", "accept"],
        Field(description="a field that cannot be the Earth's (wrong units, missing base values)"),
    ] = "refuse",
    copied_axes: Annotated[
        Literal["refuse", "accept"], Field(description="two axes that hold the same numbers")
    ] = "refuse",
    copied_rows: Annotated[
        Literal["refuse", "accept"], Field(description="a stretch whose readings are those of another stretch")
    ] = "refuse",
    saturation_nT: Annotated[
        float | None, Field(gt=0, description="end of the sensors' range, nT; default: found from the data")
    ] = None,
    max_flagged_share: Annotated[
        float, Field(gt=0, lt=1, description="refuse a sensor of which a larger share of samples is flagged")
    ] = 0.5,
) -> Survey:
    """Read the survey, check it, and flag the samples that cannot be used.

    Refused: times that do not increase, an axis without signal, a sensor that is stuck, two axes or two stretches with
    the same numbers, magnitudes that betray wrong units, more flagged samples than allowed. Flagged: missing and
    infinite values, saturation, runs in which a sensor repeats itself, rows in which one does now and then while others
    go on. No calibration is fitted to rows that repeat a reading or lie on the line between two, in a recording faster
    than its sensors. Reported with the variables: sampling, quantisation.
    """
    if survey.source is None:
        raise UsageError("load: the recipe has no `survey` section, and no survey was named on the command line")
    found = survey.source.read()
    where = str(found.attributes.get("source", ""))
    notes = list(found.attributes.get("notes", ()))
    found = _increasing(found, time_faults, where, notes)
    found = _reference_times(found, time_faults, where, notes)
    if sensors is not None:
        found = _only_sensors(found, sensors, where)
    if window_s is not None:
        found = _only_window(found, window_s, where)
    if len(found.time) < 2:
        raise NotEnoughData("a single sample is no survey", where=where)
    found = _without_fill_values(found, notes)
    found = _without_lone_readings(found, notes)
    found, impossible = _without_impossible(found)
    refuse_faults(found, magnitude == "refuse", copied_axes == "refuse", copied_rows == "refuse", where)
    _judge_position(found, magnitude, where, notes)
    if magnitude == "refuse":
        _refuse_cold(found, where)
    good, flags = _flagged(found, impossible, saturation_nT)
    share = 1.0 - good.mean(axis=0)
    for name, bad in zip(found.sensors, share, strict=True):
        if bad > max_flagged_share:
            reasons = sorted({f.reason for f in (*found.flags, *flags) if f.sensor == name})
            raise DataError(
                f"{100 * bad:.0f} % of its samples cannot be used: {'; '.join(reasons)}",
                where=f"{where}: sensor {name}",
                hint=f"load allows max_flagged_share {max_flagged_share:g}; `sensors` can leave the sensor out",
            )
    given = _readings(found, notes)
    if "is_reading" in given:
        late = repeated.left_behind(found.values("b_raw"), given["is_reading"][1])
        for s, name in enumerate(found.sensors):
            flags += flag_ranges(found.time, late[:, s] & good[:, s], by=BY, reason=LEFT_BEHIND, sensor=name)
        good = good & ~late
    attributes = {**found.attributes, **({"notes": notes} if notes else {})}
    loaded = replace(found, attributes=attributes, source=survey.source)
    given["good"] = (("time", "sensor"), good, {"long_name": "may be used"})
    return loaded.merged({**_described(loaded), **given}, flags)


MOST_FAULTS = 0.5  # of the times: with more it is no clock with faults


def _clock(seconds: float) -> str:
    return f"t = {seconds:.3f} s"


def _increasing(survey: Survey, time_faults: str, where: str, notes: list[str]) -> Survey:
    time = survey.time
    onward = time_base.moves_on(time)
    if onward.all():
        return survey
    first = int(np.flatnonzero(~onward)[0])
    if not onward.any():
        raise DataError("no time is a number", where=f"{where}: time")
    before = float(time[:first][np.isfinite(time[:first])][-1]) if first else np.nan
    now = float(time[first])
    if not np.isfinite(now):
        what = f"the time of sample {first} is missing"
    elif now > before or not first:
        what = f"the time of sample {first}, {_clock(now)}, is later than times after it"
    elif now == before:
        what = f"sample {first} has the same time as the one before, {_clock(now)}"
    else:
        what = f"the clock steps back at sample {first}, from {_clock(before)} to {_clock(now)}"
    count = int((~onward).sum())
    if count > MOST_FAULTS * len(time):
        backwards = bool(np.all(np.diff(time[np.isfinite(time)]) <= 0))
        raise DataError(
            "the times run backwards" if backwards else f"{what}; {count} samples of {len(time)} do not move on",
            where=f"{where}: time",
            hint="no survey is left without so many: sort the rows by time, or look whether the clock was read right",
        )
    if time_faults == "refuse":
        raise DataError(
            f"{what}; {count} sample{'s' * (count > 1)} of {len(time)} do not move on",
            where=f"{where}: time",
            hint="`load: {time_faults: drop}` leaves them out",
        )
    notes.append(f"{count} samples left out whose time does not move on; {what}")
    return _rows(survey, onward)


def _reference_times(survey: Survey, time_faults: str, where: str, notes: list[str]) -> Survey:
    """Reference samples without a value go, and those that repeat a reading; those whose time does not move on are
    refused or go."""
    if "reference/total_field" not in survey:
        return survey
    time = np.asarray(survey.values("reference/time"), dtype=np.float64)
    values = survey.values("reference/total_field")
    known = np.isfinite(values)
    if not known.any():
        raise DataError("every value is missing", where=f"{where}: reference/total_field")
    if np.median(values[known]) > 0:
        known &= values > 0  # a proton magnetometer without a signal writes zero
    onward = time_base.moves_on(time[known])
    if not onward.all():
        at = int(np.flatnonzero(known)[np.flatnonzero(~onward)[0]])
        what = f"the time of the reference's sample {at}, {_clock(float(time[at]))}, does not move on"
        if time_faults == "refuse":
            raise DataError(
                what, where=f"{where}: reference/time", hint="`load: {time_faults: drop}` leaves such samples out"
            )
        notes.append(f"{int((~onward).sum())} reference samples left out; {what}")
    keep = np.flatnonzero(known)[onward]
    held = repeated.held_readings(time[keep], values[keep])
    if not known.all():
        notes.append(f"{int((~known).sum())} of {len(time)} reference samples have no value and are left out")
    if held is not None:
        readings, period = held
        notes.append(
            f"{int((~readings).sum())} of {len(keep)} reference samples repeat a reading, of which there is one every "
            f"{period:.4g} s: they are left out, and the field in between is interpolated"
        )
        keep = keep[readings]
    if len(keep) == len(time):
        return survey
    return _select(survey, "reference", {"time": keep})


def _select(survey: Survey, node: str, indexers: dict[str, Any]) -> Survey:
    import xarray as xr

    nodes = {name: child.to_dataset() for name, child in survey.tree.children.items()}
    nodes[node] = nodes[node].isel(indexers)
    return replace(survey, tree=xr.DataTree.from_dict({f"/{n}": d for n, d in nodes.items()}))


def _rows(survey: Survey, keep: NDArray[np.bool_]) -> Survey:
    return _select(survey, "array", {"time": np.flatnonzero(keep)})


def _only_sensors(survey: Survey, wanted: tuple[str, ...], where: str) -> Survey:
    for name in wanted:
        if name not in survey.sensors:
            raise DataError(
                f"there is no sensor {name}{did_you_mean(name, survey.sensors)}",
                where=where,
                hint=f"the survey has {', '.join(survey.sensors)}",
            )
    cut = _select(survey, "array", {"sensor": [survey.sensors.index(n) for n in wanted]})
    return replace(cut, flags=tuple(f for f in cut.flags if f.sensor in ("", *wanted)))


def _only_window(survey: Survey, window_s: tuple[float, float], where: str) -> Survey:
    since_start = survey.time - survey.time[0]
    keep = (since_start >= window_s[0]) & (since_start <= window_s[1])
    if keep.sum() < 2:
        raise NotEnoughData(
            f"fewer than two samples between {window_s[0]:g} and {window_s[1]:g} s after the first",
            where=f"{where}: time",
            hint=f"the survey lasts {since_start[-1]:g} s",
        )
    cut = _rows(survey, keep)
    first, last = cut.time[0], cut.time[-1]
    return replace(cut, flags=tuple(f for f in cut.flags if f.stop >= first and f.start <= last))


def _without_fill_values(survey: Survey, notes: list[str]) -> Survey:
    """The survey with numbers that stand for missing values in logged channels, undeclared, made missing."""
    from magtensor.loop.fitting.record import channels_of

    filled: dict[str, Any] = {}
    for name, values in channels_of(survey)[0].items():
        left = np.where(np.isinf(values), np.nan, values)
        if infinite := int(np.isinf(values).sum()):
            notes.append(f"{name}: {infinite} infinite values are taken for missing ones")
        while (found := checks.fill_value(left)) is not None:
            count = int((left == found).sum())
            notes.append(f"{name}: {count} values of {found:.6g}, far from all others, are taken for missing ones")
            left = np.where(left == found, np.nan, left)
        if not np.array_equal(left, values, equal_nan=True):
            filled[name] = (tuple(survey[name].dims), left, survey[name].attrs)
    return survey.merged(filled) if filled else survey


def _without_lone_readings(survey: Survey, notes: list[str]) -> Survey:
    """The survey with readings of logged channels that cannot be made missing; vectors, which feel a shock, as read."""
    from magtensor.loop.fitting.record import channels_of

    kept: dict[str, Any] = {}
    logged, units = channels_of(survey)
    for name, values in logged.items():
        if "axis" in survey[name].dims:
            continue
        known = UNITS.get(units[name])
        found = lone_readings(values, slow=known is not None and known.dimension == TEMPERATURE)
        if found.any():
            seen = np.unique(values[found])
            which = f"{seen[0]:.6g}" if len(seen) == 1 else f"{seen[0]:.6g} to {seen[-1]:.6g}"
            notes.append(
                f"{name}: {found.sum()} values ({which}), alone and far from all others, are taken for missing"
            )
            variable = survey[name]
            kept[name] = (tuple(variable.dims), np.where(found, np.nan, values), variable.attrs)
    return survey.merged(kept) if kept else survey


def _without_impossible(survey: Survey) -> tuple[Survey, dict[str, NDArray[np.bool_]]]:
    """The survey with infinite and impossible values made missing, and where (N, S) they were, by reason.

    They carry nothing that could be kept: one of them makes a mean or a square infinite.
    """
    field = survey.values("b_raw")
    infinite, impossible = np.isinf(field), checks.impossible(field)
    found = {"infinite value": infinite.any(axis=2), "impossible value": impossible.any(axis=2)}
    if not (infinite.any() or impossible.any()):
        return survey, found
    values = np.where(infinite | impossible, np.nan, field)
    return survey.merged({"b_raw": (("time", "sensor", "axis"), values, survey["b_raw"].attrs)}), found


def _judge_position(survey: Survey, magnitude: str, where: str, notes: list[str]) -> None:
    """Refuse positions that are no numbers, or farther apart than a rigid array is; note sensors that share a place."""
    if "position" not in survey:
        return
    position = np.asarray(survey.values("position"), dtype=np.float64)
    if unplaced := [s for s, p in zip(survey.sensors, position, strict=True) if not np.isfinite(p).all()]:
        raise DataError(
            f"the position of sensor {', '.join(unplaced)} is not a finite number",
            where=f"{where}: position",
            hint="give the place of every sensor, or of none: then there is no tensor",
        )
    apart = np.linalg.norm(position[:, None] - position, axis=2)
    if magnitude == "refuse" and np.max(apart, initial=0.0) > checks.LARGEST_ARRAY_M:
        raise DataError(
            f"two sensors are {np.max(apart):.4g} m apart, farther than in any rigid array",
            where=f"{where}: position",
            hint="are its units right (mm labelled m)? `load: {magnitude: accept}` lets it pass",
        )
    for s, t in zip(*np.nonzero(np.triu(apart == 0, 1)), strict=True):
        notes.append(f"the sensors {survey.sensors[s]} and {survey.sensors[t]} are stated to be at one place")


def _refuse_cold(survey: Survey, where: str) -> None:
    """Refuse thermometers that are below absolute zero."""
    from magtensor.loop.fitting.record import channels_of

    logged, units = channels_of(survey)
    for name, values in logged.items():
        known = UNITS.get(units[name])
        if known is None or known.dimension != TEMPERATURE or not np.isfinite(values).any():
            continue
        usual = float(np.nanmedian(convert(values, units[name], "degC")))
        if usual < checks.ABSOLUTE_ZERO:
            raise DataError(
                f"its median is {usual:.6g} degC, below absolute zero",
                where=f"{where}: {name}",
                hint="are its units right (degC labelled K)? `load: {magnitude: accept}` lets it pass",
            )


def _flagged(
    survey: Survey, impossible: dict[str, NDArray[np.bool_]], saturation_nT: float | None
) -> tuple[NDArray[np.bool_], list[Flag]]:
    """(N, S) usable samples, and the flags that say why the others are not."""
    field, time = survey.values("b_raw"), survey.time
    good = survey.good_by_sensor.copy()
    flags: list[Flag] = []
    repeating = "the same numbers for longer than chance explains"
    frozen, nothing = repeated.frozen(field), checks.zeros(field)
    if frozen.any():
        flags += flag_ranges(time, frozen, by=BY, reason="frozen: no sensor gives a new number")
        good &= ~frozen[:, None]
    for s, name in enumerate(survey.sensors):
        own = field[:, s]
        known = {reason: where[:, s] for reason, where in impossible.items()}
        missing = np.asarray(np.isnan(own).any(axis=1)) & ~np.any(list(known.values()), axis=0)
        rails = (np.abs(own) >= saturation_nT) if saturation_nT is not None else checks.saturated(own)
        others = np.delete(field, s, axis=1) if field.shape[1] > 1 else None
        for bad, reason in (
            (missing, "missing value"),
            (nothing[:, s], "zero on all axes"),
            *((bad, reason) for reason, bad in known.items()),
            (
                np.asarray(rails.any(axis=1)),
                f"saturated on axis {', '.join(AXES[a] for a in np.flatnonzero(rails.any(axis=0)))}",
            ),
            (repeated.stuck(own, others), f"stuck: {repeating}"),
            *(
                (repeated.stuck_axis(own, a, others) & ~rails[:, a], f"axis {axis} stuck: {repeating}")
                for a, axis in enumerate(AXES)
            ),
        ):
            flags += flag_ranges(time, bad, by=BY, reason=reason, sensor=name)
            good[:, s] &= ~bad
    return good, flags


def _readings(survey: Survey, notes: list[str]) -> dict[str, Any]:
    """Which rows hold readings, where some are filled in; nothing where the sensors are read in different rows."""
    field = survey.values("b_raw")
    reading = ~np.column_stack([repeated.filled_in(field[:, s]) for s in range(field.shape[1])])
    if reading.all():
        return {}
    own = reading.mean(axis=0)
    words = ", ".join(f"{name} {1 - share:.0%}" for name, share in zip(survey.sensors, own, strict=True) if share < 1)
    words = f"rows that repeat a reading or lie on the line between two: {words}"
    if reading.all(axis=1).mean() < _READ_TOGETHER * own.min():
        notes.append(f"{words}; the sensors are read in different rows, and all are used")
        return {}
    notes.append(f"{words}; no calibration is fitted to them")
    return {"is_reading": (("time", "sensor"), reading, {"long_name": "a reading, neither repeated nor interpolated"})}


def _described(survey: Survey) -> dict[str, Any]:
    """`time` and `b_raw` with what was found of them: rate, gaps, quantisation, share of new samples."""
    time, field = survey["time"], survey["b_raw"]
    found = time_base.sampling(survey.time)
    facts = {
        "rate_Hz": found.rate_Hz,
        "jitter_s": found.jitter_s,
        "gaps": found.gaps,
        "longest_gap_s": found.longest_gap_s,
        "missing_samples": found.missing,
    }
    raw = field.values
    steps = [max(recorded_numbers.resolution(raw[:, s, a]) for a in range(3)) for s in range(raw.shape[1])]
    fresh = [repeated.new_share(raw[:, s]) for s in range(raw.shape[1])]
    return {
        "time": (("time",), time.values, {**time.attrs, **facts}),
        "b_raw": (field.dims, raw, {**field.attrs, "quantisation_nT": steps, "new_sample_share": fresh}),
    }
