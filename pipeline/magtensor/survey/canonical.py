"""The canonical survey file (DESIGN 2.1): read it, however it was written, and write it."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtensor.atomic import atomic_path
from magtensor.errors import DataError
from magtensor.survey.hdf5 import read_hdf5
from magtensor.survey.model import AXES, Survey
from magtensor.survey.quaternions import unit_quaternions
from magtensor.survey.tables import Column, Tables
from magtensor.survey.times import numbers_to_seconds, require_digits, since, split_since, to_epoch
from magtensor.units import UnitError, convert

if TYPE_CHECKING:
    import xarray as xr

# The contract's names: allowed dimensions, units (None: any). `current_*` is handled like them.
LAYOUT: dict[str, tuple[tuple[tuple[str, ...], ...], str | None]] = {
    "b_raw": ((("time", "sensor", "axis"),), "nT"),
    "position": ((("sensor", "axis"),), "m"),
    "temperature": ((("time",), ("time", "sensor")), "degC"),
    "acceleration": ((("time", "axis"),), "m s-2"),
    "angular_rate": ((("time", "axis"),), "rad s-1"),
    "attitude": ((("time", "quaternion"),), None),
    "segment": ((("time",),), None),
}
_CURRENT = ((("time",),), "A")
# what stages give; no channel may have these names
RESULTS = ("good", "is_reading", "total_field", "total_field_std", "diurnal")
LENGTHS = {"axis": 3, "quaternion": 4}


def expected(name: str) -> tuple[tuple[tuple[str, ...], ...], str | None] | None:
    """Dimensions and units the layout asks of this name; None for a channel of the user's own."""
    return _CURRENT if name.startswith("current_") else LAYOUT.get(name)


def read_canonical(path: Path) -> Survey:
    """A survey from a file in the canonical layout.

    Raises:
        DataError: not HDF5, truncated, a variable is missing, has the wrong shape, no units or the wrong ones.
    """
    return survey_from(read_hdf5([path]))


def survey_from(tables: Tables) -> Survey:
    """A survey from an HDF5 file's datasets, which must carry the layout's names.

    Dimensions come from dimension scales where the file has them, else from the layout and the shapes. Datasets
    in other groups, and those that fit no dimension of the survey, are left out and named in the attribute `notes`.

    Raises:
        DataError: as `read_canonical`.
    """
    notes = list(tables.notes)
    for name in ("time", "b_raw"):
        if name not in tables.columns and "calibrated/b" in tables.columns:
            raise DataError("this is a result of magtensor, not a survey: it holds no raw output", where=tables.where)
        if name not in tables.columns:
            raise DataError(
                f"there is no dataset {name}: this is not a survey in the canonical layout",
                where=tables.where,
                hint=f"the file has {', '.join(tables.columns)}; `magtensor inspect` proposes a mapping for it",
            )
    time, epoch = _time(tables.find("time"))
    raw = tables.find("b_raw")
    if len(raw.shape) == 3 and raw.shape[2] == 3 and len(time) not in raw.shape:  # else it is another order
        raise DataError(
            f"time has {len(time)} values, and b_raw has {raw.shape[0]} samples",
            where=tables.where,
            hint="every sample has a time of its own, in the same row",
        )
    if len(raw.shape) != 3 or raw.shape[0] != len(time) or raw.shape[2] != 3:
        raise DataError(
            f"shape {raw.shape} is not (time, sensor, axis) = ({len(time)}, sensors, 3)",
            where=raw.origin,
            hint="one sensor has the shape (time, 1, 3); for any other layout write a mapping in the recipe",
        )
    if 0 in raw.shape:
        raise DataError("it holds no sample" if raw.shape[1] else "it holds no sensor", where=raw.origin)
    sizes = {"time": len(time), "sensor": raw.shape[1], **LENGTHS}
    variables: dict[str, Any] = {
        "time": (("time",), time, {**tables.find("time").attributes, "units": since(epoch)}),
        "sensor": (("sensor",), _names(tables, raw.shape[1]), {}),
        "axis": (("axis",), _axes(tables), {}),
    }
    ignored = []
    for name, column in tables.columns.items():
        if name in ("time", "sensor", "axis", "quaternion") or name.startswith("reference/"):
            continue
        if "/" in name:
            ignored.append(name)
            continue
        found = _variable(name, column, sizes, notes)
        if found is None:
            ignored.append(f"{name} ({_why_left_out(name, column, len(time))})")
        else:
            variables[name] = found
    variables.update(_reference(tables, epoch, ignored))
    if ignored:
        notes.append(f"not part of the survey and left out: {', '.join(_groups(ignored))}")
    attributes = {**tables.attributes, "source": tables.where}
    if notes:
        attributes["notes"] = notes
    return Survey.build(variables, attributes)


