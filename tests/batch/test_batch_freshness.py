"""When a result counts as done, and when not: every reason, told in words."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from magtensor.batch.freshness import first_difference


@pytest.fixture
def done(archive) -> Path:
    """A survey with a result."""
    survey = archive.survey("one.h5", "40 50")
    assert archive.why(survey) == "no result yet"
    assert archive.run_here(survey) == 0
    assert archive.why(survey) == ""
    return survey


def test_dates_and_places_of_files_mean_nothing(archive, done):
    os.utime(done)
    assert archive.why(done) == ""
    moved = archive.survey("elsewhere/one.h5", "40 50")
    assert archive.why(moved) == ""


def test_changed_recipe(archive, done):
    doubled = "stages.read_numbers.factor=2.0"
    assert archive.why(done, doubled) == "recipe changed: stages[0].read_numbers.factor"
    archive.write_recipe(factor=2.0)
    assert archive.why(done) == "recipe changed: stages[0].read_numbers.factor"
    assert archive.run_here(done) == 0
    assert archive.why(done) == ""
    archive.write_recipe()
    assert archive.why(done) == "recipe changed: stages[0].read_numbers.factor", "its files are the other recipe's"
    assert archive.why(done, doubled) == "", "what counts is the resolved recipe, not where a value came from"


def test_changed_or_lost_input(archive, done):
    archive.survey("one.h5", "40 51")
    assert archive.why(done) == "input changed: one.h5"
    done.unlink()
    assert archive.why(done).startswith("input changed: ")


def test_changed_plugin_file(archive, done):
    plugin = archive.folder / "numbers.py"
    plugin.write_text(plugin.read_text() + "\n# edited\n")
    assert archive.why(done).startswith("code changed: plugin numbers: sha256 was ")


def test_changed_package(archive, done, monkeypatch):
    monkeypatch.setattr("magtensor.__version__", "0.0.1")
    assert archive.why(done).startswith("code changed: magtensor was ")


def test_changed_library_is_not_the_packages_code(archive, done, monkeypatch):
    """Ten years of surveys are not done again because a library has a new patch release; provenance tells it."""
    monkeypatch.setattr("platform.python_version", lambda: "3.99.0")
    assert archive.why(done) == ""


def _flip_number(file: Path) -> None:
    content = bytearray(file.read_bytes())
    at = content.find(np.float64(41.0).tobytes())  # 40 in the survey; calibrated/b is one more
    assert at > 0
    content[at] ^= 1
    file.write_bytes(content)


def _truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-200])


@pytest.mark.parametrize(
    ("name", "damage", "why"),
    [
        ("result.nc", _flip_number, "result.nc is not what was written"),
        ("result.nc", _truncate, "result.nc cannot be read"),
        ("result.nc", Path.unlink, "no result yet"),
        ("calibration.nc", Path.unlink, "calibration.nc is missing or damaged"),
        ("calibration.nc", _truncate, "calibration.nc is missing or damaged"),
        ("verdict.json", _truncate, "verdict.json is missing or damaged"),
    ],
)
def test_damaged_result(archive, done, name, damage, why):
    damage(archive.output / "one" / name)
    assert archive.why(done) == why
    assert archive.run_here(done) == 0
    assert archive.why(done) == ""


def test_calibration_of_another_result(archive, done):
    calibration = archive.output / "one/calibration.nc"
    other = archive.survey("other.h5", "60")
    content = calibration.read_bytes()
    plugin = archive.folder / "numbers.py"
    plugin.write_text(plugin.read_text().replace("[np.nan, 1.5]", "[np.nan, 2.5]"))
    assert archive.run_here(other) == 0
    (archive.output / "other/calibration.nc").write_bytes(content)
    assert archive.why(other) == "calibration.nc is missing or damaged"


@pytest.mark.parametrize(
    ("one", "other", "place"),
    [
        ({"a": [1, {"b": 2}]}, {"a": [1, {"b": 2}]}, ""),
        ({"a": [1, {"b": 2}]}, {"a": [1, {"b": 3}]}, "a[1].b"),
        ({"a": [1]}, {"a": [1, 2]}, "a[1]"),
        ({"a": None}, {}, "a"),
        ({}, {"a": None}, "a"),
        ({"a": 1}, {"a": 1.0}, "a"),
        ({"a": True}, {"a": 1}, "a"),
        ({"a": {"b": 1}}, {"a": [1]}, "a"),
    ],
)
def test_first_difference(one, other, place):
    assert first_difference(one, other) == place
