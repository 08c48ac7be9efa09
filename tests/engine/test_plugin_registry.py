"""Plugins that are broken, double, misspelled or hostile: each named, none in the way of the others."""

from __future__ import annotations

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

from magtensor.cli import status_of
from magtensor.errors import UsageError
from magtensor.registry import Registry

STAGE = "from magtensor import stage\n\n@stage()\ndef {name}(survey):\n    '''Does {name}.'''\n    return {{}}\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "good.py").write_text(STAGE.format(name="good_stage"))
    return tmp_path


def broken(registry: Registry) -> dict[str, str]:
    return {p.name: p.error for p in registry.broken()}


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("import no_such_module", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("1 / 0", "ZeroDivisionError"), ("def (", "SyntaxError"), ("import sys; sys.exit(0)", "SystemExit: 0"),
        ("raise BaseException('all of them')", "BaseException: all of them"),
        ("a = '\x00'", "source code string cannot contain null bytes"),
        ("from magtensor import stage\n@stage()\ndef f(survey, *, x=1):\n    '''F.'''", "option x has no type"),
        ("from magtensor import stage\n@stage()\ndef f(survey, **options):\n    '''F.'''", "hides the options"),
        ("from __future__ import annotations\nfrom magtensor import stage\n@stage()\n"
         "def f(survey, *, x: Missing = 1):\n    '''F.'''", "type of option x"),
        ("from magtensor import stage\nclass Own: pass\n@stage()\ndef f(survey, *, x: Own = None):\n    '''F.'''",
         "option x"),
        ("from magtensor import stage\n@stage()\ndef f(survey, *, x: int = 'one'):\n    '''F.'''",
         "default of option x"),
        *((f"from magtensor import {kind}\n@{kind}\ndef f(x):\n    'F.'", f"@{kind}(...) with parentheses above f")
          for kind in ("stage", "method", "reader", "metric", "error_model")),
        ("from magtensor.hookspecs import hookimpl\n@hookimpl\ndef magtensor_components():\n    return 5", "TypeError"),
        ("from magtensor.hookspecs import hookimpl\n@hookimpl\ndef magtensor_components():\n    raise OSError('x')",
         "OSError: x"),
    ],
)  # fmt: skip
def test_broken_plugin_is_listed_and_harmless(folder, source, words, capsys):
    (folder / "bad.py").write_text(source)
    registry = Registry.load([folder])
    assert words in broken(registry)["bad"]
    assert ("stage", "", "good_stage") in registry.components
    registry.check()

    recipe = folder / "recipe.yaml"
    recipe.write_text("title: t\nstages: [good_stage]\n")
    assert status_of(["validate", str(recipe), "--plugins", str(folder)]) == 0
    recipe.write_text("title: t\nplugins: [bad.py, good.py]\nstages: [good_stage]\n")
    assert status_of(["validate", str(recipe)]) == 2
    said = capsys.readouterr().err
    assert "recipe.yaml:2: plugins[0]: " in said and "could not be loaded" in said


def test_unknown_name_points_at_the_broken_plugin(folder):
    (folder / "bad.py").write_text("import no_such_module")
    with pytest.raises(UsageError, match=r"bad\.py could not be loaded: ModuleNotFoundError"):
        Registry.load([folder]).find("stage", "stage_of_bad")


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("@hookimpl\ndef magtensor_component():\n    return []", "magtensor_component is no hook of magtensor"),
        ("@hookimpl\ndef magtensr_components():\n    return []", "did you mean magtensor_components?"),
        ("def magtensor_components():\n    return []", "lacks @hookimpl"),
        ("@hookimpl\ndef magtensor_components():\n    return [len]", "is not marked with @stage, @method"),
    ],
)
def test_misspelled_hook_is_an_error_that_names_the_file(folder, source, words, capsys):
    (folder / "hooks.py").write_text(f"from magtensor.hookspecs import hookimpl\n{source}\n")
    registry = Registry.load([folder])
    (problem,) = registry.problems
    assert words in problem and str(folder / "hooks.py") in problem
    with pytest.raises(UsageError, match=r"hooks\.py"):
        registry.check()
    assert status_of(["plugins", "--plugins", str(folder)]) == 2
    said = capsys.readouterr()
    assert "good_stage" in said.out, "the rest is listed all the same"
    assert words in said.err
    recipe = folder / "recipe.yaml"
    recipe.write_text("title: t\nstages: [good_stage]\n")
    assert status_of(["validate", str(recipe), "--plugins", str(folder)]) == 2


def test_components_made_at_run_time(folder):
    (folder / "made.py").write_text(
        "from magtensor import stage\nfrom magtensor.hookspecs import hookimpl\n"
        "def make(n):\n    @stage(name=f'made_{n}')\n    def inner(survey):\n        '''Made.'''\n    return inner\n"
        "@hookimpl\ndef magtensor_components():\n    return [make(n) for n in (1, 2)]\n"
    )
    registry = Registry.load([folder])
    assert {"made_1", "made_2"} <= set(registry.names("stage"))
    assert registry.problems == []


