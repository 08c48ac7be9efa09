"""Any HDF5 file as Tables: netCDF-4, plain h5py, with or without dimension scales, groups and compound datasets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError
from magtensor.survey.tables import Column, Tables, concatenate, existing

if TYPE_CHECKING:
    import h5py

# What h5py raises when the bytes on disk are not what the file's own description promises.
_BROKEN = (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError, OverflowError)
_NOT_A_VARIABLE = "This is a netCDF dimension but not a netCDF variable"
COPY = "copy it again from its source; the recording may have been interrupted"
_BOOKKEEPING = {
    "DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "NAME", "_Netcdf4Dimid", "_Netcdf4Coordinates", "_NCProperties",
    "_nc3_strict", "units", "_FillValue", "missing_value", "scale_factor", "add_offset", "coordinates",
}  # fmt: skip


def read_hdf5(paths: Iterable[Path]) -> Tables:
    """The datasets of HDF5 files that follow each other, by path; values are read when asked for.

    Fill values become NaN and the CF attributes scale_factor and add_offset are applied.

    Raises:
        DataError: not an HDF5 file, truncated, corrupt, locked, or the files have different datasets.
    """
    return concatenate([_read_one(path) for path in existing(paths)])


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    import h5py

    try:
        # A reader needs no lock, and file systems without locks would refuse one.
        file = h5py.File(path, "r", locking="best-effort")
    except OSError as error:
        raise DataError(why_unreadable(path, str(error)), where=path.name, hint=_hint(str(error))) from error
    with file:
        yield file


def why_unreadable(path: Path, message: str) -> str:
    """What the HDF5 library's complaint about a file means, without its words."""
    if "truncated file" in message:
        return "the HDF5 file is truncated: it ends before its own index says it does"
    if "signature not found" in message:
        return f"this is not an HDF5 file (it starts with {path.open('rb').read(8)!r})"
    if "unable to lock" in message:
        return "the HDF5 file is locked by another process that writes it"
    return "the HDF5 file is damaged, or is not laid out as this file should be"


def _hint(message: str) -> str:
    if "truncated file" in message:
        return COPY
    if "signature not found" in message:
        return "a file of another kind needs a mapping in the recipe; `magtensor inspect` proposes one"
    return ""


def _read_one(path: Path) -> Tables:
    import h5py

    with _opened(path) as file:
        columns: dict[str, Column] = {}
        try:
            found: list[tuple[str, h5py.Dataset]] = []
            file.visititems(lambda name, item: found.append((name, item)) if isinstance(item, h5py.Dataset) else None)
            for name, item in found:
                for column in _columns_of(path, name, item):
                    columns[column.name] = column
            attributes = plain_attributes(file.attrs)
        except _BROKEN as error:
            raise DataError(
                "the HDF5 file is damaged: its list of datasets cannot be read", where=path.name, hint=COPY
            ) from error
    if not columns:
        raise DataError("the HDF5 file holds no dataset", where=path.name)
    rows = max((c.shape[0] for c in columns.values() if c.shape), default=0)
    return Tables(columns, (path,), attributes, (), (rows,))


def _columns_of(path: Path, key: str | bytes, item: h5py.Dataset) -> Iterator[Column]:
    import h5py

    name = _text(key)  # a name that is no UTF-8 comes as bytes
    if item.dtype.kind == "O" and h5py.check_string_dtype(item.dtype) is None:
        return  # references, or rows of unequal length: nothing that a survey could use
    attributes = plain_attributes(item.attrs)
    if item.shape is None or str(attributes.get("NAME", "")).startswith(_NOT_A_VARIABLE):
        return
    units = attributes.get("units")
    kept = {k: v for k, v in attributes.items() if k not in _BOOKKEEPING}
    origin = f"{path.name}: {name}"
    scale = attributes.get("CLASS") == "DIMENSION_SCALE"
    if item.dtype.names:
        for part in item.dtype.names:
            kind = item.dtype[part]
            yield Column(
                f"{name}/{part}", f"{origin}/{part}", (*item.shape, *kind.shape), _loader(path, key, part),
                text=kind.base.kind in "OSU",
            )  # fmt: skip
        return
    yield Column(
        name, origin, item.shape, _loader(path, key), None if units is None else str(units), _dims(item, scale), kept,
        item.dtype.kind in "OSU",
    )  # fmt: skip


