"""The survey in memory: an xarray DataTree whose nodes keep their own time axes.

`array` holds what DESIGN calls the root of the canonical file (time, sensor, axis), `reference` the base
station at its own time; stages add `calibrated`, `calibration`, `residual` and `qc`. A path such as `b_raw`
or `current_motor` means the node `array`; `reference/total_field` names its node.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError
from magtensor.survey.flags import Flag

if TYPE_CHECKING:
    import xarray as xr

    from magtensor.survey.in_memory import Held
    from magtensor.survey.source import Source

# What a stage may return for a path: a DataArray, or (dims, values, attributes).
Variable: TypeAlias = "xr.DataArray | tuple[Sequence[str], Any, Mapping[str, Any]]"

AXES = ("x", "y", "z")


def split_path(path: str) -> tuple[str, str]:
    """`"b_raw"` to `("array", "b_raw")`, `"reference/total_field"` to its two parts."""
    node, _, name = path.rpartition("/")
    return (node or "array", name)


def short_path(node: str, name: str) -> str:
    """The inverse of `split_path`."""
    return name if node == "array" else f"{node}/{name}"


@dataclass(frozen=True)
class Survey:
    """A read-only view of the survey's variables.

    Attributes:
        tree: the DataTree.
        flags: the flag record so far.
        attributes: facts of the whole survey (title, instrument, source file, ...).
        source: where the stage `load` reads it from; None for a survey made in memory.
    """

    tree: xr.DataTree
    flags: tuple[Flag, ...] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)
    source: Source | Held | None = None

    @classmethod
    def build(cls, variables: Mapping[str, Variable], attributes: Mapping[str, Any] | None = None) -> Survey:
        """A survey from `{path: (dims, values, attributes)}`."""
        import xarray as xr

        return cls(xr.DataTree(), (), dict(attributes or {})).merged(variables)

    def merged(self, variables: Mapping[str, Variable], flags: Iterable[Flag] = ()) -> Survey:
        """A new survey with these variables added or replaced; what is not touched is shared, not copied.

        Raises:
            ValueError: a variable's shape disagrees with the dimensions it names (a plugin's bug).
        """
        import xarray as xr

        nodes: dict[str, xr.Dataset] = {name: node.to_dataset() for name, node in self.tree.children.items()}
        grouped: dict[str, dict[str, Any]] = {}
        for path, value in variables.items():
            node, name = split_path(path)
            if isinstance(value, xr.DataArray):
                grouped.setdefault(node, {})[name] = value.variable
            else:
                dims, values, attributes = value
                grouped.setdefault(node, {})[name] = xr.Variable(tuple(dims), values, dict(attributes))
        for node, added in grouped.items():
            dataset = nodes.get(node, xr.Dataset())
            used = {d for v in added.values() for d in v.dims}
            if node != "reference" and "array" in nodes:
                for dim in used & set(nodes["array"].coords) - set(dataset.coords) - set(added):
                    dataset = dataset.assign_coords({dim: nodes["array"].coords[dim]})
            nodes[node] = dataset.drop_vars([n for n in added if n in dataset]).assign(added)
        tree = xr.DataTree.from_dict({f"/{n}": d for n, d in nodes.items()})
        return Survey(tree, (*self.flags, *flags), self.attributes, self.source)

    def paths(self) -> list[str]:
        """Every variable and coordinate, sorted."""
        return sorted(
            short_path(n, str(v)) for n, node in self.tree.children.items() for v in node.to_dataset().variables
        )

    def matching(self, pattern: str) -> list[str]:
        """The paths that match `current_*`, `calibration/*`, `*` (the array's own), ..."""
        node, name = split_path(pattern)
        return [p for p in self.paths() if split_path(p)[0] == node and fnmatchcase(split_path(p)[1], name)]

    def __contains__(self, path: object) -> bool:
        node, name = split_path(str(path))
        return node in self.tree.children and name in self.tree[node].to_dataset().variables

    def __iter__(self) -> Iterator[str]:
        return iter(self.paths())

    def __getitem__(self, path: str) -> xr.DataArray:
        node, name = split_path(path)
        if path not in self:
            from magtensor.errors import did_you_mean

            raise DataError(
                f"the survey has no {path}{did_you_mean(path, self.paths())}",
                where=str(self.attributes.get("source", "")),
                hint=f"it has {', '.join(self.paths()) or 'nothing'}",
            )
        found: xr.DataArray = self.tree[node].to_dataset()[name]
        return found

    def values(self, path: str) -> NDArray[Any]:
        """The bare array of a variable."""
        found: NDArray[Any] = self[path].values
        return found

    @property
    def sensors(self) -> list[str]:
        """The sensors' names."""
        return [str(s) for s in self.values("sensor")]

    @property
    def time(self) -> NDArray[np.float64]:
        """(N,) s, on the epoch given by the units attribute of `time`."""
        return np.asarray(self.values("time"), dtype=np.float64)

    @property
    def good(self) -> NDArray[np.bool_]:
        """(N,) True where every sensor's sample may be used; all True before anything was flagged."""
        return np.asarray(self.good_by_sensor.all(axis=1))

    @property
    def good_by_sensor(self) -> NDArray[np.bool_]:
        """(N, S) True where the sensor's sample may be used."""
        if "good" in self:
            return np.asarray(self.values("good"), dtype=bool)
        return np.ones((len(self.time), len(self.sensors)), dtype=bool)

    @property
    def readings_by_sensor(self) -> NDArray[np.bool_]:
        """(N, S) True where the sensor's sample may be used and is a reading, none that was repeated or interpolated to
        fill a row: what a calibration is fitted to."""
        if "is_reading" in self:
            return np.asarray(self.good_by_sensor & self.values("is_reading"))
        return self.good_by_sensor

    @property
    def readings(self) -> NDArray[np.bool_]:
        """(N,) the same of all sensors at once."""
        return np.asarray(self.readings_by_sensor.all(axis=1))

    def made_from(self, bad: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(N,) bad readings, and the rows that were filled in from one of them."""
        at = np.flatnonzero(self.readings)
        if "is_reading" not in self or not bad.any() or not len(at):
            return bad
        row = np.arange(len(bad))
        before = at[np.maximum(np.searchsorted(at, row, side="right") - 1, 0)]
        after = at[np.minimum(np.searchsorted(at, row), len(at) - 1)]
        return np.asarray(bad | (~self.readings & (bad[before] | bad[after])))


def without_variables(survey: Survey, *paths: str) -> Survey:
    """The survey without some of its variables."""
    from dataclasses import replace

    import xarray as xr

    nodes = {name: node.to_dataset() for name, node in survey.tree.children.items()}
    for path in paths:
        node, name = split_path(path)
        nodes[node] = nodes[node].drop_vars(name)
    return replace(survey, tree=xr.DataTree.from_dict({f"/{n}": d for n, d in nodes.items()}))