def test_duplicate_names_both_plugins(folder):
    (folder / "twin.py").write_text(STAGE.format(name="good_stage"))
    (problem,) = Registry.load([folder]).problems
    assert "stage good_stage is given twice" in problem
    assert str(folder / "good.py") in problem and str(folder / "twin.py") in problem


def test_duplicate_of_a_built_in_names_the_distribution(folder):
    (folder / "own_load.py").write_text(STAGE.format(name="load"))
    (problem,) = Registry.load([folder]).problems
    assert "stage load is given twice: by magtensor " in problem
    assert str(folder / "own_load.py") in problem


def test_method_of_another_stage_may_share_a_name(folder):
    (folder / "methods.py").write_text(
        "from magtensor import method\n@method('align', name='x')\ndef a(b):\n    '''A.'''\n"
        "@method('calibrate_scalar', name='x')\ndef c(b):\n    '''C.'''\n"
    )
    registry = Registry.load([folder])
    assert registry.problems == []
    assert "x" in registry.names("method", "align") and "x" in registry.names("method", "calibrate_scalar")


def test_same_file_twice_is_one_plugin(folder):
    link = folder / "sub"
    link.symlink_to(folder)
    registry = Registry.load([folder, folder / "good.py", folder / "." / "good.py", link])
    assert [p.name for p in registry.plugins if p.file] == ["good"]
    assert registry.problems == []


def test_order_of_folders_and_files_changes_nothing(tmp_path):
    for name in "abc":
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}.py").write_text(STAGE.format(name=f"stage_{name}"))
    one = Registry.load([tmp_path / n for n in "abc"])
    other = Registry.load([tmp_path / n for n in "cab"])
    assert set(one.components) == set(other.components)


def test_imported_function_of_another_plugin_is_no_duplicate(folder):
    (folder / "builds_on.py").write_text(
        "from magtensor import stage\nfrom magtensor_stages import load, align\n"
        "from magtensor_stages.load import load as l\n" + STAGE.format(name="own").split("\n", 1)[1]
    )
    registry = Registry.load([folder])
    assert registry.problems == []
    assert registry.origin[("stage", "", "load")].distribution == "magtensor"
    assert registry.origin[("stage", "", "own")].file == folder / "builds_on.py"


def test_edited_file_is_read_anew(folder):
    first = Registry.load([folder])
    (folder / "good.py").write_text(STAGE.format(name="renamed"))
    second = Registry.load([folder])
    assert "renamed" in second.names("stage") and "good_stage" not in second.names("stage")
    digests = [next(p.sha256 for p in r.plugins if p.name == "good") for r in (first, second)]
    assert digests[0] != digests[1]


def test_files_that_start_with_an_underscore_are_no_plugins(folder):
    (folder / "_draft.py").write_text("1 / 0")
    (folder / "notes.txt").write_text("1 / 0")
    assert broken(Registry.load([folder])) == {}


