"""A survey from anybody's files, through the mapping in the recipe."""

from __future__ import annotations

from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.attitude import continuous
from magtensor.errors import DataError
from magtensor.survey.altitude import dipole_decrease, pressure_height
from magtensor.survey.canonical import expected
from magtensor.survey.flags import Flag, flag_ranges
from magtensor.survey.model import AXES, Survey
from magtensor.survey.quantities import Rows, interpolated, listed, quantity, rows_of
from magtensor.survey.quaternions import unit_quaternions
from magtensor.survey.sections import (
    REFERENCE_KINDS,
    AltitudeSection,
    AttitudeSection,
    ChannelSection,
    FileSection,
    QuantitySection,
    ReferenceSection,
    SegmentSection,
)
from magtensor.survey.source import Source
from magtensor.survey.time_base import moves_on
from magtensor.survey.times import since, split_since, to_epoch
from magtensor.units import convert


class _Mapper:
    """The state of one reading: the array's rows, and what was noticed on the way."""

    def __init__(self, source: Source) -> None:
        self.source, self.section = source, source.section
        self.tables = source.tables(source.section)
        self.rows = rows_of(source.section, self.tables)
        self.notes: list[str] = list(self.tables.notes)
        self.flags: list[Flag] = []
        self.variables: dict[str, Any] = {}

    def survey(self) -> Survey:
        section = self.section
        attributes: dict[str, Any] = {"units": since(self.rows.epoch)}
        if self.rows.relative:
            attributes["comment"] = "the files do not say when time 0 was"
        self.variables["time"] = (("time",), self.rows.time, attributes)
        self.sensors()
        for name, channel in section.channels.items():
            self.channel(name, channel)
        if section.attitude is not None:
            self.variables["attitude"] = self.attitude(section.attitude)
        if section.segment is not None:
            self.variables["segment"] = (("time",), self.segment(section.segment), {"units": "1"})
        if section.reference is not None:
            self.variables |= self.reference(section.reference)
        facts = {**self.tables.attributes, "source": self.tables.where}
        if self.notes:
            facts["notes"] = self.notes
        return Survey.build(self.variables, facts).merged({}, self.flags)

    def rows_for(self, part: FileSection) -> Rows:
        """The rows a part of the section reads from: its own files, or the survey's."""
        if part.names:
            tables = self.source.tables(part)
            self.notes += [n for n in tables.notes if n not in self.notes]
            return rows_of(part, tables)
        return self.rows if part.time is None else rows_of(part, self.tables)

    def values(
        self, part: QuantitySection, to: str | None, what: str
    ) -> tuple[NDArray[np.float64], str | None, NDArray[np.bool_]]:
        """A quantity at the array's times, its units, and where its numbers cannot be believed."""
        rows = self.rows_for(part)
        found = quantity(part, rows, to=to, what=what)
        self.notes += found.notes
        if rows is self.rows:
            return found.values, found.units, found.unbelievable
        values = np.where(found.unbelievable[:, None], np.nan, found.values)
        return self.at_array_times(rows, values, part.max_gap_s, what), found.units, np.zeros(len(self.rows.time), bool)

    def at_array_times(
        self, rows: Rows, values: NDArray[np.float64], max_gap_s: float, what: str
    ) -> NDArray[np.float64]:
        time = to_epoch(rows.time, rows.epoch, self.rows.epoch)
        onward = moves_on(time)
        if not onward.all():
            self.notes.append(f"{what}: {int((~onward).sum())} rows left out whose time does not move on")
        return interpolated(self.rows.time, time[onward], values[onward], max_gap_s)

    def sensors(self) -> None:
        assert self.section.sensors is not None
        names = list(self.section.sensors)
        field = np.empty((len(self.rows.time), len(names), 3))
        good = np.ones(field.shape[:2], dtype=bool)
        for i, (name, sensor) in enumerate(self.section.sensors.items()):
            what = f"sensors.{name}"
            values, _, unbelievable = self.values(sensor, "nT", what)
            if values.shape[1] != 3:
                raise DataError(
                    f"{values.shape[1]} columns for a three-axis sensor", where=f"{self.tables.where}: {what}"
                )
            field[:, i], good[:, i] = values, ~unbelievable
            reason = "a number outside the range that the mapping calls valid"
            self.flags += flag_ranges(self.rows.time, unbelievable, by="load", reason=reason, sensor=name)
        self.variables["sensor"] = (("sensor",), np.array(names), {})
        self.variables["axis"] = (("axis",), np.array(AXES), {})
        self.variables["b_raw"] = (("time", "sensor", "axis"), field, {"units": "nT", "long_name": "raw field"})
        if not good.all():
            self.variables["good"] = (("time", "sensor"), good, {"long_name": "sample may be used"})
        positions = [s.position for s in self.section.sensors.values()]
        if all(p is not None for p in positions):
            self.variables["position"] = (("sensor", "axis"), np.array(positions, dtype=np.float64), {"units": "m"})

    def channel(self, name: str, section: ChannelSection) -> None:
        known = expected(name)
        what = f"channels.{name}"
        values, units, unbelievable = self.values(section, known[1] if known else None, what)
        values = np.where(unbelievable[:, None], np.nan, values)
        if unbelievable.any():
            self.notes.append(f"{what}: {int(unbelievable.sum())} numbers outside the valid range are taken as missing")
        dims = self.channel_dims(name, section, values.shape[1])
        attributes = {} if units is None else {"units": units}
        self.variables[name] = (dims, values[:, 0] if dims == ("time",) else values, attributes)

    def channel_dims(self, name: str, section: ChannelSection, columns: int) -> tuple[str, ...]:
        known, sensors = expected(name), len(self.section.sensors or {})
        where = f"{self.tables.where}: channels.{name}"
        if columns == 1 and section.per is None:
            dims: tuple[str, ...] = ("time",)
        elif section.per is not None:
            dims = ("time", section.per)
        elif known:
            dims = known[0][-1]
        else:
            dims = ("time", "axis") if columns == 3 else ("time", "sensor")
        wanted = {"axis": 3, "sensor": sensors}.get(dims[-1], 1)
        if columns != wanted:
            raise DataError(
                f"{columns} columns, but ({', '.join(dims)}) needs {wanted}",
                where=where,
                hint=f"a channel has 1 column, 3 (x, y, z), or {sensors} (one for each sensor, `per: sensor`)",
            )
        if known and dims not in known[0]:
            raise DataError(f"({', '.join(dims)}) is not what the layout allows for {name}", where=where)
        return dims

    def attitude(self, section: AttitudeSection) -> Any:
        rows = self.rows_for(section)
        where = f"{rows.tables.where}: attitude"
        if section.euler is not None:
            angles = [rows.values(r)[:, 0] for r in (section.euler.roll, section.euler.pitch, section.euler.yaw)]
            found = euler_quaternion(*(convert(a, section.euler.units, "rad") for a in angles))
        else:
            assert section.from_ is not None
            found = np.concatenate([rows.values(r).astype(np.float64) for r in listed(section.from_)], axis=1)
            if found.shape[1] != 4:
                raise DataError(f"{found.shape[1]} columns for a quaternion", where=where)
            if section.scalar == "first":
                found = np.roll(found, -1, axis=1)
        found = unit_quaternions(found, where, self.notes)
        found = found / np.linalg.norm(found, axis=1, keepdims=True)
        if section.maps == "world to platform":
            found = found * np.array([-1.0, -1.0, -1.0, 1.0])
        if rows is not self.rows:
            found = self.at_array_times(rows, continuous(found), section.max_gap_s, "attitude")
            found = found / np.linalg.norm(found, axis=1, keepdims=True)
        attributes = {"units": "1", "long_name": "platform to world, scalar last"}
        return ("time", "quaternion"), found, {**attributes, **({"world": section.world} if section.world else {})}

    def segment(self, section: SegmentSection) -> NDArray[np.int64]:
        rows = self.rows
        if section.gaps_s is not None:
            with np.errstate(invalid="ignore"):
                starts = np.diff(rows.time) > section.gaps_s
            return np.concatenate(([0], np.cumsum(starts))).astype(np.int64)
        if section.condition is not None:
            numbers = rows.values(section.condition.from_)[:, 0].astype(np.float64)
            holds = np.isfinite(numbers)
            if section.condition.above is not None:
                holds &= numbers > section.condition.above
            if section.condition.below is not None:
                holds &= numbers < section.condition.below
            return np.concatenate(([0], np.cumsum(holds[1:] != holds[:-1]))).astype(np.int64)
        assert section.from_ is not None
        numbers = rows.values(section.from_)[:, 0].astype(np.float64)
        if not np.isfinite(numbers).all() or (numbers != np.round(numbers)).any():
            raise DataError(
                "segments must be whole numbers", where=self.tables.find(section.from_).origin,
                hint="a channel that only says when something is on can be given as `condition`",
            )  # fmt: skip
        return numbers.astype(np.int64)

    def reference(self, section: ReferenceSection) -> dict[str, Any]:
        if section.altitude_model is not None:
            time, epoch = self.rows.time, self.rows.epoch
            field, attributes = self.altitude_field(section.altitude_model)
            return _reference(time, epoch, field, attributes)
        if section.total_field is not None or section.components is not None:
            rows = self.rows_for(section)
            return _measured(section, rows, self.rows.epoch, self.notes) | _world(section)
        return _constant(section, self.rows.time, self.rows.epoch)

    def altitude_field(self, section: AltitudeSection) -> tuple[NDArray[np.float64], dict[str, Any]]:
        if section.pressure is not None:
            pressure, _, odd = self.values(section.pressure, "Pa", "reference.altitude_model.pressure")
            height = pressure_height(np.where(odd, np.nan, pressure[:, 0]))
        else:
            assert section.height is not None
            heights, _, odd = self.values(section.height, "m", "reference.altitude_model.height")
            height = np.where(odd, np.nan, heights[:, 0])
        if not np.isfinite(height).any():
            raise DataError("no height can be had from it", where=f"{self.tables.where}: reference.altitude_model")
        base = float(convert(section.value, section.units, "nT"))
        about = f"{base:g} nT at {section.at_m:g} m, decreasing with height as a dipole's field"
        return dipole_decrease(base, height, section.at_m), {
            "origin": "modelled",
            "comment": about,
            **_why(section.why),
        }


