"""Mistakes in a recipe: collected, then told all at once with file and line."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from magtensor.errors import UsageError, did_you_mean
from magtensor.recipe.source import Document, Location

if TYPE_CHECKING:
    from pydantic import BaseModel

    Model = TypeVar("Model", bound=BaseModel)

# pydantic speaks of JSON, a recipe is YAML
YAML_WORDS = {
    "list_type": "a list", "tuple_type": "a list", "set_type": "a list",
    "dict_type": "a mapping", "model_type": "a mapping", "model_attributes_type": "a mapping",
}  # fmt: skip


@dataclass
class Problems:
    """Collects mistakes in one document."""

    document: Document
    found: list[tuple[int, str]] = field(default_factory=list)

    def add(self, at: Location, message: str) -> None:
        """A mistake at a place in the document."""
        line = f"{self.document.where(at)}: {dotted(at)}{message}"
        number = next((self.document.lines[at[:n]] for n in range(len(at), -1, -1) if at[:n] in self.document.lines), 0)
        if (number, line) not in self.found:
            self.found.append((number, line))

    def raise_if_any(self) -> None:
        """Tell them all, in the order of the file.

        Raises:
            UsageError: with one line a mistake.
        """
        if self.found:
            raise UsageError("\n".join(line for _, line in sorted(self.found, key=lambda pair: pair[0])))

    def validated(self, model: type[Model], value: Any, at: Location) -> Model | None:
        """The value as this pydantic model; None, with the mistakes collected, where it does not fit."""
        from pydantic import ValidationError

        if not isinstance(value, dict):
            self.add(at, f"must be a mapping of options, not {_shown(value)}")
            return None
        try:
            # JSON mode: strict about types, yet a list may become a tuple and a string a path
            return model.model_validate_json(json.dumps(value))
        except ValidationError as error:
            for one in error.errors(include_url=False):
                self._add_pydantic(one, value, at, model)
            return None

    def _add_pydantic(self, error: Any, value: Any, at: Location, model: type[BaseModel]) -> None:
        trail, here = _walk(value, error["loc"])
        kind, place = error["type"], (*at, *trail)
        if kind == "extra_forbidden":
            known = _known_keys(model, error["loc"][:-1])
            near = did_you_mean(str(trail[-1]), known) or (f"; known here: {', '.join(known)}" if known else "")
            self.add(place, f"unknown key{near}")
        elif kind == "union_tag_not_found":
            self.add(place, f"needs {error['ctx']['discriminator'].strip(chr(39))!r}, which says what it is")
        elif kind == "union_tag_invalid":
            context = error["ctx"]
            names = [w.strip("' ") for w in context["expected_tags"].split(",")]
            near = did_you_mean(str(context["tag"]), names) or f"; there are {', '.join(names)}"
            self.add((*place, context["discriminator"].strip("'")), f"there is no {context['tag']!r}{near}")
        elif kind == "too_short":
            self.add(place, f"needs {error['ctx']['min_length']} or more, not {error['ctx']['actual_length']}")
        elif kind == "missing":
            self.add(place, f"needs {str(error['loc'][-1])!r}")
        elif kind == "literal_error":
            expected = str(error["ctx"]["expected"])
            names = [w.strip("' ") for w in expected.replace(" or ", ",").split(",")]
            self.add(place, f"must be {expected}, not {_shown(here)}{did_you_mean(str(here), names)}")
        elif kind in YAML_WORDS:
            self.add(place, f"must be {YAML_WORDS[kind]}, not {_shown(here)}")
        else:
            message = str(error["msg"]).removeprefix("Value error, ")
            self.add(place, f"{message[:1].lower()}{message[1:]}, not {_shown(here)}" if _scalar(here) else message)


def dotted(at: Sequence[str | int]) -> str:
    """`stages[2].align.to: ` for a location, nothing for the whole document."""
    text = ""
    for part in at:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return f"{text}: " if text else ""


def _walk(value: Any, location: Sequence[str | int]) -> tuple[tuple[str | int, ...], Any]:
    """The part of pydantic's location that exists in the value (it also names union branches), and what is there."""
    trail: list[str | int] = []
    here = value
    for part in location:
        if isinstance(here, dict):
            key = next((k for k in here if str(k) == str(part)), None)
            if key is None:
                continue
            trail.append(key)
            here = here[key]
        elif isinstance(here, list) and isinstance(part, int) and part < len(here):
            trail.append(part)
            here = here[part]
    return tuple(trail), here


def _known_keys(model: type[BaseModel], location: Sequence[str | int]) -> list[str]:
    """The keys of the (nested) model at pydantic's location, which names fields, places in lists and union branches."""
    current = [model]
    for part in location:
        inside = [m for c in current if part in c.model_fields for m in _models(c.model_fields[str(part)].annotation)]
        current = inside or [c for c in current if part == c.__name__ or _is_tagged(c, part)] or current
    return sorted({f.alias or n for c in current for n, f in c.model_fields.items()})


def _models(annotation: Any) -> list[type[BaseModel]]:
    """The models that a value of this type may be, or hold."""
    from pydantic import BaseModel

    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for inner in get_args(annotation) for m in _models(inner)]


def _is_tagged(model: type[BaseModel], tag: str | int) -> bool:
    """Whether it is the branch of a union that a field's only value names."""
    return any(get_args(f.annotation) == (tag,) for f in model.model_fields.values())


def _scalar(value: Any) -> bool:
    return not isinstance(value, (dict, list))


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    return "nothing" if value is None else repr(value)