def _why_left_out(name: str, column: Column, count: int) -> str:
    if column.shape[:1] not in ((), (count,)):
        return f"{column.shape[0]} rows, the survey has {count}"
    if column.text:
        return "text"
    if name in RESULTS:
        return "the name of a result"
    return f"shape {column.shape}" if column.shape else "a single value"


def _groups(names: list[str]) -> list[str]:
    """`truth/b`, `truth/offset` as `truth/ (2 datasets)`."""
    inside: dict[str, int] = {}
    for name in names:
        if "/" in name:
            inside[name.split("/", 1)[0]] = inside.get(name.split("/", 1)[0], 0) + 1
    return [n for n in names if "/" not in n] + [f"{g}/ ({n} dataset{'s' * (n > 1)})" for g, n in inside.items()]


def _time(column: Column, epoch: datetime | None = None) -> tuple[NDArray[np.float64], datetime]:
    """Seconds (N,) since the file's own epoch, or since the one given."""
    if len(column.shape) != 1:
        raise DataError(f"shape {column.shape} is not (time)", where=column.origin)
    try:
        parts = split_since(column.units or "")
        if parts is None:
            raise ValueError(f"units '{column.units}' name no epoch" if column.units else "it has no units")
        values = column.load()
        _numeric(values, column)
        require_digits(values, column.origin)
        seconds = numbers_to_seconds(values, parts[0])
    except ValueError as error:
        raise DataError(
            str(error), where=column.origin, hint="its units attribute must read `seconds since <ISO 8601 UTC>`"
        ) from error
    return (seconds, parts[1]) if epoch is None else (to_epoch(seconds, parts[1], epoch), epoch)


def _names(tables: Tables, count: int) -> NDArray[Any]:
    if "sensor" not in tables.columns:
        return np.array([f"S{i + 1}" for i in range(count)])
    column = tables.find("sensor")
    if column.shape != (count,):
        given = column.shape[0] if len(column.shape) == 1 else f"an array of shape {column.shape} of"
        raise DataError(f"{given} sensor names, but b_raw has {count} sensors", where=column.origin)
    values = column.load()
    names = [str(v) if values.dtype.kind in "OSU" else f"S{v}" for v in values.tolist()]
    for i, name in enumerate(names):
        if not name.strip() or not name.isprintable():
            raise DataError(
                f"the name {name!r} of sensor {i + 1} is empty or cannot be printed",
                where=column.origin,
                hint="a name is one line of printable characters",
            )
    if len(set(names)) < count:
        raise DataError(f"sensor names {', '.join(names)} are not unique", where=column.origin)
    return np.array(names)


def _axes(tables: Tables) -> NDArray[Any]:
    if "axis" in tables.columns:
        column = tables.find("axis")
        if column.shape != (3,):
            raise DataError(f"shape {column.shape} is not (axis) = (3,)", where=column.origin)
        found = [str(v).strip().lower() for v in np.atleast_1d(column.load()).tolist()]
        # Whoever writes the axis as bare numbers has named nothing; the layout's order holds.
        if column.text and found != list(AXES):
            raise DataError(
                f"axes are {', '.join(found)}; the layout has x, y, z in this order",
                where=column.origin,
                hint="a mapping in the recipe puts axes in order",
            )
    return np.array(AXES)


def _numeric(values: NDArray[Any], column: Column) -> None:
    if values.dtype.kind not in "fiub":
        kinds = {"c": "complex numbers", "U": "text", "S": "text", "O": "text", "M": "dates", "V": "records"}
        held = kinds.get(values.dtype.kind, "no numbers")
        raise DataError(f"it holds {held}; real numbers are needed", where=column.origin)


def _dims(name: str, column: Column, sizes: Mapping[str, int], notes: list[str]) -> tuple[str, ...] | None:
    """The dimensions of a variable of the survey; None for an extra that fits none."""
    known = expected(name)
    choices = known[0] if known else (("time",), ("time", "sensor"), ("time", "axis"))
    wanted = " or ".join(f"({', '.join(c)})" for c in choices)
    if column.dims is not None and not any(d.startswith(("phony_dim", "dim")) for d in column.dims):
        if column.dims not in choices:
            if known is None:
                return None
            raise DataError(f"dimensions ({', '.join(column.dims)}) are not {wanted}", where=column.origin)
        choices = (column.dims,)
    fitting = [c for c in choices if column.shape == tuple(sizes[d] for d in c)]
    if not fitting:
        if known is None:
            return None
        sized = " or ".join(f"({', '.join(f'{d} {sizes[d]}' for d in c)})" for c in choices)
        raise DataError(f"shape {column.shape} is not {sized}", where=column.origin)
    if len(fitting) > 1:
        notes.append(f"{name} has three columns and there are three sensors: taken as one column for each sensor")
    return fitting[0]


