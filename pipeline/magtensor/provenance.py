"""Where a result comes from: enough to make it again and get the same bits on the same machine."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import magtensor
from magtensor.errors import DataError, UsageError

if TYPE_CHECKING:
    import xarray as xr

    from magtensor.recipe.plan import Plan
    from magtensor.runner import StageRecord
    from magtensor.survey.in_memory import Held

LIBRARIES = ("numpy", "scipy", "h5py", "h5netcdf", "xarray", "pydantic", "pluggy", "pyyaml")
GROUP = "provenance"
VERIFICATION = "verification"  # the role of an input that the fit did not see
HASHED_AT_ONCE = 65536  # rows


@dataclass(frozen=True)
class Provenance:
    """What made a result.

    Attributes:
        recipe: the resolved recipe, every default written out.
        inputs: path, SHA-256 and size of each file read; `role` of one that only verifies.
        versions: of the package, Python and the libraries.
        plugins: distribution and version, or file and SHA-256, of each plugin that took part.
        stages: what each stage did, in order.
        content_sha256: over every array of the result but this group.
    """

    recipe: Mapping[str, Any]
    inputs: Sequence[Mapping[str, Any]]
    versions: Mapping[str, str]
    plugins: Sequence[Mapping[str, str]]
    stages: Sequence[Mapping[str, Any]]
    content_sha256: str = ""
    notes: Mapping[str, str] = field(default_factory=dict)

    def attributes(self) -> dict[str, str]:
        """As the attributes of the group `/provenance`, each JSON text (the content hash bare)."""
        parts = {k: getattr(self, k) for k in ("recipe", "inputs", "versions", "plugins", "stages", "notes")}
        return {k: json.dumps(v, indent=1, default=str) for k, v in parts.items()} | {
            "content_sha256": self.content_sha256
        }

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, Any]) -> Provenance:
        """The inverse of `attributes`.

        Raises:
            KeyError, ValueError: the attributes are not what `attributes` made.
        """
        parts = {k: json.loads(attributes[k]) for k in ("recipe", "inputs", "versions", "plugins", "stages", "notes")}
        for name in ("inputs", "plugins", "stages"):
            if not isinstance(parts[name], list) or not all(isinstance(entry, dict) for entry in parts[name]):
                raise ValueError(f"{name} is no list of mappings")
        for name in ("versions", "notes"):
            if not isinstance(parts[name], dict):
                raise ValueError(f"{name} is no mapping")
        return cls(**parts, content_sha256=str(attributes["content_sha256"]))


def collect(
    plan: Plan, records: Iterable[StageRecord], inputs: Iterable[Path | Held], verify: Path | Held | None = None
) -> Provenance:
    """The provenance of a run that succeeded, verified with another survey or not."""
    used = {id(c) for stage in plan.stages for c in stage.uses}
    readers = {key for key in plan.registry.components if key[0] == "reader"}
    plugins = {
        plan.registry.origin[key].origin: plan.registry.origin[key].as_dict()
        for key, component in plan.registry.components.items()
        if id(component) in used or key in readers
    }
    return Provenance(
        recipe=plan.resolved(),
        inputs=[*(facts(i) for i in inputs), *([facts(verify) | {"role": VERIFICATION}] if verify else [])],
        versions=versions(),
        plugins=list(plugins.values()),
        stages=[r.as_dict() for r in records],
        notes={"recipe_file": plan.file, "folder": str(plan.folder.resolve())},
    )


def versions() -> dict[str, str]:
    """Versions of the package, Python and the libraries."""
    found = {"magtensor": magtensor.__version__, "python": platform.python_version()}
    for library in LIBRARIES:
        found[library] = importlib.metadata.version(library)
    return found


def facts(given: Path | Held) -> dict[str, Any]:
    """Path, SHA-256 and size of a file, or of a survey in memory."""
    if not isinstance(given, Path):
        return given.facts()
    try:
        return {"path": str(given.resolve()), "sha256": sha256(given), "bytes": given.stat().st_size}
    except OSError as error:
        raise DataError((error.strerror or str(error)).lower(), where=str(given)) from error


def sha256(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def content_sha256(tree: xr.DataTree) -> str:
    """SHA-256 over every variable's path, type, shape and bytes, `/provenance` left out."""
    import numpy as np

    digest = hashlib.sha256()
    for node in sorted(tree.subtree, key=lambda n: n.path):
        if node.path.startswith(f"/{GROUP}"):
            continue
        dataset = node.to_dataset(inherit=False)
        for name in sorted(str(v) for v in dataset.variables):
            variable = dataset[name].variable
            kind = variable.dtype.kind
            if kind in "OUST":
                values = np.asarray([str(v) for v in variable.values.ravel()], dtype="U").reshape(variable.shape)
                digest.update(f"{node.path}/{name}:{values.shape}:{values.dtype.kind}".encode())
                digest.update("\0".join(values.ravel().tolist()).encode())
                continue
            stored = "i" if kind == "b" else kind
            digest.update(f"{node.path}/{name}:{variable.shape}:{stored}".encode())
            # piece by piece: the tree may be a file that does not fit into the memory
            for start in range(0, variable.shape[0], HASHED_AT_ONCE) if variable.shape else (None,):
                part = variable if start is None else variable[start : start + HASHED_AT_ONCE]
                values = np.asarray(part.values)
                digest.update(np.ascontiguousarray(values.astype("int8") if kind == "b" else values).tobytes())
    return digest.hexdigest()


