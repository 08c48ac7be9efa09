"""Write a simulated survey in the canonical layout: netCDF-4-compatible HDF5."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor.atomic import atomic_path
from magtensor.simulate.gradiometers import COMPONENTS
from magtensor.simulate.run import Simulated, Truth

if TYPE_CHECKING:
    import h5py


def write(simulated: Simulated, path: str | os.PathLike[str]) -> None:
    """Write the survey, and the truth into its group /truth unless the scenario says no.

    The file appears whole or not at all.
    """
    import h5py

    with atomic_path(Path(path)) as partial, h5py.File(partial, "w") as file:
        _write_survey(file, simulated)
        if simulated.reference is not None:
            _write_reference(file, simulated)
        if simulated.scenario.truth:
            _write_truth(file, simulated)


def _time_units(simulated: Simulated) -> str:
    return f"seconds since {simulated.scenario.start}"


def _scale(group: h5py.Group, name: str, values: Any, **attributes: str) -> None:
    """A coordinate variable: a dimension scale named after itself."""
    if isinstance(values, list):
        import h5py

        dataset = group.create_dataset(name, data=values, dtype=h5py.string_dtype())
    else:
        dataset = group.create_dataset(name, data=values)
    dataset.make_scale(name)
    dataset.attrs.update(attributes)


def _variable(group: h5py.Group, name: str, values: Any, dims: tuple[str, ...], units: str, long_name: str) -> None:
    """A variable whose dimensions are the scales of this group, or else of the root."""
    dataset = group.create_dataset(name, data=values)
    for i, dim in enumerate(dims):
        dataset.dims[i].attach_scale(group[dim] if dim in group else group.file[dim])
    dataset.attrs["units"] = units
    dataset.attrs["long_name"] = long_name


def _write_survey(file: h5py.File, simulated: Simulated) -> None:
    from magtensor import __version__

    file.attrs["Conventions"] = "CF-1.8"
    file.attrs["title"] = simulated.scenario.title
    file.attrs["source"] = f"simulated by magtensor {__version__}"
    _scale(file, "time", simulated.time, units=_time_units(simulated), standard_name="time", calendar="standard")
    _scale(file, "sensor", simulated.sensors, long_name="sensor name")
    _scale(file, "axis", ["x", "y", "z"], long_name="axis of the sensor or of the platform frame")
    _variable(file, "b_raw", simulated.b_raw, ("time", "sensor", "axis"), "nT", "raw output of each axis")
    _variable(file, "position", simulated.position, ("sensor", "axis"), "m", "sensor centre in the platform frame")
    if simulated.segment is not None:
        _variable(file, "segment", simulated.segment, ("time",), "1", "posture or line")
    if any("quaternion" in dims for _, dims, _ in simulated.channels.values()):
        _scale(
            file,
            "quaternion",
            ["x", "y", "z", "w"],
            long_name="scalar last, platform to world (east, north, up)",
        )
    for name, (values, dims, units) in simulated.channels.items():
        _variable(file, name, values, dims, units, name.replace("_", " "))


def _write_reference(file: h5py.File, simulated: Simulated) -> None:
    assert simulated.reference is not None
    group = file.create_group("reference")
    _scale(
        group,
        "time",
        simulated.reference.time,
        units=_time_units(simulated),
        standard_name="time",
        calendar="standard",
    )
    _variable(
        group,
        "total_field",
        simulated.reference.total_field,
        ("time",),
        "nT",
        "total field at the base station",
    )


def _write_truth(file: h5py.File, simulated: Simulated) -> None:
    truth: Truth = simulated.truth
    group = file.create_group("truth")
    group.attrs["scenario"] = simulated.scenario.model_dump_json()
    group.attrs["effects"] = json.dumps([_summary(effect) for effect in truth.effects])
    for name in ("row", "column"):
        _scale(group, name, ["x", "y", "z"], long_name=f"{name} of a matrix in the platform frame")
    _scale(
        group,
        "quaternion_true",
        ["x", "y", "z", "w"],
        long_name="scalar last, platform to world (east, north, up)",
    )
    at = ("time", "sensor", "axis")
    _variable(group, "b_true", truth.b, at, "nT", "field at the stated sensor positions in the platform frame")
    _variable(
        group,
        "tensor_true",
        truth.tensor,
        ("time", "row", "column"),
        "nT m-1",
        "dB_row / dx_column at the centre",
    )
    _variable(group, "total_field_true", truth.total_field, ("time",), "nT", "total field at the centre")
    _variable(group, "centre", truth.centre, ("axis",), "m", "mean of the stated sensor positions")
    _variable(group, "matrix", truth.matrix, ("sensor", "row", "column"), "1", "C of m = C b + o")
    _variable(group, "offset", truth.offset, ("sensor", "axis"), "nT", "o of m = C b + o")
    _variable(group, "noise_sd", truth.noise_sd, ("sensor", "axis"), "nT", "standard deviation of the white noise")
    _variable(
        group,
        "attitude_true",
        truth.attitude,
        ("time", "quaternion_true"),
        "1",
        "attitude, platform to world",
    )
    if truth.gradiometers is not None:
        for name in ("component", "true_component"):
            _scale(group, name, list(COMPONENTS), long_name="of the tensor")
        both = ("component", "true_component")
        _variable(group, "gradiometer_matrix", truth.gradiometers.matrix, both, "1", "K of T = K G + O")
        _variable(group, "gradiometer_offset", truth.gradiometers.offset, both[:1], "nT m-1", "O of T = K G + O")
    for i, effect in enumerate(truth.effects):
        if effect.added.size:
            name = f"effect_{i:02d}_{effect.name}"
            if effect.kind == "reference":
                dataset = group.create_dataset(name, data=effect.added)
                dataset.dims[0].attach_scale(file["reference/time"])
                dataset.attrs.update({"units": "nT", "long_name": "added to the reference"})
            else:
                _variable(group, name, effect.added, at, "nT", "added to the raw output")


def _summary(effect: Any) -> dict[str, Any]:
    record = dataclasses.asdict(effect)
    del record["added"]
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in record.items()}