def mapped(source: Source) -> Survey:
    """Read a survey through the section's mapping.

    Raises:
        DataError: the files are not what the mapping says.
        UsageError: no such reader, or wrong options.
    """
    return _Mapper(source).survey()


def with_reference(survey: Survey, source: Source) -> Survey:
    """A survey in the canonical layout, with the section's reference in place of its own.

    A `world_field` alone tells the direction: the survey keeps the total field that it has.

    Raises:
        DataError, UsageError: as `mapped`.
    """
    section = source.section.reference
    assert section is not None
    alone = all(getattr(section, kind) is None for kind in REFERENCE_KINDS)
    if alone and "reference/total_field" in survey:
        return survey.merged(_world(section))
    parts = split_since(str(survey["time"].attrs["units"]))
    assert parts is not None
    epoch = parts[1]
    if section.total_field is None and section.components is None:
        return survey.merged(_constant(section, survey.time, epoch))
    tables = source.tables(section)
    notes = [*survey.attributes.get("notes", ()), *tables.notes]
    added = _measured(section, rows_of(section, tables), epoch, notes) | _world(section)
    bare = Survey.build(
        {p: survey[p] for p in survey.paths() if not p.startswith("reference/")},
        {**survey.attributes, **({"notes": notes} if notes else {})},
    )
    return bare.merged(added, survey.flags)


