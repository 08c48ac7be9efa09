"""Mappings: from anybody's columns to the survey, and the messages when the mapping does not fit the file."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from survey_cases import array_variables

from magtensor.errors import DataError
from magtensor.survey.altitude import dipole_decrease, pressure_height
from magtensor.survey.canonical import write_canonical
from magtensor.survey.mapping import euler_quaternion
from magtensor.survey.model import Survey
from magtensor.survey.quantities import interpolated, signed, unwrapped
from magtensor.survey.sections import SurveySection
from magtensor.survey.times import numbers_to_seconds, parse_instant, texts_to_seconds

Load = Callable[..., Survey]
N = 200


def tumbling(seed: int = 1) -> np.ndarray:
    """(N, 3) nT, whole numbers."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(N, 3))
    return np.round(48_000 * directions / np.linalg.norm(directions, axis=1, keepdims=True))


def write_table(path: Path, columns: dict[str, Any], *, header: bool = True) -> None:
    lines = [",".join(columns)] if header else []
    lines += [",".join(str(v) for v in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join(lines) + "\n")


def base_columns(field: np.ndarray) -> dict[str, Any]:
    return {"t": np.arange(N) * 0.1, "bx": field[:, 0], "by": field[:, 1], "bz": field[:, 2]}


BASE = {"file": "log.csv", "time": {"from": "t"}, "sensors": {"A": {"from": ["bx", "by", "bz"], "units": "nT"}}}


def test_scale_offset_axes_and_units_per_column(tmp_path: Path, load_section: Load) -> None:
    field = tumbling()
    counts = np.round(field / 40)
    write_table(tmp_path / "log.csv", base_columns(counts))
    sensor = {
        "from": ["bx", "by", "bz"], "units": "uT", "scale": "1/25", "offset": [0.1, 0, -0.2],
        "axes": ["y", "-x", "z"], "position": [1, 2, 3],
    }  # fmt: skip
    survey = load_section({**BASE, "sensors": {"A": sensor}})
    in_nt = (counts / 25 + [0.1, 0, -0.2]) * 1000
    np.testing.assert_allclose(survey.values("b_raw")[:, 0], np.stack([in_nt[:, 1], -in_nt[:, 0], in_nt[:, 2]], 1))
    np.testing.assert_array_equal(survey.values("position"), [[1, 2, 3]])
    assert survey["b_raw"].attrs["units"] == "nT"
    assert survey["time"].attrs["comment"] == "the files do not say when time 0 was"


def test_hdf5_datasets_and_their_parts(tmp_path: Path, load_section: Load) -> None:
    one, two = tumbling(1), tumbling(2)
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file["mag/raw"] = np.stack([one, two], axis=1) / 1000
        file["mag/raw"].attrs["units"] = "uT"
        file["flat"] = np.concatenate([one, two], axis=1)
        file["clock"] = np.arange(N, dtype=np.int64) * 100_000_000 + 1_660_089_600_000_000_000
        file["table"] = np.array([(i, 20.5) for i in range(N)], dtype=[("n", "i4"), ("temp", "f8")])
    survey = load_section(
        {
            "file": "raw.h5",
            "time": {"from": "clock", "units": "ns", "epoch": "unix"},
            "sensors": {
                "A": {"from": "mag/raw[0]"}, "B": {"from": "/mag/raw[1]"}, "C": {"from": "flat[0:3]", "units": "nT"},
                "D": {"from": ["flat[3]", "flat[4]", "flat[5]"], "units": "nT"},
            },
            "channels": {"temperature": {"from": "table/temp", "units": "degC"}},
        },
        copied_axes="accept",
    )  # fmt: skip
    for i, expected in enumerate([one, two, one, two]):
        np.testing.assert_allclose(survey.values("b_raw")[:, i], expected, rtol=1e-12)
    assert survey["time"].attrs["units"] == "seconds since 2022-08-10T00:00:00Z"
    np.testing.assert_allclose(survey.time, np.arange(N) * 0.1, atol=1e-9)
    assert survey.values("temperature")[0] == 20.5


def test_files_in_the_order_of_their_times(tmp_path: Path, load_section: Load) -> None:
    field, columns = tumbling(), base_columns(tumbling())
    for name, part in (("b.csv", slice(0, 80)), ("a.csv", slice(80, N))):
        write_table(tmp_path / name, {k: v[part] for k, v in columns.items()})
    section = {**BASE, "files": "*.csv"}
    del section["file"]
    with pytest.raises(DataError, match=r"the clock steps back at sample 120, from t = 19\.900 s to t = 0\.000 s"):
        load_section(section)
    survey = load_section({**section, "order": "time"})
    np.testing.assert_array_equal(survey.values("b_raw")[:, 0], field)
    np.testing.assert_array_equal(load_section({**section, "files": ["b.csv", "a.csv"]}).values("b_raw")[:, 0], field)


def test_numbers_that_cannot_be_believed(tmp_path: Path, load_section: Load) -> None:
    columns = base_columns(tumbling())
    columns["by"] = columns["by"].copy()
    columns["by"][17] = 65_503
    columns["temp"] = np.full(N, 4091.5)
    columns["temp"][30:40] = -999
    write_table(tmp_path / "log.csv", columns)
    sensor = {"from": ["bx", "by", "bz"], "units": "nT", "valid": [-60000, 60000]}
    survey = load_section(
        {
            **BASE,
            "sensors": {"A": sensor},
            "channels": {
                "temperature": {"from": "temp", "units": "degC", "wrap": 4096, "missing": [-999]},
                "checked": {"from": "temp", "valid": [0, 5000]},
            },
        }
    )
    assert np.flatnonzero(~survey.good).tolist() == [17]
    assert survey.values("b_raw")[17, 0, 1] == 65_503, "flagged samples keep their values"
    assert [f.reason for f in survey.flags] == ["a number outside the range that the mapping calls valid"]
    temperature = survey.values("temperature")
    assert np.isnan(temperature[30:40]).all()
    np.testing.assert_array_equal(np.delete(temperature, slice(30, 40)), -4.5)
    assert np.isnan(survey.values("checked")).sum() == 10
    assert "channels.checked: 10 numbers outside the valid range" in survey.attributes["notes"][0]


def test_a_sensor_and_a_channel_from_other_files(tmp_path: Path, load_section: Load) -> None:
    field = tumbling()
    write_table(tmp_path / "log.csv", base_columns(field))
    slow = np.arange(0.0, 25.0, 0.5)
    slow = slow[(slow < 8) | (slow > 12)]
    write_table(tmp_path / "slow.csv", {"t": slow, "temp": 10 + 2 * slow})
    write_table(tmp_path / "twin.csv", base_columns(tumbling(2)))
    time = {"from": "t", "units": "s"}
    survey = load_section(
        {
            **BASE,
            "sensors": {
                **BASE["sensors"],
                "B": {"file": "twin.csv", "time": time, "from": ["bx", "by", "bz"], "units": "nT"},
            },
            "channels": {"temperature": {"file": "slow.csv", "time": time, "from": "temp", "units": "degC"}},
        }
    )
    np.testing.assert_array_equal(survey.values("b_raw")[:, 1], tumbling(2))
    temperature, at = survey.values("temperature"), survey.time
    outside = (at > 7.5) & (at < 12.5)
    np.testing.assert_allclose(temperature[~outside], 10 + 2 * at[~outside], rtol=1e-12)
    assert np.isnan(temperature[outside]).all()


def test_references(tmp_path: Path, load_section: Load) -> None:
    columns = base_columns(tumbling()) | {"F": np.full(N, 47_900.5), "vx": np.full(N, 30e3), "vy": np.full(N, 40e3)}
    columns |= {"vz": np.zeros(N), "p": np.full(N, 1013.25)}
    write_table(tmp_path / "log.csv", columns)
    write_table(tmp_path / "base.csv", {"unix": 1_660_089_600 + np.arange(30), "F": np.full(30, 48.0)})

    def reference(section: dict[str, Any], **more: Any) -> Any:
        return load_section({**BASE, "reference": section, **more})["reference/total_field"]

    own = reference({"total_field": {"from": "F", "units": "nT"}})
    assert own.shape == (N,)
    assert own.attrs["origin"] == "measured"
    vector = reference({"components": {"from": ["vx", "vy", "vz"], "units": "nT"}})
    np.testing.assert_array_equal(vector.values, 50_000.0)
    constant = reference({"constant": {"value": 48.1, "units": "uT", "why": "a guess"}})
    np.testing.assert_allclose(constant.values, 48_100.0)
    assert (constant.attrs["origin"], constant.attrs["why"]) == ("constant", "a guess")
    world = load_section({**BASE, "reference": {"world_field": {"value": [0, 20, -40], "units": "uT"}}})
    np.testing.assert_allclose(world.values("reference/total_field"), np.hypot(20e3, 40e3))
    np.testing.assert_array_equal(world.values("reference/world_field"), [0, 20e3, -40e3])
    model = {"value": 50, "units": "uT", "pressure": {"from": "p", "units": "hPa"}}
    np.testing.assert_allclose(reference({"altitude_model": model}).values, 50_000.0, atol=1e-6)
    time = {"from": "unix", "epoch": "unix"}
    other = load_section(
        {
            **BASE,
            "time": {"from": "t", "epoch": "2022-08-09T23:59:50Z"},
            "reference": {"file": "base.csv", "time": time, "total_field": {"from": "F", "units": "uT"}},
        }
    )
    np.testing.assert_allclose(other.values("reference/time"), 10 + np.arange(30))
    np.testing.assert_allclose(other.values("reference/total_field"), 48_000)


def test_a_canonical_survey_with_another_reference(tmp_path: Path, load_section: Load) -> None:
    write_canonical(Survey.build(array_variables()), tmp_path / "s.nc")
    write_table(tmp_path / "base.csv", {"unix": 1_660_089_600 + np.arange(50), "F": np.full(50, 48_111.0)})
    reference = {"file": "base.csv", "time": {"from": "unix", "epoch": "unix"}}
    survey = load_section({"file": "s.nc", "reference": {**reference, "total_field": {"from": "F", "units": "nT"}}})
    np.testing.assert_array_equal(survey.values("reference/total_field"), 48_111.0)
    np.testing.assert_array_equal(survey.values("reference/time"), np.arange(50))
    constant = load_section({"file": "s.nc", "reference": {"constant": {"value": 48_000, "units": "nT"}}})
    assert set(constant.values("reference/total_field")) == {48_000.0}
    world = load_section({"file": "s.nc", "reference": {"world_field": {"value": [0, 20, -40], "units": "uT"}}})
    np.testing.assert_array_equal(world.values("reference/world_field"), [0, 20e3, -40e3])
    own = load_section({"file": "s.nc"})
    np.testing.assert_array_equal(world.values("reference/total_field"), own.values("reference/total_field"))
    np.testing.assert_array_equal(world.values("reference/time"), own.values("reference/time"))


def test_attitude_conventions(tmp_path: Path, load_section: Load) -> None:
    """One rotation written in four ways: 90 degrees about z, platform x pointing to world y."""
    half = np.sqrt(0.5)
    columns = base_columns(tumbling()) | {"w": [half] * N, "x": [0.0] * N, "y": [0.0] * N, "z": [half] * N}
    columns |= {"mz": [-half] * N, "roll": [0.0] * N, "pitch": [0.0] * N, "yaw": [90.0] * N}
    write_table(tmp_path / "log.csv", columns)
    for section in (
        {"from": ["w", "x", "y", "z"], "scalar": "first"},
        {"from": ["x", "y", "z", "w"], "scalar": "last"},
        {"from": ["w", "x", "y", "mz"], "scalar": "first", "maps": "world to platform"},
        {"euler": {"roll": "roll", "pitch": "pitch", "yaw": "yaw"}, "world": "NED"},
    ):
        found = load_section({**BASE, "attitude": section}).values("attitude")
        np.testing.assert_allclose(found, np.tile([0, 0, half, half], (N, 1)), atol=1e-12)


@given(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_euler_angles_against_three_rotation_matrices(roll: float, pitch: float, yaw: float) -> None:
    from scipy.spatial.transform import Rotation

    def turn(axis: int, angle: float) -> np.ndarray:
        c, s = np.cos(angle), np.sin(angle)
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        matrix = np.eye(3)
        matrix[i, i] = matrix[j, j] = c
        matrix[i, j], matrix[j, i] = -s, s
        return matrix

    quaternion = euler_quaternion(np.array([roll]), np.array([pitch]), np.array([yaw]))
    expected = turn(2, yaw) @ turn(1, pitch) @ turn(0, roll)
    np.testing.assert_allclose(Rotation.from_quat(quaternion[0]).as_matrix(), expected, atol=1e-12)


def test_segments(tmp_path: Path, load_section: Load) -> None:
    time = np.arange(N) * 0.1
    time[120:] += 5
    columns = base_columns(tumbling()) | {"t": time, "line": np.repeat([3, 1], N // 2), "on": np.arange(N) % 50 < 20}
    columns["on"] = columns["on"].astype(int)
    write_table(tmp_path / "log.csv", columns)
    by_line = load_section({**BASE, "segment": {"from": "line"}}).values("segment")
    np.testing.assert_array_equal(by_line, columns["line"])
    by_gap = load_section({**BASE, "segment": {"gaps_s": 1.0}}).values("segment")
    np.testing.assert_array_equal(by_gap, np.arange(N) >= 120)
    by_condition = load_section({**BASE, "segment": {"condition": {"from": "on", "above": 0.5}}}).values("segment")
    assert by_condition[[0, 19, 20, 49, 50, 199]].tolist() == [0, 0, 1, 1, 2, 7]


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"sensors": {"A": {"from": ["bx", "by", "b_z"], "units": "nT"}}}, r"there is no b_z \(did you mean bz"),
        ({"sensors": {"A": {"from": [1, 2, 44], "units": "nT"}}}, "there is no column 44"),
        ({"sensors": {"A": {"from": ["bx", "by", "bz"]}}}, "neither the file nor the mapping says which units"),
        ({"sensors": {"A": {"from": ["bx", "by"], "units": "nT"}}}, "2 columns for a three-axis sensor"),
        ({"sensors": {"A": {"from": ["bx", "by", "word"], "units": "nT"}}}, "this is text where numbers are needed"),
        (
            {"sensors": {"A": {"from": ["bx", "by", "bz"], "units": "nT", "scale": [1, 2]}}},
            "2 numbers of `scale` for 3",
        ),
        ({"channels": {"current_x": {"from": "bx", "units": "V"}}}, "'V' is a voltage, an electric current in A"),
        ({"channels": {"two": {"from": ["bx", "by"]}}}, r"2 columns, but \(time, sensor\) needs 1"),
        ({"time": {"from": "when"}}, "there is no when"),
        ({"time": {"from": "word"}}, "none of the times"),
        ({"time": {"rate_Hz": "rate"}}, "the file has no attribute rate"),
        ({"time": {"from": "t", "format": "%H:%M"}}, "has no day; give the first day"),
        ({"attitude": {"from": ["bx", "by", "bz", "t"], "scalar": "last"}}, "quaternions' median norm is .*, not 1"),
        ({"segment": {"from": "t"}}, "segments must be whole numbers"),
        ({"reference": {"total_field": {"from": "empty", "units": "nT"}}}, "every value is missing"),
    ],
)
def test_what_the_file_does_not_have(tmp_path: Path, load_section: Load, section: dict[str, Any], message: str) -> None:
    columns = base_columns(tumbling()) | {"word": ["abc"] * N, "empty": [""] * N}
    write_table(tmp_path / "log.csv", columns)
    with pytest.raises(DataError, match=message) as caught:
        load_section({**BASE, **section})
    assert "log.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"file": "a.h5", "sensors": {"A": {"from": [1], "units": "degC"}}}, "'degC' is not a unit of magnetic flux"),
        ({"file": "a.h5", "sensors": {"A": {"from": [1], "units": "uTesla"}}}, "unknown unit 'uTesla'"),
        ({"file": "a.h5", "sensors": {"A": {"from": [1], "axes": ["x", "x", "z"]}}}, "must name x, y and z once each"),
        ({"file": "a.h5", "sensors": {}}, "`sensors` is empty"),
        ({"file": "a.h5", "files": "b*"}, "give `file` or `files`, not both"),
        ({"file": "a.h5", "time": {"rate_Hz": 10}}, "a mapping needs `sensors`"),
        ({"file": "a.h5", "sensors": {"A": {"from": [1]}}, "time": {"rate_Hz": 10, "from": "t"}}, "either `from`"),
        ({"file": "a.h5", "sensors": {"A": {"from": [1]}}, "reference": {}}, "give one of total_field, components"),
        ({"file": "a.h5", "reference": {"world_field": {"value": [1, 2], "units": "uT"}}}, "must be three numbers"),
        ({"file": "a.h5", "sensors": {"A": {"from": [1]}}, "attitude": {"from": "q"}}, "say where the quaternion's"),
        (
            {"file": "a.h5", "sensors": {"A": {"from": [1], "position": [0, 0, 0]}, "B": {"from": [2]}}},
            "`position` is given for some sensors but not for B",
        ),
        (
            {"file": "a.h5", "sensors": {"A": {"from": [1]}}, "channels": {"b_raw": {"from": 2}}},
            "cannot be called b_raw",
        ),
        ({"file": "a.h5", "sensors": {"A": {"from": [1], "scale": "one"}}}, "valid number"),
    ],
)
def test_mistakes_in_the_section(section: dict[str, Any], message: str) -> None:
    import json

    with pytest.raises(ValueError, match=message):
        SurveySection.model_validate_json(json.dumps(section))


