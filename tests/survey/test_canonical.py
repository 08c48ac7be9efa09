"""The canonical file: exact round trips, files by other writers, and what is wrong with a file that is not one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from survey_cases import START, array_variables

from magtensor.errors import DataError
from magtensor.survey.canonical import read_canonical, write_canonical
from magtensor.survey.model import Survey


def plain_file(path: Path, **changes: Any) -> Path:
    """A canonical survey as somebody writes it with h5py: no dimension scales, units as attributes."""
    variables = array_variables(60)
    with h5py.File(path, "w") as file:
        for name, (_, values, attributes) in {**variables, **changes}.items():
            if values is None:
                continue
            data = np.asarray(values)
            file[name] = data.astype("S") if data.dtype.kind == "U" else data
            for key, value in attributes.items():
                file[name].attrs[key] = value
    return path


def test_round_trip_is_exact(tmp_path: Path) -> None:
    variables = array_variables() | {
        "segment": (("time",), np.repeat(np.arange(4), 100), {"units": "1"}),
        "attitude": (("time", "quaternion"), np.tile([0.0, 0.6, 0.0, 0.8], (400, 1)), {"units": "1", "world": "NED"}),
        "door": (("time",), np.arange(400) % 7 == 0, {"units": "1", "comment": "open"}),
        "valve": (("time", "sensor"), np.random.default_rng(2).normal(size=(400, 4)), {"units": "Pa"}),
        "wheel": (("time",), np.arange(400, dtype=np.int32), {"units": "counts"}),
    }
    variables["b_raw"][1][5:8, 2] = np.nan
    before = Survey.build(variables, {"title": "test flight"})
    write_canonical(before, tmp_path / "s.nc")
    after = read_canonical(tmp_path / "s.nc")
    assert after.paths() == before.paths()
    for path in before.paths():
        assert after[path].dims == before[path].dims, path
        assert dict(after[path].attrs) == dict(before[path].attrs), path
        np.testing.assert_array_equal(after.values(path), before.values(path), err_msg=path)
        if before.values(path).dtype.kind in "fib":
            assert after.values(path).dtype == before.values(path).dtype, path
    assert after.attributes["title"] == "test flight"


def test_netcdf_readers_read_it(tmp_path: Path) -> None:
    write_canonical(Survey.build(array_variables()), tmp_path / "s.nc")
    with xr.open_dataset(tmp_path / "s.nc") as root:
        assert root["b_raw"].dims == ("time", "sensor", "axis")
        assert str(root["time"].values[0])[:19] == "2022-08-10T00:00:00"
        assert root["b_raw"].attrs["units"] == "nT"
    with xr.open_dataset(tmp_path / "s.nc", group="reference") as reference:
        assert reference["total_field"].dims == ("time",)


def test_a_plain_h5py_file_reads_the_same(tmp_path: Path) -> None:
    survey = read_canonical(plain_file(tmp_path / "p.h5"))
    for path, (dims, values, _) in array_variables(60).items():
        assert survey[path].dims == dims
        np.testing.assert_array_equal(survey.values(path), values)


def test_an_interrupted_write_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(xr.Dataset, "to_netcdf", lambda *_, **__: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_canonical(Survey.build(array_variables()), tmp_path / "s.nc")
    assert list(tmp_path.iterdir()) == []


def test_units_and_epochs_are_converted(tmp_path: Path) -> None:
    variables = array_variables(60)
    path = plain_file(
        tmp_path / "u.h5",
        b_raw=((), variables["b_raw"][1] / 1000, {"units": "uT"}),
        position=((), variables["position"][1] * 100, {"units": "cm"}),
        temperature=((), variables["temperature"][1] + 273.15, {"units": "K"}),
        time=((), (variables["time"][1] * 1000).round().astype(np.int64), {"units": "milliseconds since 2022-08-10"}),
        **{"reference/time": ((), variables["reference/time"][1] + 3600, {"units": "s since 2022-08-09T23:00:00Z"})},
    )
    survey = read_canonical(path)
    for name in ("b_raw", "position", "temperature", "time", "reference/time"):
        np.testing.assert_allclose(survey.values(name), variables[name][1], rtol=1e-12, atol=1e-9)
        assert survey[name].attrs["units"] == variables[name][2]["units"]


def test_packed_netcdf_values_are_unpacked(tmp_path: Path) -> None:
    counts = np.round(array_variables(60)["b_raw"][1] / 2).astype(np.int32)
    counts[3, 1, 2] = -(2**31)
    attributes = {"units": "nT", "scale_factor": 2.0, "add_offset": 0.5, "_FillValue": np.int32(-(2**31))}
    survey = read_canonical(plain_file(tmp_path / "k.h5", b_raw=((), counts, attributes)))
    expected = counts * 2.0 + 0.5
    expected[3, 1, 2] = np.nan
    np.testing.assert_array_equal(survey.values("b_raw"), expected)


def test_sensor_names_have_a_default_and_other_groups_are_mentioned(tmp_path: Path) -> None:
    path = plain_file(
        tmp_path / "d.h5", sensor=((), None, {}), axis=((), None, {}), **{"truth/offset": ((), np.zeros((4, 3)), {})}
    )
    survey = read_canonical(path)
    assert survey.sensors == ["S1", "S2", "S3", "S4"]
    assert "truth/ (1 dataset)" in " ".join(survey.attributes["notes"])


def test_a_channel_of_another_length_is_left_out_with_the_reason(tmp_path: Path) -> None:
    winch = ((), np.arange(17.0), {"units": "m"})
    survey = read_canonical(plain_file(tmp_path / "w.h5", winch=winch))
    rows = len(survey.time)
    assert f"left out: winch (17 rows, the survey has {rows})" in " ".join(survey.attributes["notes"])
    assert "winch" not in survey


@pytest.mark.parametrize(
    ("name", "values", "why"),
    [
        ("mode", np.array([b"hover", b"turn"] * 30), "text"),
        ("serial", np.float64(17.0), "a single value"),
        ("spectra", np.zeros((60, 5)), "shape (60, 5)"),
        ("diurnal", np.zeros(60), "the name of a result"),
    ],
)
def test_what_is_no_channel_is_left_out_with_the_reason(tmp_path: Path, name: str, values: Any, why: str) -> None:
    survey = read_canonical(plain_file(tmp_path / "w.h5", **{name: ((), values, {})}))
    assert f"left out: {name} ({why})" in " ".join(survey.attributes["notes"])
    assert name not in survey


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"b_raw": ((), None, {})}, "there is no dataset b_raw"),
        ({"time": ((), None, {})}, "there is no dataset time"),
        (
            {"b_raw": ((), np.zeros((60, 12)), {"units": "nT"})},
            r"b_raw: shape \(60, 12\) is not \(time, sensor, axis\)",
        ),
        ({"b_raw": ((), np.zeros((59, 4, 3)), {"units": "nT"})}, "time has 60 values, and b_raw has 59 samples"),
        ({"b_raw": ((), np.zeros((60, 4, 3)), {})}, "b_raw: it has no units; nT is expected"),
        ({"b_raw": ((), np.zeros((60, 4, 3)), {"units": "V"})}, "b_raw: 'V' is a voltage"),
        ({"b_raw": ((), np.zeros((60, 4, 3)), {"units": "nanoT"})}, "b_raw: unknown unit 'nanoT'"),
        ({"b_raw": ((), np.full((60, 4, 3), "x"), {"units": "nT"})}, "b_raw: it holds text; real numbers are needed"),
        ({"attitude": ((), np.full((60, 4), 1.0), {})}, "attitude: the quaternions' median norm is 2, not 1"),
        ({"position": ((), np.zeros((3, 4)), {"units": "m"})}, r"position: shape \(3, 4\) is not \(sensor 4, axis 3\)"),
        ({"temperature": ((), np.zeros(17), {"units": "degC"})}, r"temperature: shape \(17,\) is not \(time 60\)"),
        ({"current_a": ((), np.zeros(60), {"units": "V"})}, "current_a: 'V' is a voltage, an electric current"),
        ({"time": ((), np.arange(60.0), {"units": "s"})}, "time: units 's' name no epoch"),
        ({"time": ((), np.arange(60.0), {})}, "time: it has no units"),
        ({"time": ((), np.arange(60.0), {"units": "seconds since tomorrow"})}, "time: 'tomorrow' is not an ISO 8601"),
        ({"sensor": ((), np.array(["a", "b"]), {})}, "sensor names, but b_raw has 4 sensors"),
        ({"sensor": ((), np.array(["a", "a", "b", "c"]), {})}, "are not unique"),
        ({"axis": ((), np.array(["z", "y", "x"]), {})}, "axes are z, y, x; the layout has x, y, z"),
        ({"segment": ((), np.arange(60) / 2, {})}, "segments must be whole numbers"),
        ({"reference/total_field": ((), None, {})}, "there is no reference/total_field"),
        ({"reference/total_field": ((), np.zeros(5), {"units": "nT"})}, r"reference/total_field: shape \(5,\)"),
    ],
)
def test_what_is_wrong_is_said_with_file_and_dataset(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        read_canonical(plain_file(tmp_path / "wrong.h5", **changes))
    assert "wrong.h5" in str(caught.value)


def test_an_attitude_that_is_no_rotation_is_taken_as_missing(tmp_path: Path) -> None:
    attitude = np.tile([0.0, 0.6, 0.0, 0.8], (60, 1))
    attitude[:5] = 0.0  # unknown
    attitude[7] *= 1.5
    survey = read_canonical(plain_file(tmp_path / "q.h5", attitude=((), attitude, {})))
    assert np.isnan(survey.values("attitude")).all(axis=1).nonzero()[0].tolist() == [0, 1, 2, 3, 4, 7]
    assert "6 quaternions whose norm is not 1" in " ".join(survey.attributes["notes"])
    np.testing.assert_array_equal(survey.values("attitude")[10:], attitude[10:])


def test_unknown_dimension_names(tmp_path: Path) -> None:
    field = array_variables(60)["b_raw"][1]
    xr.Dataset(
        {"b_raw": (("time", "magnetometer", "axis"), field, {"units": "nT"})},
        {"time": ("time", np.arange(60.0), {"units": START})},
    ).to_netcdf(tmp_path / "dims.nc", engine="h5netcdf")
    # A dimension without values has no name in plain HDF5 but its scale's.
    with pytest.raises(
        DataError, match=r"b_raw: dimensions \(time, magnetometer, axis\) are not \(time, sensor, axis\)"
    ):
        read_canonical(tmp_path / "dims.nc")


def test_a_truncated_file(tmp_path: Path) -> None:
    path = plain_file(tmp_path / "cut.h5")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DataError, match=r"cut\.h5: the HDF5 file is truncated"):
        read_canonical(path)


def test_a_file_that_is_no_hdf5(tmp_path: Path) -> None:
    (tmp_path / "text.nc").write_text("1,2,3\n" * 50)
    with pytest.raises(DataError, match=r"text\.nc: this is not an HDF5 file"):
        read_canonical(tmp_path / "text.nc")
    (tmp_path / "empty.nc").write_bytes(b"")
    with pytest.raises(DataError, match=r"empty\.nc: the file is empty"):
        read_canonical(tmp_path / "empty.nc")
    with pytest.raises(DataError, match=r"no such file \(did you mean text\.nc"):
        read_canonical(tmp_path / "texts.nc")


def test_corrupt_bytes_are_an_error_or_whole_data_never_a_crash(tmp_path: Path) -> None:
    """Every stretch of the file overwritten in turn: a clear refusal, or a survey that was not touched by it."""
    path = plain_file(tmp_path / "ok.h5")
    content = path.read_bytes()
    refused = 0
    for start in range(0, len(content), max(1, len(content) // 150)):
        damaged = tmp_path / "damaged.h5"
        damaged.write_bytes(content[:start] + b"\xa5" * 40 + content[start + 40 :])
        try:
            read_canonical(damaged)
        except DataError as error:
            refused += 1
            assert "damaged.h5" in str(error)
    assert refused > 5


def test_a_checksummed_chunk_that_is_corrupt_is_named(tmp_path: Path) -> None:
    path = tmp_path / "chunk.h5"
    plain_file(path, b_raw=((), None, {}))
    field = array_variables(60)["b_raw"][1]
    with h5py.File(path, "a") as file:
        dataset = file.create_dataset("b_raw", data=field, chunks=(60, 4, 3), fletcher32=True)
        dataset.attrs["units"] = "nT"
        place = dataset.id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[place + 100] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"chunk\.h5: b_raw: the values cannot be read"):
        read_canonical(path)


def test_times_of_too_few_digits_are_refused(tmp_path: Path) -> None:
    """Seconds since 1970 as 32-bit numbers are 128 s apart; those of the survey are not, nor those of a slow clock."""
    _, time, attributes = array_variables(60)["time"]
    since_1970 = {**attributes, "units": "seconds since 1970-01-01T00:00:00Z"}
    coarse = plain_file(tmp_path / "coarse.h5", time=(("time",), np.float32(100.0 * time + 1.7e9), since_1970))
    with pytest.raises(DataError, match=r"32-bit numbers near .* are 128 apart"):
        read_canonical(coarse)
    for name, seconds in (("fine", time - time[0]), ("whole", np.floor(time - time[0]))):
        file = plain_file(tmp_path / f"{name}.h5", time=(("time",), np.float32(seconds), attributes))
        np.testing.assert_allclose(read_canonical(file).time, seconds, atol=1e-5)