def _variable(name: str, column: Column, sizes: Mapping[str, int], notes: list[str]) -> Any:
    known = expected(name)
    if known is None and (column.text or name in RESULTS):
        return None
    dims = _dims(name, column, sizes, notes)
    if dims is None:
        return None
    values = column.load()
    _numeric(values, column)
    attributes = dict(column.attributes)
    if name == "segment":
        return dims, _integers(values, column), {**attributes, "units": "1"}
    if attributes.pop("dtype", None) == "bool":
        values = values.astype(bool)
    if values.dtype.kind == "f" or (known and known[1]):
        values = values.astype(np.float64)
    if name == "attitude":
        values = unit_quaternions(values.astype(np.float64), column.origin, notes)
    if known is None or known[1] is None:
        if column.units is not None or known:
            attributes["units"] = column.units or "1"
        return dims, values, attributes
    return dims, _converted(values, column, known[1]), {**attributes, "units": known[1]}


def _converted(values: NDArray[Any], column: Column, units: str) -> NDArray[np.float64]:
    if not (column.units or "").strip():
        raise DataError(
            f"it has no units; {units} is expected", where=column.origin, hint=f"set its units attribute to {units}"
        )
    try:
        return convert(values, str(column.units), units)
    except UnitError as error:
        raise DataError(str(error), where=column.origin) from error


def _integers(values: NDArray[Any], column: Column) -> NDArray[np.int64]:
    if values.dtype.kind == "f" and not (np.isfinite(values).all() and (values == np.round(values)).all()):
        raise DataError("segments must be whole numbers", where=column.origin)
    return values.astype(np.int64)


def _reference(tables: Tables, epoch: datetime, ignored: list[str]) -> dict[str, Any]:
    names = [n for n in tables.columns if n.startswith("reference/")]
    if not names:
        return {}
    for name in ("reference/time", "reference/total_field"):
        if name not in names:
            raise DataError(f"there is no {name}", where=tables.where, hint=f"the group has {', '.join(names)}")
    clock = tables.find("reference/time")
    time, _ = _time(clock, epoch)
    found: dict[str, Any] = {"reference/time": (("time",), time, {**clock.attributes, "units": since(epoch)})}
    for name in names:
        column = tables.find(name)
        if name == "reference/total_field":
            if column.shape != time.shape:
                raise DataError(f"shape {column.shape} is not (time) = {time.shape}", where=column.origin)
            values = column.load()
            _numeric(values, column)
            found[name] = (("time",), _converted(values, column, "nT"), {**column.attributes, "units": "nT"})
        elif name == "reference/world_field" and column.shape == (3,):
            values = _converted(column.load(), column, "nT")
            found[name] = (("axis",), values, {**column.attributes, "units": "nT"})
        elif column.shape == time.shape and not column.text and name != "reference/time" and name.count("/") == 1:
            attributes = {**column.attributes, **({"units": column.units} if column.units else {})}
            found[name] = (("time",), column.load(), attributes)
        elif name not in found and name != "reference/axis":
            ignored.append(name)
    return found


def write_canonical(survey: Survey, path: Path) -> None:
    """Write the survey as netCDF-4: the array's variables at the root, every other node as a group.

    The file appears whole or not at all. Reading it back gives the same numbers, units and attributes.

    Raises:
        OSError: the folder cannot be written.
    """
    with atomic_path(path) as temporary:
        nodes = {name: node.to_dataset(inherit=False) for name, node in survey.tree.children.items()}
        attributes = {k: v for k, v in survey.attributes.items() if k not in ("notes", "source")}
        _write(nodes.pop("array").assign_attrs({"Conventions": "CF-1.10", **attributes}), temporary, "w", None)
        for name, dataset in nodes.items():
            _write(dataset, temporary, "a", name)


def _write(dataset: xr.Dataset, path: Path, mode: Any, group: str | None) -> None:
    cleaned = dataset.copy(deep=False)
    cleaned.attrs = _storable_attributes(cleaned.attrs)
    for name in cleaned.variables:
        cleaned[name].attrs = _storable_attributes(cleaned[name].attrs)
        cleaned[name].encoding = {}
    # Without this xarray adds _FillValue = NaN, which turns an absent attribute into a stated one.
    encoding = {str(n): {"_FillValue": None} for n, v in cleaned.variables.items() if v.dtype.kind == "f"}
    cleaned.to_netcdf(path, mode=mode, group=group, engine="h5netcdf", encoding=encoding)


def _storable_attributes(attributes: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(k): _storable(v) for k, v in attributes.items() if v is not None}


def _storable(value: Any) -> Any:
    """What netCDF can hold as an attribute: text, numbers, lists of them; other things as text."""
    if isinstance(value, str | int | float) and not isinstance(value, bool):
        return value
    if isinstance(value, list | tuple) and value and all(isinstance(v, str) for v in value):
        return list(value)
    if isinstance(value, list | tuple | np.ndarray) and np.asarray(value).dtype.kind in "fiu" and len(value):
        return np.asarray(value)
    return int(value) if isinstance(value, bool) else str(value)
