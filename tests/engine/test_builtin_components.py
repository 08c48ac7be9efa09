"""Every stage, method, reader and metric that is built in explains itself."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys

import pytest

from magtensor.components import Component
from magtensor.listing import describe, show_one
from magtensor.registry import Registry

REGISTRY = Registry.load()
BUILT_IN = {key: c for key, c in REGISTRY.components.items() if REGISTRY.origin[key].distribution == "magtensor"}


LISTED = describe(REGISTRY)["components"]


def label(key: tuple[str, str, str]) -> str:
    return " ".join(part for part in key if part)


def test_all_of_them_load():
    assert REGISTRY.problems == []
    assert [p.error for p in REGISTRY.plugins if p.distribution == "magtensor" and p.error] == []
    assert {kind for kind, _, _ in BUILT_IN} >= {"stage", "method", "reader", "metric"}


@pytest.mark.parametrize("key", sorted(BUILT_IN), ids=label)
def test_it_has_a_summary(key):
    component: Component = BUILT_IN[key]
    assert component.function.__doc__, "no docstring"
    assert component.summary.rstrip(")").endswith("."), "the docstring begins with a sentence"
    assert len(component.summary) < 250


@pytest.mark.parametrize("key", sorted(BUILT_IN), ids=label)
def test_each_option_has_a_description(key):
    model = BUILT_IN[key].options
    missing = [name for name, field in model.model_fields.items() if not (field.description or "").strip()]
    assert missing == []
    schema = model.model_json_schema()
    assert schema["additionalProperties"] is False


@pytest.mark.parametrize("key", sorted(BUILT_IN), ids=label)
def test_every_keyword_of_the_function_is_listed_as_an_option(key):
    (listed,) = [c for c in LISTED if (c["kind"], c.get("stage", ""), c["name"]) == key]
    keywords = [p for p in inspect.signature(BUILT_IN[key].function).parameters.values() if p.kind is p.KEYWORD_ONLY]
    assert list(listed["options"].get("properties", {})) == [p.name for p in keywords]
    required = {p.name for p in keywords if p.default is p.empty}
    assert set(listed["options"].get("required", [])) == required


def test_the_error_models_and_methods_that_an_option_may_name_are_shown(capsys):
    show_one(REGISTRY, "close_loop")
    told = capsys.readouterr().out
    for option in ("declared", "search"):
        assert re.search(rf"\b{option} .*array", told)
    options = {c["name"]: c["options"]["properties"] for c in LISTED if c["kind"] == "stage"}
    assert options["close_loop"]["search"]["default"] is None and options["close_loop"]["declared"]["default"] == []
    assert "hysteresis" in options["close_loop"]["search"]["anyOf"][0]["items"]["enum"]
    assert "li2018_linear" in options["calibrate_scalar"]["method"]["enum"]


@pytest.mark.parametrize("key", sorted(k for k in BUILT_IN if k[0] == "method"), ids=label)
def test_a_method_serves_a_stage_that_is_there(key):
    _, step, _ = key
    assert ("stage", "", step) in BUILT_IN
    stage = BUILT_IN[("stage", "", step)]
    assert stage.method_option is not None
    own = set(stage.options.model_fields) | {stage.method_option[0]}
    assert not own & set(BUILT_IN[key].options.model_fields), "an option of both would mean two things"


@pytest.mark.parametrize("key", sorted(k for k in BUILT_IN if k[0] == "stage"), ids=label)
def test_the_default_method_is_there(key):
    stage = BUILT_IN[key]
    if stage.method_option and stage.method_option[1] is not None:
        assert stage.method_option[1] in REGISTRY.names("method", stage.name)


def test_discovery_is_cheap():
    """`validate` and `plugins` import every built-in module; what is heavy waits until it runs."""
    source = (
        "import sys; from magtensor.registry import Registry; Registry.load();"
        "print([m for m in ('scipy.linalg', 'scipy.optimize', 'scipy.signal', 'xarray', 'pandas', 'h5py', 'matplotlib',"
        " 'jinja2', 'cdflib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
