"""NASA CDF, and INTERMAGNET's ImagCDF, through the optional package cdflib."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtensor.components import reader
from magtensor.errors import DataError, UsageError
from magtensor.survey.tables import Column, Tables, concatenate, existing
from magtensor.survey.times import since

if TYPE_CHECKING:
    import cdflib

_EPOCHS = ("CDF_EPOCH", "CDF_EPOCH16", "CDF_TIME_TT2000")


@reader(suffixes=(".cdf",))
def cdf(paths: list[Path]) -> Tables:
    """NASA CDF files, ImagCDF among them; needs the extra `magtensor[cdf]`.

    Fill values become NaN. Epochs (also TT2000 with its leap seconds) become seconds since midnight UTC of their
    first day; if there is only one, it is also called `time`.
    """
    try:
        import cdflib
    except ImportError as error:
        raise UsageError(
            f"{Path(paths[0]).name}: reading CDF needs the package cdflib: pip install 'magtensor[cdf]'"
        ) from error
    parts = []
    for path in existing(paths):
        try:
            parts.append(_table(path, cdflib.CDF(str(path))))
        except DataError:
            raise
        except Exception as error:  # cdflib raises whatever a wrong byte leads it to
            raise DataError(
                f"this is not a CDF file, or it is corrupt: {type(error).__name__}: {error}", where=path.name
            ) from error
    return concatenate(parts)


def _table(path: Path, file: cdflib.CDF) -> Tables:
    info = file.cdf_info()
    columns: dict[str, Column] = {}
    epochs = []
    for name in [*info.zVariables, *info.rVariables]:
        kind = file.varinq(name).Data_Type_Description
        values = file.varget(name)
        if values is None or np.ndim(values) == 0:
            continue
        attributes = {str(k): _plain(v) for k, v in file.varattsget(name).items()}
        origin = f"{path.name}: {name}"
        if kind in _EPOCHS:
            columns[name] = Column.of(name, origin, *_seconds(values, origin))
            epochs.append(name)
            continue
        units = next((str(attributes[k]) for k in ("UNITS", "units", "Units") if k in attributes), None)
        values = _without_fill(np.asarray(values), attributes)
        columns[name] = Column.of(name, origin, values, units, attributes)
    if not columns:
        raise DataError("the file holds no variable with records", where=path.name)
    if len(epochs) == 1 and "time" not in columns:
        columns["time"] = columns[epochs[0]]
    facts = {str(k): _plain(v) for k, v in file.globalattsget().items()}
    rows = max(c.shape[0] for c in columns.values())
    return Tables(columns, (path,), facts, (), (rows,))


def _seconds(values: NDArray[Any], origin: str) -> tuple[NDArray[np.float64], str]:
    import cdflib

    # Fill values of the three epoch types lie outside the calendar; cdflib turns them into NaT.
    instants = np.asarray(cdflib.cdfepoch.to_datetime(values), dtype="datetime64[ns]")
    known = instants[~np.isnat(instants)]
    if known.size == 0:
        raise DataError("none of the epochs is a time", where=origin)
    midnight = known[0].astype("datetime64[D]")
    seconds = (instants - midnight) / np.timedelta64(1, "ns") * 1e-9
    epoch = datetime.fromtimestamp(int(midnight.astype("datetime64[s]").astype(np.int64)), UTC)
    return np.asarray(seconds, dtype=np.float64), since(epoch)


def _without_fill(values: NDArray[Any], attributes: dict[str, Any]) -> NDArray[Any]:
    fill = attributes.get("FILLVAL")
    if values.dtype.kind not in "fiu" or not isinstance(fill, int | float) or np.isnan(fill):
        return values
    hole = values == fill
    if not hole.any():
        return values
    found = values.astype(np.float64)
    found[hole] = np.nan
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.item() if value.size == 1 else value.tolist()
    if isinstance(value, list):
        return _plain(value[0]) if len(value) == 1 else [_plain(v) for v in value]
    return value.item() if isinstance(value, np.generic) else value