def _dims(item: h5py.Dataset, is_scale: bool) -> tuple[str, ...] | None:
    """The dimensions' names from the attached scales; a one-dimensional scale is its own dimension."""
    if is_scale and item.ndim == 1:
        return (str(item.name).rsplit("/", 1)[-1],)
    names = []
    for number, dim in enumerate(item.dims):
        if len(dim) == 0:
            return None
        scale = dim[0]
        names.append(str(scale.name or dim.label or f"dim{number}").rsplit("/", 1)[-1])
    return tuple(names)


def _loader(path: Path, key: str | bytes, part: str | None = None) -> Callable[..., NDArray[Any]]:
    def load(rows: slice | None = None) -> NDArray[Any]:
        where = f"{path.name}: {_text(key)}"
        with _opened(path) as file:
            try:
                item = file[key]
                if item.dtype.kind == "O" and part is None:
                    return np.asarray(item.asstr(errors="replace")[() if rows is None else rows], dtype=str)
                values = item[() if rows is None else rows]
                values = values if part is None else values[part]
                attributes = plain_attributes(item.attrs)
            except MemoryError as error:
                raise DataError("its values do not fit into the memory", where=where) from error
            except _BROKEN as error:
                raise DataError(
                    "the values cannot be read: the file is truncated or damaged here", where=where, hint=COPY
                ) from error
        if values.dtype.kind == "S":
            return np.char.decode(values, "utf-8", "replace")
        return _decoded(values, attributes, where)

    return load


def _decoded(values: NDArray[Any], attributes: dict[str, Any], where: str) -> NDArray[Any]:
    """CF packing undone: missing values to NaN, then scale_factor and add_offset."""
    missing = [attributes[k] for k in ("_FillValue", "missing_value") if k in attributes]
    missing = [m for m in missing if not (isinstance(m, float) and np.isnan(m))]
    scaled = "scale_factor" in attributes or "add_offset" in attributes
    if not missing and not scaled:
        return values
    try:
        hole = np.isin(values, np.asarray(missing, dtype=values.dtype)) if missing else None
        if scaled or (hole is not None and hole.any()):
            values = values.astype(np.float64)
        if scaled:
            values = values * float(attributes.get("scale_factor", 1.0)) + float(attributes.get("add_offset", 0.0))
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"its _FillValue, scale_factor or add_offset is not a number: {error}", where=where) from error
    if hole is not None and hole.any():
        values[hole] = np.nan
    return values


def plain_attributes(attributes: Any) -> dict[str, Any]:
    """HDF5 attributes as text, numbers and lists; what netCDF keeps for its own bookkeeping is left out."""
    plain = {}
    for key in attributes:
        if key in _BOOKKEEPING and key in {"DIMENSION_LIST", "REFERENCE_LIST", "_NCProperties"}:
            continue
        try:
            if not _readable(attributes, key):
                continue
            value = attributes[key]
        except _BROKEN:
            continue  # an attribute of a type nobody here can read says nothing; the data may still be whole
        if type(value).__name__ == "Empty":
            continue
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(())[()]
        if isinstance(value, bytes | np.bytes_):
            value = _text(value)
        elif isinstance(value, np.generic):
            value = value.item()
        elif isinstance(value, np.ndarray):
            value = [_text(v) if isinstance(v, bytes) else v for v in value.tolist()]
        plain[key] = value
    return plain


def _readable(attributes: Any, key: str) -> bool:
    """Whether an attribute is of a plain type.

    Nothing of a survey is stored as a sequence of variable length, and a damaged byte that turns a text into one
    makes the HDF5 library read beyond its memory.
    """
    import h5py

    kind = attributes.get_id(key).dtype
    return not kind.hasobject or h5py.check_string_dtype(kind) is not None


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