def test_folder_that_is_not_there(tmp_path, capsys):
    assert status_of(["plugins", "--plugins", str(tmp_path / "none")]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_file_that_is_no_python(tmp_path, capsys):
    (tmp_path / "plugin.txt").write_text("x = 1")
    assert status_of(["plugins", "--plugins", str(tmp_path / "plugin.txt")]) == 2
    assert "plugin.txt" in capsys.readouterr().err


def test_objects_that_answer_to_every_name(folder):
    """A module may hold objects whose attributes are made up when asked for, or that refuse to be asked."""
    (folder / "odd.py").write_text(
        "from unittest.mock import MagicMock\nfake = MagicMock()\n"
        "class Shy:\n    def __getattr__(self, name):\n        raise RuntimeError(name)\n    def __call__(self): pass\n"
        "shy = Shy()\n" + STAGE.format(name="odd_stage")
    )
    registry = Registry.load([folder])
    assert broken(registry) == {} and registry.problems == []
    assert "odd_stage" in registry.names("stage")


def entry_point(name: str, value: object, distribution: str, version: str = "1.0") -> SimpleNamespace:
    dist = SimpleNamespace(name=distribution, version=version)
    return SimpleNamespace(name=name, value=str(value), dist=dist, load=lambda: value)


def package(monkeypatch, tmp_path, name: str, **modules: str):
    """A package on the path, imported."""
    (tmp_path / name).mkdir()
    for module, source in {"__init__": "", **modules}.items():
        (tmp_path / name / f"{module}.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    import importlib

    return importlib.import_module(f"{name}.plugin" if "plugin" in modules else name)


def with_packages(monkeypatch, *points: SimpleNamespace) -> Registry:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: list(points))
    return Registry.load()


def test_package_whose_plugin_module_gathers_from_others(monkeypatch, tmp_path):
    deep, gathering = STAGE.format(name="deep"), "from gathers_stages.inner import deep"
    gathers = package(monkeypatch, tmp_path, "gathers_stages", inner=deep, plugin=gathering)
    registry = with_packages(monkeypatch, entry_point("a", gathers, "gathers"), entry_point("b", gathers, "gathers"))
    assert registry.names("stage") == ["deep"]
    assert registry.problems == [], "one function, found twice in one package, is one stage"


def test_duplicate_in_two_packages_names_both_distributions(monkeypatch, tmp_path):
    packages = [package(monkeypatch, tmp_path, f"twin_{n}", __init__=STAGE.format(name="twin")) for n in "ab"]
    points = [entry_point("stages", p, f"twin-{n}", "2.1") for p, n in zip(packages, "ab", strict=True)]
    for order in (points, points[::-1]):
        (problem,) = with_packages(monkeypatch, *order).problems
        assert problem == "stage twin is given twice: by twin-a 2.1 (stages) and by twin-b 2.1 (stages)"


def test_broken_package_stops_a_run_only_if_named(monkeypatch, tmp_path, capsys, caplog):
    def fails():
        raise ImportError("needs libfoo.so.3")

    bad = SimpleNamespace(
        name="radar", value="radar", dist=SimpleNamespace(name="radar-plugin", version="0.3"), load=fails
    )
    good = package(monkeypatch, tmp_path, "good_package", __init__=STAGE.format(name="fine"))
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [bad, entry_point("good", good, "good")])
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("title: t\nstages: [fine]\n")
    assert status_of(["validate", str(recipe)]) == 0
    # a search that lacks a part of the catalogue has to be known as such
    assert "the plugin radar-plugin 0.3 (radar) could not be loaded: ImportError: needs libfoo.so.3" in caplog.text
    caplog.clear()
    for name in ("radar", "radar-plugin"):
        recipe.write_text(f"title: t\nplugins: [{name}]\nstages: [fine]\n")
        assert status_of(["validate", str(recipe)]) == 2
        assert f"the plugin {name} could not be loaded: ImportError: needs libfoo.so.3" in capsys.readouterr().err
        assert not caplog.text


HOSTILE = (
    "print('a print at import')\nimport sys\nsys.stdout.write('and another')\n"
    "from typing import Annotated\nfrom pydantic import Field\nfrom magtensor import stage\n"
    "Text = Field(description='[red]not markup[/] [/nothing]')\n"
    "@stage()\ndef odd(survey, *, x: Annotated[float, Text] = float('inf')):\n"
    "    '''Gives [/bold] brackets such as Bx [nT].'''\n"
)


def test_json_is_valid_whatever_plugins_do(folder):
    (folder / "hostile.py").write_text(HOSTILE)
    (folder / "bad.py").write_text("raise ValueError('[/bold] in an error')")
    command = [sys.executable, "-m", "magtensor", "plugins", "--json", "--plugins", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr

    def refuse(word: str):
        raise AssertionError(f"{word} is not JSON")

    listed = json.loads(done.stdout, parse_constant=refuse)
    plugins = {p["name"]: p for p in listed["plugins"]}
    assert plugins["bad"]["error"] == "ValueError: [/bold] in an error"
    assert plugins["hostile"]["gives"] == ["odd"]
    assert plugins["good"]["sha256"] and plugins["stages"]["version"]
    odd = next(c for c in listed["components"] if c["name"] == "odd")
    assert odd["options"]["properties"]["x"]["description"] == "[red]not markup[/] [/nothing]"


def test_tables_show_brackets_as_they_are(folder, capsys):
    (folder / "hostile.py").write_text(HOSTILE)
    (folder / "bad.py").write_text("raise ValueError('[/bold] in an error')")
    assert status_of(["plugins", "--plugins", str(folder)]) == 0
    said = "".join(capsys.readouterr().out.split())
    assert "[/bold]inan" in said.replace("│", "")
    assert status_of(["plugins", "odd", "--plugins", str(folder)]) == 0
    assert "[nT]" in capsys.readouterr().out
    assert status_of(["plugins", "od", "--plugins", str(folder)]) == 2
    assert "did you mean odd" in capsys.readouterr().err


def test_a_broken_file_that_was_named_stops_a_run_and_one_beside_it_is_told(folder, caplog, capsys):
    (folder / "bad.py").write_text("def (")
    recipe = folder / "recipe.yaml"
    recipe.write_text("title: t\nstages: [good_stage]\n")
    assert status_of(["validate", str(recipe), "--plugins", str(folder)]) == 0
    assert "bad.py could not be loaded: SyntaxError" in caplog.text
    assert status_of(["validate", str(recipe), "--plugins", str(folder), "--plugins", str(folder / "bad.py")]) == 2
    assert "bad.py could not be loaded: SyntaxError" in capsys.readouterr().err
