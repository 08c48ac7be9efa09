"""YAML read safely, with the line of every value.

Plain YAML only: no tags, no duplicate keys, aliases within bounds. `yes`, `on` and dates stay strings, `1e-3`
is a number: what a recipe means must not depend on YAML 1.1 surprises.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from magtensor.errors import UsageError

MAX_BYTES = 1_000_000
MAX_NODES = 100_000  # after aliases are expanded; a recipe has some hundreds
MAX_DEPTH = 50
TAG = "tag:yaml.org,2002:"

Location = tuple[str | int, ...]


@dataclass(frozen=True)
class Document:
    """A YAML document as plain Python values.

    Attributes:
        value: dicts, lists, strings, numbers, booleans, None.
        file: how messages call the file.
        lines: the line of each value by its path, 1-based; a mapping key's own line for its value.
        folder: what relative paths in it are relative to.
    """

    value: Any
    file: str
    lines: dict[Location, int] = field(default_factory=dict)
    folder: Path = Path()

    def where(self, location: Location) -> str:
        """`recipe.yaml:12` for the deepest known part of the location."""
        for n in range(len(location), -1, -1):
            if location[:n] in self.lines:
                return f"{self.file}:{self.lines[location[:n]]}"
        return self.file


def load_yaml(path: str | Path) -> Document:
    """Read a recipe or scenario file.

    Raises:
        UsageError: missing, unreadable, too large, not UTF-8, or not plain YAML; with file and line.
    """
    path = Path(path)
    try:
        if path.is_file() and path.stat().st_size > MAX_BYTES:
            raise UsageError(f"{path}: larger than {MAX_BYTES} bytes; a recipe is a page of YAML")
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: not UTF-8 text (byte {error.start}); is this a recipe?") from error
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error
    return parse_yaml(text, str(path), path.resolve().parent)


def parse_yaml(text: str, file: str, folder: Path = Path()) -> Document:
    """Parse YAML text; as `load_yaml`."""
    try:
        root = yaml.compose(text, Loader=_PlainLoader)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        what = " ".join(str(p) for p in (error.context, error.problem) if p)
        raise UsageError(f"{file}:{line}: not valid YAML: {what}") from error
    except yaml.YAMLError as error:
        raise UsageError(f"{file}: not valid YAML: {error}") from error
    except RecursionError as error:
        raise UsageError(f"{file}: nested too deeply") from error
    if root is None:
        raise UsageError(f"{file}: empty")
    reader = _Reader(file)
    value = reader.read(root, ())
    return Document(value, file, reader.lines, folder)


class _PlainLoader(yaml.SafeLoader):
    """YAML 1.2's core scalars in place of YAML 1.1's."""


_PlainLoader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in [
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+0123456789.",
    ),
    ("merge", r"<<", "<"),
]:
    _PlainLoader.add_implicit_resolver(f"{TAG}{_tag}", re.compile(f"^(?:{_pattern})$"), list(_first))


class _Reader:
    """Turns the node graph into values, counting what aliases expand to."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.lines: dict[Location, int] = {}
        self.count = 0
        self.open: set[int] = set()

    def fail(self, node: yaml.Node, what: str) -> UsageError:
        return UsageError(f"{self.file}:{node.start_mark.line + 1}: {what}")

    def read(self, node: yaml.Node, at: Location) -> Any:
        self.count += 1
        if self.count > MAX_NODES:
            raise self.fail(node, f"aliases expand to more than {MAX_NODES} values")
        if len(at) > MAX_DEPTH:
            raise self.fail(node, f"nested deeper than {MAX_DEPTH} levels")
        if id(node) in self.open:
            raise self.fail(node, "an alias contains itself")
        self.lines.setdefault(at, node.start_mark.line + 1)
        self.open.add(id(node))
        try:
            if isinstance(node, yaml.MappingNode):
                self.require_tag(node, "map")
                return self.mapping(node, at)
            if isinstance(node, yaml.SequenceNode):
                self.require_tag(node, "seq")
                return [self.read(child, (*at, i)) for i, child in enumerate(node.value)]
            return self.scalar(node)
        finally:
            self.open.discard(id(node))

    def require_tag(self, node: yaml.Node, *kinds: str) -> None:
        if node.tag not in {f"{TAG}{kind}" for kind in kinds}:
            raise self.fail(node, f"the tag {node.tag} is not allowed here; recipes are plain YAML without tags")

    def mapping(self, node: yaml.MappingNode, at: Location) -> dict[Any, Any]:
        found: dict[Any, Any] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise self.fail(key_node, "a key must be a plain word")
            if key_node.tag == f"{TAG}merge":
                raise self.fail(key_node, "merge keys (<<) are not allowed; write the options out")
            key = self.scalar(key_node)
            if key in found:
                raise self.fail(
                    key_node, f"the key {key!r} stands twice in one mapping (first on line {self.lines[(*at, key)]})"
                )
            self.lines[(*at, key)] = key_node.start_mark.line + 1
            found[key] = self.read(value_node, (*at, key))
        return found

    def scalar(self, node: yaml.Node) -> Any:
        self.require_tag(node, "str", "null", "bool", "int", "float")
        kind = node.tag.removeprefix(TAG)
        text = str(node.value)
        try:
            if kind == "str":
                return text
            if kind == "null":
                return None
            if kind == "bool":
                return text.lower() == "true"
            if kind == "int":
                return int(text, 0) if text[:2] in ("0x", "0o") else int(text)
            return float(re.sub(r"\.(?=[inIN])", "", text))  # .inf and .nan
        except ValueError as error:
            raise self.fail(node, f"{text[:40]!r} is not a number") from error


def parse_scalar(text: str) -> Any:
    """A value given on the command line, read as YAML: `12.5`, `true`, `[1, 2]`, or a string."""
    try:
        return parse_yaml(text, "value").value if text.strip() else ""
    except UsageError:
        return text
