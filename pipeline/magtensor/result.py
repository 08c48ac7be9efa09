"""Writes a run's files, all or none: `result.nc`, `calibration.nc`, `verdict.json`, `report.html`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor import provenance
from magtensor.atomic import atomic_path, atomic_set
from magtensor.calibrated import plain_attributes
from magtensor.survey.model import Survey

if TYPE_CHECKING:
    import xarray as xr

    from magtensor.provenance import Provenance

RESULT, CALIBRATION, VERDICT, REPORT = "result.nc", "calibration.nc", "verdict.json", "report.html"
FILES = (RESULT, CALIBRATION, VERDICT, REPORT)
GROUPS = ("calibrated", "calibration", "residual", "qc")
DETRENDED = ("total_field", "total_field_std", "diurnal")  # of the array's own variables, these are results


def write(directory: Path, survey: Survey, made_by: Provenance, outcome: dict[str, Any]) -> Provenance:
    """Write the files of a finished run into `directory`; a killed run leaves the old files or none.

    Returns:
        The provenance with the hash of the content.
    """
    tree = result_tree(survey)
    made_by = replace(made_by, content_sha256=provenance.content_sha256(tree))
    with atomic_set(directory, last=RESULT) as folder:
        save(tree, made_by, folder / RESULT)
        if "calibration" in tree.children:
            save(only(tree, "calibration"), made_by, folder / CALIBRATION)
        write_verdict(folder, outcome)
        report(folder)
    return made_by


def write_verdict(folder: Path, outcome: dict[str, Any]) -> None:
    """`verdict.json` in a folder."""
    (folder / VERDICT).write_text(json.dumps(finite(outcome), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def finite(value: Any) -> Any:
    """The same with what is not a finite number as None: JSON knows no NaN."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def write_calibrated(path: Path, survey: Survey, made_by: Provenance) -> None:
    """Write the file of `magtensor apply`."""
    tree = only(result_tree(survey), "calibrated", "qc")
    made_by = replace(made_by, content_sha256=provenance.content_sha256(tree))
    with atomic_path(path) as temporary:
        save(tree, made_by, temporary)


def write_calibration(path: Path, calibration: Survey, made_by: Provenance) -> None:
    """Write a calibration alone, as it was read or turned since."""
    import xarray as xr

    node = _clean(calibration.tree["calibration"].to_dataset())
    tree = xr.DataTree.from_dict({"/calibration": node})
    tree.attrs = plain_attributes({str(k): v for k, v in calibration.tree.attrs.items() if k != "source"})
    made_by = replace(made_by, content_sha256=provenance.content_sha256(tree))
    with atomic_path(path) as temporary:
        save(tree, made_by, temporary)


def result_tree(survey: Survey) -> xr.DataTree:
    """The groups of the contract, ready to be written."""
    import xarray as xr

    nodes = {name: node.to_dataset() for name, node in survey.tree.children.items() if name in GROUPS}
    if kept := [p for p in DETRENDED if p in survey]:
        nodes["detrended"] = xr.Dataset({p: survey[p].variable for p in kept}, coords={"time": survey["time"].variable})
    if "calibrated" in nodes:
        good = xr.Variable(("time",), survey.good, {"long_name": "no sensor's sample is flagged"})
        nodes["calibrated"] = nodes["calibrated"].assign(good=good)
    flags = [f.as_dict() for f in survey.flags]
    nodes["qc"] = nodes.get("qc", xr.Dataset()).assign_attrs(flag_record=json.dumps(flags))
    tree = xr.DataTree.from_dict({f"/{name}": _clean(dataset) for name, dataset in nodes.items()})
    tree.attrs = plain_attributes(survey.attributes)
    return tree


def _clean(dataset: xr.Dataset) -> xr.Dataset:
    dataset = dataset.copy()
    dataset.attrs = plain_attributes(dataset.attrs)
    for name in dataset.variables:
        dataset[name].attrs = plain_attributes(dataset[name].attrs)
    return dataset


def only(tree: xr.DataTree, *names: str) -> xr.DataTree:
    """Some of the groups."""
    import xarray as xr

    part = xr.DataTree.from_dict({f"/{n}": tree[n].to_dataset() for n in names if n in tree.children})
    part.attrs.update(tree.attrs)
    return part


def save(
    tree: xr.DataTree, made_by: Provenance, path: Path, growing: Mapping[str, tuple[str, ...]] | None = None
) -> None:
    """Write the groups with their provenance; `growing` names, for each group, the dimensions that will grow."""
    import xarray as xr

    whole = tree.copy()
    whole[provenance.GROUP] = xr.DataTree(xr.Dataset(attrs=made_by.attributes()))
    whole.to_netcdf(path, engine="h5netcdf", unlimited_dims=growing)


def report(folder: Path) -> None:
    """`report.html` of the files in a folder."""
    from magtensor.report import write_report

    write_report(folder)


def open_result(path: Path) -> Survey:
    """A result or calibration file as a Survey (its groups as nodes).

    Raises:
        DataError: it cannot be read, or is no such file.
    """
    import xarray as xr

    from magtensor.errors import DataError
    from magtensor.survey.hdf5 import why_unreadable

    try:
        # a file that is no result may have dimensions without a name
        with xr.open_datatree(path, engine="h5netcdf", decode_times=False, phony_dims="access") as opened:
            tree = opened.load()
    except FileNotFoundError as error:
        raise DataError("no such file", where=str(path)) from error
    except (OSError, ValueError, KeyError, RuntimeError, TypeError) as error:
        raise DataError(
            why_unreadable(path, str(error)), where=str(path), hint="name a calibration.nc or result.nc"
        ) from error
    tree.attrs["source"] = str(path)
    return Survey(tree, (), {str(k): v for k, v in tree.attrs.items()})


def sensors_of(calibration: Survey) -> list[str]:
    """The names of the sensors a stored calibration is for."""
    return [str(s) for s in np.asarray(calibration.values("calibration/sensor"))]
