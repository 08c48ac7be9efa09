"""Recipes as hostile text: every refusal names the line, nothing is ever constructed, nothing explodes."""

from __future__ import annotations

import pytest

from magtensor.errors import UsageError
from magtensor.recipe.source import MAX_BYTES, load_yaml, parse_scalar, parse_yaml


def refusal(text: str) -> str:
    with pytest.raises(UsageError) as caught:
        parse_yaml(text, "r.yaml")
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001), ("1E5", 1e5), ("-1.5e+2", -150.0), (".5", 0.5), ("5.", 5.0), ("007", 7), ("+3", 3),
        ("0x1F", 31), ("0o17", 15), ("-.inf", float("-inf")), ("true", True), ("FALSE", False), ("~", None),
        ("null", None), ("yes", "yes"), ("No", "No"), ("on", "on"), ("off", "off"), ("y", "y"),
        ("2020-01-01", "2020-01-01"), ("2020-01-01T00:00:00Z", "2020-01-01T00:00:00Z"), ("12:30:45", "12:30:45"),
        ("1_000", "1_000"), ("0b11", "0b11"), ("'12'", "12"), ('"true"', "true"), ("1e", "1e"), (".", "."),
        ("1.2.3", "1.2.3"), ("nan", "nan"), ("inf", "inf"), ("|\n 12\n", "12\n"), ("=", "="),
    ],
)  # fmt: skip
def test_scalars_mean_what_they_look_like(text, value):
    found = parse_yaml(f"a: {text}", "r.yaml").value["a"]
    assert found == value
    assert type(found) is type(value)


def test_not_a_number():
    assert parse_yaml("a: .nan", "r.yaml").value["a"] != parse_yaml("a: .NaN", "r.yaml").value["a"]


@pytest.mark.parametrize(
    "tagged",
    [
        "!!python/object/apply:os.system ['echo harm']", "!!python/name:os.system", "!!python/tuple [1]",
        "!!python/object/new:subprocess.Popen [['ls']]", "!own x", "!!binary aGFybQ==", "!!set {a, b}",
        "!!timestamp 2020-01-01", "!!omap [a: 1]", "!<tag:example.com,2000:x> 1", "!!int x", "!!float [1]", "!!map [1]",
        "!!seq {a: 1}", "!!merge x", "!!bool {}", "!!null []",
    ],
)  # fmt: skip
def test_tags_are_refused_with_their_line(tagged):
    message = refusal(f"title: t\nsurvey:\n  file: {tagged}\n")
    assert message.startswith("r.yaml:3: ")
    assert message.count("\n") == 0


def test_billion_laughs():
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    assert "aliases expand to more than" in refusal("\n".join(lines))


def test_billion_laughs_in_mappings():
    lines = ["a0: &a0 {x: 1}"]
    lines += [f"a{i}: &a{i} {{{', '.join(f'k{j}: *a{i - 1}' for j in range(9))}}}" for i in range(1, 12)]
    assert "aliases expand to more than" in refusal("\n".join(lines))


@pytest.mark.parametrize("text", ["a: &x [*x]", "a: &x {b: *x}", "&x [1, [2, *x]]", "a: &x\n  b: [1, {c: *x}]"])
def test_alias_that_contains_itself(text):
    assert "an alias contains itself" in refusal(text)


