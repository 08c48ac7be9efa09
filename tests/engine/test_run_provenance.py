"""A result says how it was made, and can be made again from that alone."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest

from magtensor import provenance
from magtensor.cli import status_of
from magtensor.provenance import Provenance, sha256

PLUGIN = '''
@stage(needs=("b_raw",), gives=("calibrated/b", "calibration/matrix", "calibration/used"))
def scale(
    survey, *, factor: Annotated[float, Field(description="times")] = 2.0,
    limit: Annotated[float, Field(description="unused")] = float("inf"),
    word: Annotated[str, Field(description="unused")] = "a: b # c",
):
    """Scale."""
    rng = np.random.default_rng(3)
    b = survey.values("b_raw")
    return {
        "calibrated/b": (("time", "sensor", "axis"), b * factor + rng.normal(size=b.shape), {"units": "nT"}),
        "calibration/matrix": (("sensor", "axis", "column"), np.stack([np.eye(3) * factor] * 2), {"units": "1"}),
        "calibration/used": (("sensor",), np.array([True, False]), {}),
    }
'''
STAGES = "  - start: {value: 1e-5}\n  - scale: {factor: 3.5}\n"


@pytest.fixture
def own(bench):
    bench.plugin(PLUGIN)
    assert bench.run(STAGES) == 0
    return bench


def made_by(bench, folder: str = "out") -> Provenance:
    return provenance.read(bench.folder / folder / "result.nc")


def again(bench, *more: str) -> int:
    return status_of(["run", str(bench.folder / "out/result.nc"), "--output", str(bench.folder / "again"), *more])


def test_everything_that_made_the_result_is_in_it(own):
    found = made_by(own)
    assert found.recipe["stages"] == [
        {"start": {"value": 1e-5}}, {"scale": {"factor": 3.5, "limit": float("inf"), "word": "a: b # c"}}
    ]  # fmt: skip
    assert found.inputs == [{"path": str(own.survey), "sha256": sha256(own.survey), "bytes": 2}]
    (plugin,) = [p for p in found.plugins if p["name"] == "own"]
    assert plugin["sha256"] == sha256(own.folder / "own.py")
    assert {"magtensor", "python", "numpy", "scipy", "h5py", "xarray"} <= set(found.versions)
    assert [s["name"] for s in found.stages] == ["start", "scale"]
    assert found.stages[1]["read"] == ["b_raw"]
    assert found.stages[1]["wrote"] == ["calibrated/b", "calibration/matrix", "calibration/used"]
    assert found.stages[1]["options"]["factor"] == 3.5
    assert Provenance.from_attributes(found.attributes()) == found


def test_the_calibration_alone_carries_it_too(own):
    assert provenance.read(own.folder / "out/calibration.nc") == made_by(own)


def test_result_is_reproduced_bit_for_bit(own, capsys):
    own.recipe("  - nothing\n")  # the recipe's file is no longer what it was
    assert again(own) == 0
    assert "reproduced bit for bit" in capsys.readouterr().out
    with h5py.File(own.folder / "out/result.nc") as one, h5py.File(own.folder / "again/result.nc") as other:
        a, b = (f["calibrated/b"][...] for f in (one, other))
        assert a.tobytes() == b.tobytes()
    first, second = made_by(own), made_by(own, "again")
    assert first.content_sha256 == second.content_sha256
    assert first.recipe == second.recipe
    assert first.inputs == second.inputs


def test_the_content_hash_is_of_what_was_written(own):
    """Read back from the file, the arrays have the hash that was taken before they were written."""
    import xarray as xr

    with xr.open_datatree(own.folder / "out/result.nc", engine="h5netcdf", decode_times=False) as tree:
        assert provenance.content_sha256(tree) == made_by(own).content_sha256
    with h5py.File(own.folder / "out/result.nc", "r+") as file:
        values = file["calibrated/b"][...]
        file["calibrated/b"][0, 0, 0] = np.nextafter(values[0, 0, 0], np.inf)
    with xr.open_datatree(own.folder / "out/result.nc", engine="h5netcdf", decode_times=False) as tree:
        assert provenance.content_sha256(tree) != made_by(own).content_sha256


@pytest.mark.parametrize(
    "top",
    [
        "description: 'Prüfung 🧲 \\u00b5T \"quoted\" {x}: [y] # z'", "authors: ['O''Hara: x', '- dash', '🧲']",
        'description: "two\\nlines\\tand a tab"', f"description: {'x' * 300_000}",
        "references: ['~', 'null', '1e-3', yes]",
    ],
)  # fmt: skip
def test_words_of_every_kind_survive(bench, top, capsys):
    bench.plugin(PLUGIN)
    recipe = bench.recipe(STAGES, top=f"plugins: [own.py]\n{top}")
    assert status_of(["run", str(recipe), "--output", str(bench.folder / "out")]) == 0
    assert again(bench) == 0
    assert "reproduced bit for bit" in capsys.readouterr().out
    assert made_by(bench, "again").recipe == made_by(bench).recipe


def test_changed_input_is_refused(own, capsys):
    own.survey.write_text("11")
    assert again(own) == 3
    said = capsys.readouterr().err
    assert str(own.survey) in said and "has changed" in said
    assert not (own.folder / "again").exists()
    own.survey.unlink()
    assert again(own) == 3
    assert "no longer there" in capsys.readouterr().err
    other = own.folder / "moved.h5"
    other.write_text("10")
    assert again(own, "--input", str(other)) == 0
    assert made_by(own, "again").content_sha256 == made_by(own).content_sha256


def test_changed_plugin_is_told(own, capsys):
    before = sha256(own.folder / "own.py")
    own.plugin(PLUGIN.replace("default_rng(3)", "default_rng(4)"))
    assert again(own) == 0
    said = capsys.readouterr().out
    assert "NOT the same bits" in said
    assert f"plugin own: sha256 was {before}, is {sha256(own.folder / 'own.py')}" in said


def test_changed_plugin_is_told_even_if_the_bits_are_the_same(own, capsys):
    before = sha256(own.folder / "own.py")
    own.plugin(PLUGIN + "\n# a remark\n")
    assert again(own) == 0
    said = capsys.readouterr().out
    assert "reproduced bit for bit" in said
    assert f"plugin own: sha256 was {before}" in said


def test_plugin_that_is_gone(own, capsys):
    (own.folder / "own.py").unlink()
    assert again(own) == 2
    assert "own.py" in capsys.readouterr().err


def test_plugins_of_the_same_name_are_told_apart():
    """Many packages call their entry point `stages`."""
    then = Provenance({}, [], {}, [
        {"name": "stages", "distribution": "magtensor", "version": "1"},
        {"name": "stages", "distribution": "radar", "version": "7"},
    ], [])  # fmt: skip
    assert provenance.differences(then, then) == []
    now = Provenance({}, [], {}, [
        {"name": "stages", "distribution": "radar", "version": "8"},
        {"name": "stages", "distribution": "magtensor", "version": "1"},
    ], [])  # fmt: skip
    assert provenance.differences(then, now) == ["plugin stages of radar: version was 7, is 8"]


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: f.__delitem__("provenance"), "has no group /provenance"),
        (lambda f: f["provenance"].attrs.__delitem__("stages"), "is damaged"),
        (lambda f: f["provenance"].attrs.__setitem__("recipe", "{"), "is damaged"),
        (lambda f: f["provenance"].attrs.__setitem__("recipe", "5"), "a recipe is a mapping"),
        (lambda f: f["provenance"].attrs.__setitem__("recipe", json.dumps({"title": "t", "stages": ["gone"]})), "gone"),
        (lambda f: f["provenance"].attrs.__setitem__("inputs", "[5]"), "is damaged"),
        (lambda f: f["provenance"].attrs.__setitem__("notes", "[]"), "is damaged"),
    ],
)
def test_damaged_provenance_is_a_message(own, damage, words, capsys):
    with h5py.File(own.folder / "out/result.nc", "r+") as file:
        damage(file)
    assert again(own) == 2
    assert words in capsys.readouterr().err


def test_files_that_are_no_results(own, tmp_path, capsys):
    plain = tmp_path / "plain.h5"
    with h5py.File(plain, "w") as file:
        file["x"] = 1
    assert status_of(["run", str(plain)]) == 2
    assert "it is no result.nc or calibration.nc of magtensor" in capsys.readouterr().err
    whole = (own.folder / "out/result.nc").read_bytes()
    plain.write_bytes(whole[: len(whole) // 2])
    assert status_of(["run", str(plain)]) == 2
    assert "cannot be read as HDF5" in capsys.readouterr().err