@given(
    arrays(np.float64, st.integers(1, 60), elements=st.integers(-(2**15), 2**15 - 1)), st.sampled_from([2**16, 2**17])
)
def test_a_register_read_as_unsigned_comes_back(values: np.ndarray, modulus: int) -> None:
    np.testing.assert_array_equal(signed(np.mod(values, modulus), modulus), values)


@given(arrays(np.float64, st.integers(1, 60), elements=st.integers(0, 30_000)), st.integers(0, 65_535))
def test_a_counter_that_wraps_goes_on(steps: np.ndarray, start: int) -> None:
    true = start + np.cumsum(steps)
    read = np.mod(true, 65_536)
    np.testing.assert_array_equal(np.diff(unwrapped(read, 65_536)), np.diff(true))


@given(
    arrays(np.float64, 12, elements=st.floats(0.01, 3)),
    arrays(np.float64, (12, 2), elements=st.floats(-1e5, 1e5)),
    arrays(np.float64, 20, elements=st.floats(-2, 40)),
)
def test_interpolation_stays_between_neighbours_and_out_of_gaps(
    steps: np.ndarray, values: np.ndarray, at: np.ndarray
) -> None:
    time = np.cumsum(steps)
    found = interpolated(at, time, values, 1.0)
    for t, row in zip(at, found, strict=True):
        right = int(np.searchsorted(time, t))
        on_sample = right < len(time) and time[right] == t
        inside = 0 < right < len(time) and time[right] - time[right - 1] <= 1.0
        assert np.isfinite(row).all() == (on_sample or inside)
        if inside and not on_sample:
            slack = 1e-9 * np.abs(values).max()
            assert (row >= values[right - 1 : right + 1].min(axis=0) - slack).all()
            assert (row <= values[right - 1 : right + 1].max(axis=0) + slack).all()
    np.testing.assert_array_equal(interpolated(time, time, values, 0.001), values)