def test_alias_twice_is_fine():
    assert parse_yaml("a: &x [1, 2]\nb: *x\nc: *x", "r.yaml").value == {"a": [1, 2], "b": [1, 2], "c": [1, 2]}


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("a: 1\nb: 2\na: 3", 3, "the key 'a' stands twice in one mapping (first on line 1)"),
        ("a:\n  b: 1\n  c: {d: 1, d: 2}", 3, "the key 'd' stands twice"),
        ("1: x\n0x1: y", 2, "stands twice"),
        ("a: &x {b: 1}\nc:\n  <<: *x\n", 3, "merge keys (<<) are not allowed"),
        ("a:\n\tb: 1", 2, "not valid YAML"),
        ("a: [1, 2\nb: 3", 2, "not valid YAML"),
        ("a: 'open", 1, "not valid YAML"),
        ("a: *nowhere", 1, "not valid YAML"),
        ("a: 1\n---\nb: 2", 2, "not valid YAML"),
        ("? [1, 2]\n: x", 1, "a key must be a plain word"),
        ("a: 1\n  b: 2", 2, "not valid YAML"),
        ("%YAML 9.9\n---\na: 1", 1, "not valid YAML"),
        ("a: " + "9" * 5000, 1, "is not a number"),
    ],
)
def test_refusals_name_the_line(text, line, words):
    message = refusal(text)
    assert message.startswith(f"r.yaml:{line}: ")
    assert words in message


@pytest.mark.parametrize("text", ["", "\n\n", "# only a comment\n", "---\n", "---\n...\n"])
def test_empty(text):
    try:
        assert parse_yaml(text, "r.yaml").value is None
    except UsageError as error:
        assert str(error) == "r.yaml: empty"


@pytest.mark.parametrize("opening", ["[", "{a: ", "- "])
@pytest.mark.parametrize("depth", [60, 3000, 100_000])
def test_deep_nesting(opening, depth):
    assert "deep" in refusal(opening * depth + "1") or "not valid YAML" in refusal(opening * depth + "1")
    closing = {"[": "]", "{a: ": "}", "- ": ""}[opening]
    assert "deep" in refusal(opening * depth + "1" + closing * depth)


def test_nul_and_control_characters():
    assert "not valid YAML" in refusal("a: \x00")
    assert "not valid YAML" in refusal("a: \x07")


def test_files(tmp_path):
    path = tmp_path / "r.yaml"

    def message() -> str:
        with pytest.raises(UsageError) as caught:
            load_yaml(path)
        assert str(path) in str(caught.value)
        return str(caught.value)

    assert "No such file" in message()
    path.write_bytes("title: Länge\n".encode("latin-1"))
    assert "not UTF-8" in message()
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    assert "is this a recipe?" in message()
    path.write_bytes(b"a: " + b"x" * MAX_BYTES)
    assert "larger than" in message()
    path.unlink()
    path.mkdir()
    assert "directory" in message()


def test_byte_order_mark_and_line_ends(tmp_path):
    path = tmp_path / "r.yaml"
    path.write_bytes("\ufefftitle: t\r\nstages:\r\n  - a\r\n".encode())
    document = load_yaml(path)
    assert document.value == {"title": "t", "stages": ["a"]}
    assert document.where(("stages", 0)) == f"{path}:3"


def test_every_value_knows_its_line():
    text = "# head\ntitle: t\n\nstages:\n  - load\n  - align:\n      to: S1\n\n      list:\n        - 1\n        - x: 2"
    document = parse_yaml(text, "r.yaml")
    wanted = {
        ("title",): 2, ("stages",): 4, ("stages", 0): 5, ("stages", 1): 6, ("stages", 1, "align"): 6,
        ("stages", 1, "align", "to"): 7, ("stages", 1, "align", "list", 0): 10,
        ("stages", 1, "align", "list", 1, "x"): 11,
    }  # fmt: skip
    assert {place: document.lines[place] for place in wanted} == wanted
    assert document.where(("stages", 1, "align", "unknown", "deeper")) == "r.yaml:6", "the deepest place that is known"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("12.5", 12.5), ("true", True), ("[1, 2]", [1, 2]), ("{a: 1}", {"a": 1}), ("", ""), ("S1", "S1"),
        ("a=b", "a=b"), ("[1,", "[1,"), ("!!python/name:os.system", "!!python/name:os.system"), ("null", None),
        ("  ", ""),
    ],
)  # fmt: skip
def test_values_of_the_command_line(text, value):
    assert parse_scalar(text) == value
