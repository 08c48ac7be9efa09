"""IAGA-2002 and CDF files, written here, read back."""

from __future__ import annotations

import builtins
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magtensor.errors import DataError, UsageError
from magtensor_readers import cdf, iaga2002

HEADER = [
    " Format                 IAGA-2002                                    |",
    " Station Name           Nowhere                                      |",
    " IAGA CODE              NWH                                          |",
    " # a remark                                                          |",
    "DATE       TIME         DOY     NWHX      NWHY      NWHD      NWHF   |",
]


def iaga_lines(count: int = 120) -> list[str]:
    return [
        f"2022-08-10 {i // 3600:02d}:{i // 60 % 60:02d}:{i % 60:02d}.000 222     {20000 + i:9.2f} {-100.5:9.2f} "
        f"{12.25:9.2f} {48000 + i:9.2f}"
        for i in range(count)
    ]


def write_iaga(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join([*HEADER, *lines]) + "\n")
    return path


def test_iaga_columns_units_and_header(tmp_path: Path) -> None:
    lines = iaga_lines()
    lines[5] = lines[5][:-9] + " 99999.00"
    lines[6] = lines[6][:-9] + " 88888.00"
    tables = iaga2002([write_iaga(tmp_path / "a.sec", lines)])
    assert list(tables.columns) == ["time", "NWHX", "NWHY", "NWHD", "NWHF"]
    assert [c.units for c in tables.columns.values()] == [
        "seconds since 2022-08-10T00:00:00Z", "nT", "nT", "arcmin", "nT",
    ]  # fmt: skip
    np.testing.assert_array_equal(tables.find("time").load(), np.arange(120))
    np.testing.assert_array_equal(tables.find("NWHX").load(), 20000 + np.arange(120))
    assert np.flatnonzero(np.isnan(tables.find("NWHF").load())).tolist() == [5, 6]
    assert tables.attributes["Station Name"] == "Nowhere"
    assert tables.attributes["comment"] == "a remark"


def test_iaga_inside_a_zip_archive(tmp_path: Path) -> None:
    plain = write_iaga(tmp_path / "a.sec", iaga_lines())
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(plain, "a.sec")
    found, expected = iaga2002([tmp_path / "a.zip"]), iaga2002([plain])
    for name, column in expected.columns.items():
        np.testing.assert_array_equal(found.find(name).load(), column.load())


def test_iaga_bad_rows(tmp_path: Path) -> None:
    lines = iaga_lines(400)
    lines[7] = lines[7][:30]
    tables = iaga2002([write_iaga(tmp_path / "a.sec", lines)])
    assert tables.part_rows == (399,)
    assert tables.notes == ("a.sec: 1 rows left out, the first in line 13",)
    lines[20:60] = ["2022-13-45 junk"] * 40
    with pytest.raises(DataError, match=r"a\.sec: 41 of 400 rows cannot be read, the first in line 13"):
        iaga2002([write_iaga(tmp_path / "a.sec", lines)])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.sec", b"1,2,3\n4,5,6\n", "this is not an IAGA-2002 file"),
        ("a.sec", "\n".join(HEADER).encode(), "has a header but no row"),
        ("a.zip", b"PK\x03\x04 and nothing else", "the archive cannot be unpacked"),
    ],
)
def test_what_is_no_iaga_file(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        iaga2002([tmp_path / name])
    assert name in str(caught.value)


def test_a_damaged_archive(tmp_path: Path) -> None:
    plain = write_iaga(tmp_path / "a.sec", iaga_lines())
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(plain, "a.sec")
    content = bytearray((tmp_path / "a.zip").read_bytes())
    content[100:140] = b"\xff" * 40
    (tmp_path / "a.zip").write_bytes(bytes(content))
    with pytest.raises(DataError, match=r"a\.zip: the archive"):
        iaga2002([tmp_path / "a.zip"])


def write_cdf(path: Path) -> None:
    writer = pytest.importorskip("cdflib").cdfwrite.CDF(path, delete=True)
    # TT2000: nanoseconds since J2000 in terrestrial time; 2022-08-10T00:00:00 UTC with its 69.184 s.
    stamps = 713_361_669_184_000_000 + np.arange(10, dtype=np.int64) * 250_000_000
    field = 48_000.0 + np.arange(10)
    field[3] = -1e31
    for name, kind, data, attributes in (
        ("Epoch", 33, stamps, {}),
        ("f", 45, field, {"UNITS": "nT", "FILLVAL": -1e31}),
    ):
        spec = {"Variable": name, "Data_Type": kind, "Num_Elements": 1, "Rec_Vary": True, "Dim_Sizes": []}
        writer.write_var(spec, var_attrs=attributes, var_data=data)
    writer.write_globalattrs({"StationName": {0: "Nowhere"}})
    writer.close()


def test_cdf_epochs_fill_values_and_units(tmp_path: Path) -> None:
    write_cdf(tmp_path / "a.cdf")
    tables = cdf([tmp_path / "a.cdf"])
    assert tables.find("time").units == "seconds since 2022-08-10T00:00:00Z"
    np.testing.assert_allclose(tables.find("time").load(), np.arange(10) * 0.25, atol=1e-9)
    assert tables.find("f").units == "nT"
    expected = 48_000.0 + np.arange(10)
    expected[3] = np.nan
    np.testing.assert_array_equal(tables.find("f").load(), expected)
    assert tables.attributes["StationName"] == "Nowhere"


def test_cdf_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "a.cdf").write_bytes(b"no cdf at all" * 20)
    with pytest.raises(DataError, match=r"a\.cdf: this is not a CDF file, or it is corrupt"):
        cdf([tmp_path / "a.cdf"])


def test_cdf_without_cdflib_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.cdf").write_bytes(b"x")
    original = builtins.__import__

    def absent(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "cdflib":
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(UsageError, match=r"pip install 'magtensor\[cdf\]'"):
        cdf([tmp_path / "a.cdf"])
