"""`PATH=VALUE` texts of the command line, applied to a document that has been read."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

from magtensor.errors import UsageError, did_you_mean
from magtensor.recipe.source import Document, Location, parse_scalar


def override(document: Document, text: str) -> Document:
    """Apply one `PATH=VALUE`.

    The path's parts are joined by dots; a stage is named by its name or its number (from 0).

    Raises:
        UsageError: no `=`, or the path leads nowhere.
    """
    path, equals, value_text = text.partition("=")
    if not equals or not path.strip():
        raise UsageError(f"--set {text}: must read PATH=VALUE, for instance stages.align.to=S1")
    value = copy.deepcopy(document.value)
    here: Any = value
    at: list[str | int] = []
    parts = path.strip().split(".")
    if parts[0] == "survey" and len(parts) > 1 and isinstance(value, dict) and isinstance(value.get("survey"), str):
        value["survey"] = {"file": value["survey"]}
    for i, part in enumerate(parts):
        last = i == len(parts) - 1
        if isinstance(here, list):
            found, place = _items(here, part), ".".join(parts[:i])
            if not found:
                names = [n for item in here if (n := item_name(item))]
                raise UsageError(f"--set {text}: there is no {part} in {place}{did_you_mean(part, names)}")
            if len(found) > 1:
                ways = " or ".join(f"{place}.{n}.{part}" for n in found)
                raise UsageError(f"--set {text}: {place} has {part} more than once; say which: {ways}")
            number = found[0]
            at.append(number)
            if isinstance(here[number], str):
                here[number] = {here[number]: {}}
            if not part.isdecimal():
                at.append(part)
                if here[number][part] is None:
                    here[number][part] = {}
                if last:
                    here[number][part] = parse_scalar(value_text)
                here = here[number][part]
            else:
                if last:
                    here[number] = parse_scalar(value_text)
                here = here[number]
        elif isinstance(here, dict):
            at.append(part)
            if last:
                here[part] = parse_scalar(value_text)
            elif here.get(part) is None:
                here[part] = {}
            here = here[part]
        else:
            raise UsageError(f"--set {text}: {'.'.join(parts[:i])} is a single value and has no {part}")
    lines = {k: n for k, n in document.lines.items() if k[: len(at)] != tuple(at)}
    return _Overridden(value, document.file, lines, document.folder, {**_set_of(document), tuple(at): text})


@dataclass(frozen=True)
class _Overridden(Document):
    """A document some of whose values came from the command line."""

    set_by: dict[Location, str] = field(default_factory=dict)

    def where(self, location: Location) -> str:
        for n in range(len(location), 0, -1):
            if location[:n] in self.set_by:
                return f"--set {self.set_by[location[:n]]}"
            if location[:n] in self.lines:
                break
        return super().where(location)


def _set_of(document: Document) -> dict[Location, str]:
    return document.set_by if isinstance(document, _Overridden) else {}


def item_name(item: Any) -> str | None:
    """The name of a stage in the list: the item itself, or the one key of a mapping."""
    if isinstance(item, dict) and len(item) == 1:
        item = next(iter(item))
    return item if isinstance(item, str) else None


def _items(items: list[Any], part: str) -> list[int]:
    if part.isdecimal():
        return [int(part)] if int(part) < len(items) else []
    return [i for i, item in enumerate(items) if item_name(item) == part]
