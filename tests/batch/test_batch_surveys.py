"""From names on the command line to surveys, and from surveys to folders."""

from __future__ import annotations

import os
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from magtensor.batch.campaign import survey_endings
from magtensor.batch.surveys import folder_names, wanted_surveys
from magtensor.recipe.source import parse_yaml

ENDINGS = (".h5", ".nc")


def found(names, folder):
    return [(str(w.path.relative_to(folder)), w.problem) for w in wanted_surveys(names, ENDINGS)]


def test_files_folders_and_patterns_each_once(tmp_path, monkeypatch):
    for name in ("a/2.h5", "a/1.h5", "a/deep/9.h5", "b/3.nc", "b/3.txt", "b/.hidden.h5", "b/3.calibrated.nc"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    os.symlink(tmp_path / "a/1.h5", tmp_path / "link.h5")
    monkeypatch.chdir(tmp_path)
    names = [Path("b"), tmp_path / "a/*.h5", Path("a/2.h5"), Path("./a/../b/3.nc"), Path("link.h5")]
    assert found(names, tmp_path) == [("b/3.nc", ""), ("a/1.h5", ""), ("a/2.h5", "")]
    assert found([Path("**/9.h5")], tmp_path) == [("a/deep/9.h5", "")]
    assert found([Path("b/3.txt")], tmp_path) == [("b/3.txt", "")], "a file that is named is taken, whatever its ending"
    assert found([Path("[ab]")], tmp_path) == [("a/1.h5", ""), ("a/2.h5", ""), ("b/3.nc", "")]


def test_names_that_lead_nowhere_are_kept_with_their_problem(tmp_path):
    (tmp_path / "empty").mkdir()
    names = [tmp_path / "empty", tmp_path / "no.h5", tmp_path / "no*.h5"]
    assert [bool(problem) for _, problem in found(names, tmp_path)] == [True, True, True]


def test_file_whose_name_is_a_pattern(tmp_path):
    (tmp_path / "run[1].h5").touch()
    assert found([tmp_path / "run[1].h5"], tmp_path) == [("run[1].h5", "")]


def test_endings_are_those_of_the_reader_the_recipe_uses():
    def endings(survey: str) -> tuple[str, ...]:
        return survey_endings(parse_yaml(f"title: t\n{survey}", "recipe.yaml"), ())

    canonical, text = endings(""), endings("survey: {reader: text}")
    assert ".h5" in canonical and ".csv" not in canonical
    assert ".csv" in text and ".h5" not in text
    assert endings("survey: {file: day.csv, sensors: {}}") == text
    assert set(endings("survey: {sensors: {}}")) >= {*canonical, *text}


PATHS = st.lists(
    st.tuples(
        st.lists(st.sampled_from(["x", "y", "x-s"]), max_size=3),
        st.sampled_from(["s.h5", "S.h5", "s.nc", "x-s.h5", "s.h5.h5", "batch.json.h5"]),
    ).map(lambda parts: Path("/", *parts[0], parts[1])),
    unique=True,
)


@given(PATHS, st.randoms())
def test_folder_names_differ_and_depend_on_no_order(paths, random):
    names = folder_names(paths, {}, ("batch.json",))
    assert set(names) == set(paths)
    lowered = [n.casefold() for n in names.values()]
    assert len(set(lowered)) == len(lowered), "also where the file system ignores case"
    assert "batch.json" not in lowered
    assert all("/" not in n and n not in ("", ".", "..") for n in lowered)
    shuffled = list(paths)
    random.shuffle(shuffled)
    assert folder_names(shuffled, {}, ("batch.json",)) == names
    stems = [p.stem.casefold() for p in paths]
    assert all(names[p] == p.stem for p in paths if stems.count(p.stem.casefold()) == 1 and p.stem != "batch.json")


@given(PATHS, PATHS)
def test_recorded_folders_stay(first, second):
    names = folder_names(first, {})
    later = folder_names(second, names)
    for path in second:
        if path in names:
            assert later[path] == names[path]
    together = {**names, **later}
    assert len({n.casefold() for n in together.values()}) == len(together)
