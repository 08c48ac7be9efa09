"""Whether a survey is done: its result is there, whole, and made from the same recipe, data and code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from magtensor import provenance, result
from magtensor.errors import MagtensorError
from magtensor.provenance import Provenance
from magtensor.recipe.plan import Plan
from magtensor.survey.tables import existing

LOCATION = ("file", "files")  # of the survey section: where the data lie says nothing of what they are; nor `verify`


def why_run(folder: Path, planned: Plan) -> str:
    """Why the survey must be run, in words; nothing if its result in `folder` is what the plan would make.

    The files themselves are asked, not `batch.json`: a batch killed between a result and its record has lost nothing,
    and a result that was replaced or damaged since is not trusted.
    """
    path = folder / result.RESULT
    if not path.is_file():
        return "no result yet"
    try:
        before = provenance.read(path)
    except MagtensorError:
        return f"{result.RESULT} cannot be read"
    try:
        verify = planned.verify and existing([planned.verify])[0]
        now = provenance.collect(planned, (), planned.source().files(), verify)
    except MagtensorError as error:
        return f"input changed: {_first_line(error)}"
    return _changed(before, now) or _damage(folder, before)


def _changed(before: Provenance, now: Provenance) -> str:
    place = first_difference(_comparable(before.recipe), _comparable(now.recipe))
    if place:
        return f"recipe changed: {place}"
    then, today = ([i["sha256"] for i in p.inputs] for p in (before, now))
    if then != today:
        names = [Path(i["path"]).name for i in now.inputs if i["sha256"] not in then]
        return f"input changed: {', '.join(names) or 'their number or order'}"
    libraries = set(provenance.LIBRARIES) | {"python"}
    code = [line for line in provenance.differences(before, now) if line.split(" ", 1)[0] not in libraries]
    return f"code changed: {'; '.join(code)}" if code else ""


def _comparable(recipe: Mapping[str, Any]) -> Any:
    plain = json.loads(json.dumps(recipe, default=str))
    plain.pop("verify", None)
    if isinstance(plain.get("survey"), dict):
        plain["survey"] = {k: v for k, v in plain["survey"].items() if k not in LOCATION}
    return plain


def first_difference(one: Any, other: Any, at: str = "") -> str:
    """The place of the first difference between two plain values, as in `stages[2].align.to`; nothing if none."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in [*one, *(k for k in other if k not in one)]:
            place = f"{at}.{key}" if at else str(key)
            if (key in one) != (key in other):
                return place
            if inner := first_difference(one[key], other[key], place):
                return inner
        return ""
    if isinstance(one, list) and isinstance(other, list):
        for i in range(max(len(one), len(other))):
            if i >= len(one) or i >= len(other):
                return f"{at}[{i}]"
            if inner := first_difference(one[i], other[i], f"{at}[{i}]"):
                return inner
        return ""
    return "" if one == other and type(one) is type(other) else at


def _damage(folder: Path, before: Provenance) -> str:
    """What is wrong with the files of a result; nothing if they hold what was written."""
    try:
        outcome = json.loads((folder / result.VERDICT).read_text(encoding="utf-8"))
        if not isinstance(outcome, dict):
            return f"{result.VERDICT} is damaged"
    except (OSError, ValueError):
        return f"{result.VERDICT} is missing or damaged"
    try:
        with _opened(folder / result.RESULT) as tree:
            if provenance.content_sha256(tree) != before.content_sha256:
                return f"{result.RESULT} is not what was written"
            if "calibration" not in tree.children:
                return ""
            import xarray as xr

            calibration = xr.DataTree.from_dict({"/calibration": tree["calibration"].to_dataset()})
            expected = provenance.content_sha256(calibration)
    except Exception:  # h5py and xarray raise whatever a wrong byte leads them to
        return f"{result.RESULT} is damaged"
    try:
        with _opened(folder / result.CALIBRATION) as tree:
            whole = provenance.content_sha256(tree) == expected
    except Exception:
        whole = False
    return "" if whole else f"{result.CALIBRATION} is missing or damaged"


def _opened(path: Path) -> Any:
    import xarray as xr

    # cache=False: variable after variable, never the whole survey in memory
    return xr.open_datatree(path, engine="h5netcdf", decode_times=False, cache=False)


def _first_line(error: Exception) -> str:
    return str(error).split("\n", 1)[0]