def read(path: Path) -> Provenance:
    """The provenance of a result or calibration file.

    Raises:
        UsageError: the file is not there, is no HDF5, or carries no provenance.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            if GROUP not in file:
                raise UsageError(f"{path}: has no group /{GROUP}: it is no result.nc or calibration.nc of magtensor")
            return Provenance.from_attributes(dict(file[GROUP].attrs))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read as HDF5: {error}") from error
    except (KeyError, ValueError) as error:
        raise UsageError(f"{path}: its /{GROUP} is damaged: {error}") from error


def plan_again(
    path: Path,
    before: Provenance,
    *,
    overrides: Sequence[str] = (),
    plugin_folders: Sequence[Path] = (),
    survey: Path | None = None,
    verify: Path | None = None,
) -> Plan:
    """The plan of a result, from its provenance."""
    from magtensor.recipe.plan import plan
    from magtensor.recipe.source import Document

    folder = Path(before.notes.get("folder", "."))
    document = Document(before.recipe, f"{path}:/provenance", {}, folder)
    return plan(document, overrides=overrides, plugin_folders=plugin_folders, survey=survey, verify=verify)


def check_inputs(provenance: Provenance, *, survey: bool, verification: bool) -> None:
    """The inputs that are to be read again, the survey's or the one that verifies or both, are still what they were.

    Raises:
        DataError: a file is gone or has changed.
    """
    for entry in provenance.inputs:
        verifies = entry.get("role") == VERIFICATION
        what, option = ("the verification survey", "--verify") if verifies else ("an input", "--input")
        if not (verification if verifies else survey):
            continue
        path = Path(entry["path"])
        if not path.is_file():
            raise DataError(f"{what} of this result is no longer there", where=str(path), hint=f"name it with {option}")
        if sha256(path) != entry["sha256"]:
            raise DataError(
                f"this {what.split(' ', 1)[1]} has changed since the result was made",
                where=str(path),
                hint=f"its SHA-256 was {entry['sha256']}; name the original with {option}",
            )


def differences(then: Provenance, now: Provenance) -> list[str]:
    """In words, what is not as it was: the verification survey, versions of the package, libraries and plugins."""
    lines = [
        f"{name} was {old}, is {now.versions.get(name, 'not there')}"
        for name, old in then.versions.items()
        if now.versions.get(name) != old
    ]
    verified = [next((i for i in p.inputs if i.get("role") == VERIFICATION), None) for p in (then, now)]
    if len({v and v["sha256"] for v in verified}) > 1:
        was, is_ = (v["path"] if v else "none" for v in verified)
        lines.append(f"the verification survey was {was}, is {is_}")
    current = {_plugin_label(p): p for p in now.plugins}
    for plugin in then.plugins:
        label = _plugin_label(plugin)
        for key in ("version", "sha256"):
            found = current.get(label, {}).get(key, "not there")
            if key in plugin and found != plugin[key]:
                lines.append(f"plugin {label}: {key} was {plugin[key]}, is {found}")
    return lines


def _plugin_label(plugin: Mapping[str, str]) -> str:
    """Its name, with the distribution: many packages call their entry point `stages`."""
    return f"{plugin['name']} of {plugin['distribution']}" if plugin.get("distribution") else plugin["name"]
