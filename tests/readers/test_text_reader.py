"""The text reader: every way to write a table, and the rows that cannot be read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from magtensor.errors import DataError
from magtensor.survey.tables import Tables
from magtensor_readers import text


def read(path: Path, content: str | bytes, **options: Any) -> Tables:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return text([path], **options)


def numbers(tables: Tables) -> np.ndarray:
    return np.column_stack([c.load() for c in tables.columns.values()])


TABLE = np.array([[1.0, 20.5, -3.0], [2.0, 21.5, -4.0], [3.0, 22.5, -5.0]])


@pytest.mark.parametrize(
    "content",
    [
        "t,b,c\n1,20.5,-3\n2,21.5,-4\n3,22.5,-5\n",
        "t;b;c\r\n1;20.5;-3\r\n2;21.5;-4\r\n3;22.5;-5\r\n",
        "t\tb\tc\n1\t20.5\t-3\n2\t21.5\t-4\n3\t22.5\t-5",
        "  t    b    c\n  1  20.5   -3\n  2  21.5   -4\n  3  22.5   -5\n\n",
        "# made by a logger\nt,b,c\n# units\n1,20.5,-3\n2,21.5,-4\n3,22.5,-5\n",
        '"t", "b", "c"\n1, 20.5, -3\n2, "21.5", -4\n3, 22.5, -5\n',
        b"\xef\xbb\xbft,b,c\n1,20.5,-3\n2,21.5,-4\n3,22.5,-5\n",
        "t,b,c\n1,20.5,-3\n2,21.5,-4\n3,22.5,-5\n".encode("utf-16"),
    ],
)
def test_ways_to_write_a_table(tmp_path: Path, content: str | bytes) -> None:
    tables = read(tmp_path / "a.csv", content)
    assert list(tables.columns) == ["t", "b", "c"]
    np.testing.assert_array_equal(numbers(tables), TABLE)
    assert tables.notes == ()


def test_a_decimal_comma(tmp_path: Path) -> None:
    tables = read(tmp_path / "a.csv", "t;b\n1;20,5\n2;21,5\n", decimal=",")
    np.testing.assert_array_equal(numbers(tables), [[1, 20.5], [2, 21.5]])


def test_no_header(tmp_path: Path) -> None:
    tables = read(tmp_path / "a.csv", "1,20.5,13:50:39\n2,21.5,13:50:40\n")
    assert list(tables.columns) == ["0", "1", "2"]
    assert tables.find(1).load().tolist() == [20.5, 21.5]
    assert tables.find(2).text
    assert tables.find(2).load().tolist() == ["13:50:39", "13:50:40"]
    assert tables.find(0).origin == "a.csv: column 0"


def test_units_in_the_header(tmp_path: Path) -> None:
    tables = read(tmp_path / "a.csv", "t [s],Bx (nT),I [flux],n\n1,2,3,4\n2,3,4,5\n")
    assert [c.units for c in tables.columns.values()] == ["s", "nT", None, None]


def test_missing_values(tmp_path: Path) -> None:
    tables = read(tmp_path / "a.csv", "t,b\n1,\n2,NaN\n3,n/a\n4,***\n5,7\n", missing=("***",))
    np.testing.assert_array_equal(tables.find("b").load(), [np.nan, np.nan, np.nan, np.nan, 7])


def test_files_one_after_the_other(tmp_path: Path) -> None:
    for name, rows in (("a.csv", "1,2\n2,3\n"), ("b.csv", "3,4\n")):
        (tmp_path / name).write_text("t,b\n" + rows)
    tables = text([tmp_path / "a.csv", tmp_path / "b.csv"])
    np.testing.assert_array_equal(numbers(tables), [[1, 2], [2, 3], [3, 4]])
    assert tables.part_rows == (2, 1)
    (tmp_path / "c.csv").write_text("t,c\n9,9\n")
    with pytest.raises(DataError, match=r"c\.csv: the columns differ from those of a\.csv: it lacks b; it also has c"):
        text([tmp_path / "a.csv", tmp_path / "c.csv"])


def rows(count: int) -> list[str]:
    return [f"{i},{i * 2},{i * 3}" for i in range(count)]


def test_corrupt_rows_are_left_out_and_told(tmp_path: Path) -> None:
    lines = rows(1000)
    lines[10] = "10,20"
    lines[20] = "20,4\x00\ufffd0,60"
    lines[30] = "30,60,90,120"
    lines[-1] = "999,19"
    tables = read(tmp_path / "a.csv", "\n".join(["a,b,c", *lines]))
    kept = np.delete(np.arange(1000), [10, 20, 30, 999])
    np.testing.assert_array_equal(tables.find("a").load(), kept)
    (note,) = tables.notes
    assert note.startswith("a.csv: 4 of 1000 rows left out: line 12 (2 columns instead of 3), line 22 ('4")
    assert note.endswith("line 32 (4 columns instead of 3) and 1 more")


def test_too_many_corrupt_rows(tmp_path: Path) -> None:
    lines = rows(100)
    lines[10:15] = ["x,y,z"] * 5
    with pytest.raises(DataError, match=r"a\.csv: 5 of 100 rows cannot be read: line 12 \('x' in column a\)"):
        read(tmp_path / "a.csv", "\n".join(["a,b,c", *lines]))
    assert read(tmp_path / "b.csv", "\n".join(["a,b,c", *lines]), max_bad_share=0.1).part_rows == (95,)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"\n\n# only a comment\n", "the file holds no row"),
        (b"a,b,c\n", "has a header but no row|binary"),
        (b"\x89HDF\r\n\x1a\n" + bytes(range(32)) * 40, "this is a binary file, not text"),
        (b"a,b,c\n1,2\n3,4\n5,6\n", "line 1: the header names 3 columns, most rows have 2"),
    ],
)
def test_what_is_no_table(tmp_path: Path, content: bytes, message: str) -> None:
    options = {"header": True} if content == b"a,b,c\n" else {}
    with pytest.raises(DataError, match=message) as caught:
        read(tmp_path / "a.csv", content, **options)
    assert "a.csv" in str(caught.value)


def test_the_same_name_twice(tmp_path: Path) -> None:
    tables = read(tmp_path / "a.csv", "t,b,b\n1,2,3\n2,3,4\n")
    assert list(tables.columns) == ["t", "b (1)", "b (2)"]


@settings(max_examples=40)
@given(arrays(np.float64, (7, 3), elements=st.floats(allow_nan=False, allow_infinity=False)), st.sampled_from(",;\t "))
def test_numbers_survive_to_the_last_bit(tmp_path_factory: Any, table: np.ndarray, separator: str) -> None:
    path = tmp_path_factory.mktemp("bits") / "a.txt"
    lines = [separator.join(repr(float(v)) for v in row) for row in table]
    found = numbers(read(path, "\n".join(lines), header=False))
    np.testing.assert_array_equal(found, table)
