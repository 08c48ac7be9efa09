"""Surveys that are in memory already: a Survey, or an xarray Dataset or DataTree in the canonical layout."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from magtensor.errors import UsageError
from magtensor.survey.canonical import survey_from
from magtensor.survey.model import Survey
from magtensor.survey.tables import Column, Tables
from magtensor.survey.times import since, split_since

if TYPE_CHECKING:
    import xarray as xr

# What a survey may be given as, from Python.
SurveyLike: TypeAlias = "str | Path | Survey | xr.Dataset | xr.DataTree | Mapping[str, xr.Dataset]"

WHERE = "survey in memory"


@dataclass(frozen=True)
class Held:
    """A survey in memory, in the place of a `Source` that would read it from files."""

    survey: Survey

    def read(self) -> Survey:
        """The survey."""
        return self.survey

    def files(self) -> list[Path]:
        """None."""
        return []

    def further_files(self) -> list[Path]:
        """None: surveys that are fitted together with it are named by a recipe."""
        return []

    def further_surveys(self) -> list[tuple[str, Survey]]:
        """None."""
        return []

    def facts(self) -> dict[str, Any]:
        """What provenance says of it; the hash is over its arrays."""
        from magtensor.provenance import content_sha256

        return {"path": WHERE, "sha256": content_sha256(self.survey.tree), "bytes": self.survey.tree.nbytes}

    def __str__(self) -> str:
        return str(self.survey.attributes.get("source", WHERE))


def given_survey(survey: SurveyLike) -> Path | Held:
    """A file's path, or what is held in memory.

    Args:
        survey: a path; a Survey, whose `total_field` stands for the reference if it has no other; or xarray data with
            the names, dimensions and units of the canonical layout: a mapping of group names to Datasets as
            `xarray.open_groups(path)` gives it, a DataTree, or one Dataset with the reference in variables named
            `reference/time` and `reference/total_field`. Times may be numbers with units or decoded.

    Raises:
        UsageError: it is none of these.
        DataError: it is not in the canonical layout.
    """
    import xarray as xr

    if isinstance(survey, (str, Path)):
        return Path(survey)
    if isinstance(survey, Survey):
        return Held(_with_its_reference(survey))
    if isinstance(survey, xr.Dataset):
        return _held({"": survey})
    if isinstance(survey, xr.DataTree):
        return _held({n.path: n.to_dataset(inherit=False) for n in survey.subtree})
    if isinstance(survey, Mapping) and all(isinstance(d, xr.Dataset) for d in survey.values()):
        return _held(cast("Mapping[str, xr.Dataset]", survey))
    raise UsageError(
        "a survey is a path, a magtensor Survey, or an xarray Dataset, DataTree or mapping of groups to Datasets; "
        f"not {type(survey).__name__}"
    )


def _with_its_reference(survey: Survey) -> Survey:
    if "total_field" not in survey or "reference/total_field" in survey:
        return survey
    total_field, time = survey["total_field"].variable, survey["time"].variable
    return survey.merged(
        {
            "reference/time": (("time",), time.values, time.attrs),
            "reference/total_field": (("time",), total_field.values, total_field.attrs),
        }
    )


def _held(groups: Mapping[str, xr.Dataset]) -> Held:
    nodes = {name.strip("/"): dataset for name, dataset in groups.items()}
    if "b_raw" in nodes.get("array", ()):  # the tree of a Survey
        nodes[""] = nodes.pop("array")
    columns = {column.name: column for node, dataset in nodes.items() for column in _columns(node, dataset)}
    root = nodes.get("")
    attributes = {} if root is None else {str(k): v for k, v in root.attrs.items()}
    return Held(survey_from(Tables(columns, (Path(WHERE),), attributes)))


def _columns(node: str, dataset: xr.Dataset) -> Iterator[Column]:
    for name, variable in dataset.variables.items():
        path = f"{node}/{name}" if node else str(name)
        values, units = variable.values, variable.attrs.get("units")
        if values.dtype.kind == "M":
            values, units = _counted(values, variable.encoding.get("units"))
        attributes = {str(k): v for k, v in variable.attrs.items() if k != "units"}
        column = Column.of(path, f"{WHERE}: {path}", values, None if units is None else str(units), attributes)
        yield replace(column, dims=tuple(str(d) for d in variable.dims))


def _counted(times: np.ndarray, units: object) -> tuple[np.ndarray, str]:
    """Decoded times (N,) as seconds, since the epoch they were stored with, else since the first whole second."""
    stored = split_since(str(units)) if units is not None else None
    nanoseconds = times.astype("datetime64[ns]")
    if stored is None:
        known = nanoseconds[~np.isnat(nanoseconds)]
        first = int(known[0].astype("int64") // 10**9) if len(known) else 0
        epoch = datetime.fromtimestamp(first, UTC)
    else:
        epoch = stored[1]
    start = np.datetime64(epoch.astimezone(UTC).replace(tzinfo=None), "ns")
    seconds = (nanoseconds - start).astype("int64") / 1e9
    return np.where(np.isnat(nanoseconds), np.nan, seconds), since(epoch)