def test_clock_text_passes_midnight() -> None:
    texts = np.array(["23:59:59.5", "00:00:00.5", "junk", "00:00:01.5"])
    seconds, epoch = texts_to_seconds(texts, "%H:%M:%S.%f", datetime(2022, 8, 10, tzinfo=UTC))
    assert epoch == datetime(2022, 8, 10, tzinfo=UTC)
    np.testing.assert_allclose(seconds, [86399.5, 86400.5, np.nan, 86401.5])


@pytest.mark.parametrize(
    "text",
    ["2022-08-10", "2022-08-10T00:00:00Z", "2022-8-10 0:0:0", "2022-08-10 02:00:00+02:00", "2022-08-10 00:00 UTC"],
)
def test_ways_to_write_an_instant(text: str) -> None:
    assert parse_instant(text) == datetime(2022, 8, 10, tzinfo=UTC)


def test_nanoseconds_since_1970_keep_what_a_float_can_hold() -> None:
    exact = np.array([1_660_089_600_123_456_789], dtype=np.int64)
    assert numbers_to_seconds(exact, "ns")[0] == 1_660_089_600.123456789


def test_standard_atmosphere() -> None:
    """Geometric heights and pressures of the U.S. Standard Atmosphere 1976, tables for 0, 5, 15, 25 and 40 km."""
    heights = np.array([0.0, 5_000.0, 15_000.0, 25_000.0, 40_000.0])
    pressures = np.array([1013.25, 540.48, 121.11, 25.492, 2.8714]) * 100
    np.testing.assert_allclose(pressure_height(pressures), heights, atol=6.0)
    assert np.isnan(pressure_height(np.array([50.0, 0.0, -3.0]))).all()
    one_up = dipole_decrease(50_000.0, np.array([1000.0]))[0]
    assert one_up == pytest.approx(50_000 * (1 - 3 * 1000 / 6_371_200), abs=0.01)


def test_the_examples_of_the_documentation_are_valid() -> None:
    import json
    import re

    import yaml

    page = (Path(__file__).parents[2] / "docs" / "surveys.md").read_text()
    blocks = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    assert len(blocks) >= 2
    for block in blocks:
        SurveySection.model_validate_json(json.dumps(yaml.safe_load(block)["survey"]))