def _measured(section: ReferenceSection, rows: Rows, epoch: datetime, notes: list[str]) -> dict[str, Any]:
    part = section.total_field or section.components
    assert part is not None
    if part.names:
        raise DataError("name the reference's file in `reference` itself", where=f"{rows.tables.where}: reference")
    what = "reference.total_field" if section.total_field else "reference.components"
    found = quantity(part, rows, to="nT", what=what)
    notes += found.notes
    width = 1 if section.total_field else 3
    if found.values.shape[1] != width:
        raise DataError(f"{found.values.shape[1]} columns, {width} needed", where=f"{rows.tables.where}: {what}")
    field = found.values[:, 0] if section.total_field else np.linalg.norm(found.values, axis=1)
    field = np.where(found.unbelievable, np.nan, field)
    if found.unbelievable.any():
        notes.append(f"{what}: {int(found.unbelievable.sum())} numbers outside the valid range are taken as missing")
    if not np.isfinite(field).any():
        raise DataError(
            "the reference holds no number at all: every value is missing", where=f"{rows.tables.where}: {what}"
        )
    origin = "measured" if section.total_field else "magnitude of a vector instrument"
    return _reference(to_epoch(rows.time, rows.epoch, epoch), epoch, field, {"origin": origin})


def _constant(section: ReferenceSection, time: NDArray[np.float64], epoch: datetime) -> dict[str, Any]:
    if section.constant is not None:
        value = float(convert(section.constant.value, section.constant.units, "nT"))
        attributes = {"origin": "constant", **_why(section.constant.why)}
    else:
        assert section.world_field is not None
        value = float(np.linalg.norm(convert(section.world_field.value, section.world_field.units, "nT")))
        attributes = {"origin": "constant", "comment": "magnitude of the known field vector"}
    known = time[np.isfinite(time)]
    ends = np.unique([known.min(), known.max()]) if known.size else np.zeros(1)
    return _reference(ends, epoch, np.full(len(ends), value), attributes) | _world(section)


def _world(section: ReferenceSection) -> dict[str, Any]:
    if section.world_field is None:
        return {}
    vector = convert(section.world_field.value, section.world_field.units, "nT")
    return {"reference/world_field": (("axis",), vector, {"units": "nT", "long_name": "field in the world frame"})}


def _reference(
    time: NDArray[np.float64], epoch: datetime, field: NDArray[np.float64], attributes: dict[str, Any]
) -> dict[str, Any]:
    return {
        "reference/time": (("time",), time, {"units": since(epoch)}),
        "reference/total_field": (("time",), field, {"units": "nT", **attributes}),
    }


def _why(text: str) -> dict[str, str]:
    return {"why": text} if text else {}


def euler_quaternion(
    roll: NDArray[np.float64], pitch: NDArray[np.float64], yaw: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Quaternions (N, 4), scalar last, platform to world, of the aerospace sequence yaw (z), pitch (y), roll (x).

    Args:
        roll, pitch, yaw: (N,) rad.
    """
    cr, sr, cp, sp, cy, sy = (f(a / 2) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    return np.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        axis=1,
    )
