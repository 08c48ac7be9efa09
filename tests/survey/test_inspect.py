"""inspect: what is said of a file, and that the proposed mapping can be pasted and loads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from survey_cases import array_variables

from magtensor.errors import DataError, UsageError
from magtensor.survey.canonical import write_canonical
from magtensor.survey.inspect import FileFacts, describe, show
from magtensor.survey.model import Survey
from magtensor.survey.sections import SurveySection
from magtensor.survey.source import Source

N = 500


def field(seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(N, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return 48_000 * directions + rng.normal(size=(N, 3)) + 300


def pasted(facts: FileFacts, folder: Path, readers: dict[str, Any]) -> Survey:
    """The survey that the proposed mapping reads."""
    section = yaml.safe_load(facts.mapping)["survey"]
    return Source(SurveySection.model_validate_json(json.dumps(section)), folder, readers).read()


def test_a_canonical_file_needs_no_mapping(tmp_path: Path, registered: dict[str, Any]) -> None:
    write_canonical(Survey.build(array_variables()), tmp_path / "s.nc")
    facts = describe(tmp_path / "s.nc", registered)
    assert facts.canonical
    assert yaml.safe_load(facts.mapping) == {"survey": {"file": str(tmp_path / "s.nc")}}
    by_name = {c.name: c for c in facts.columns}
    assert by_name["b_raw"].shape == (400, 4, 3)
    assert by_name["b_raw"].dims == ("time", "sensor", "axis")
    assert by_name["b_raw"].units == "nT"
    assert "time: 400 samples over 39.9 s, 10 Hz, no gaps" in facts.sampling
    assert facts.reader == "hdf5"


def test_a_logger_s_table_by_names(tmp_path: Path, registered: dict[str, Any]) -> None:
    time = np.arange(N) * 0.1
    time[300:] += 7
    rng = np.random.default_rng(2)
    acceleration = 9.81 * rng.normal(size=(N, 3)) / np.sqrt(3)
    names = [
        "t_s", "mag1_x_nT", "mag1_y_nT", "mag1_z_nT", "acc_x", "acc_y", "acc_z", "roll", "pitch", "yaw",
        "motor_current_A", "board temp [degC]", "F_nT", "door",
    ]  # fmt: skip
    angles = rng.uniform(-90, 90, (N, 3))
    table = np.column_stack(
        [time, field(), acceleration, angles, rng.normal(size=(N, 2)), np.full(N, 48_000.0), np.arange(N) % 2]
    )
    table[40:50, 11] = np.nan
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(names), comments="", fmt="%.17g")
    facts = describe(tmp_path / "log.csv", registered)
    assert facts.sampling == ("t_s: 500 samples over 56.9 s, 10 Hz, 1 gaps (longest 7.1 s)",)
    assert {c.name: round(c.missing, 3) for c in facts.columns if c.missing} == {"board temp [degC]": 0.02}
    survey = pasted(facts, tmp_path, registered)
    np.testing.assert_array_equal(survey.values("b_raw")[:, 0], table[:, 1:4])
    np.testing.assert_array_equal(survey.values("acceleration"), acceleration)
    np.testing.assert_array_equal(survey.values("temperature"), table[:, 11])
    assert {"current_motor", "attitude", "door", "reference/total_field"} <= set(survey.paths())


def test_an_hdf5_file_by_shapes_and_magnitudes(tmp_path: Path, registered: dict[str, Any]) -> None:
    with h5py.File(tmp_path / "imu.hdf5", "w") as file:
        file["imu_mag"] = field() / 1000
        file["imu_gyr"] = np.random.default_rng(3).normal(size=(N, 3))
        file["opt_quat"] = np.tile([1.0, 0, 0, 0], (N, 1))
        file.attrs["sampling_rate"] = 250.0
    survey = pasted(describe(tmp_path / "imu.hdf5", registered), tmp_path, registered)
    np.testing.assert_allclose(survey.values("b_raw")[:, 0], field(), rtol=1e-12)
    assert survey.time[1] == 1 / 250
    assert {"angular_rate", "attitude"} <= set(survey.paths())
    np.testing.assert_array_equal(survey.values("attitude")[0], [0, 0, 0, 1])


def test_a_table_without_names_by_its_content(tmp_path: Path, registered: dict[str, Any]) -> None:
    rng = np.random.default_rng(4)
    counts = np.round(field() / 1000 * 75)
    table = np.column_stack([1_740_234_825 + np.arange(N) * 0.1, rng.normal(size=(N, 2)), counts, rng.normal(size=N)])
    table[77, 3] = 65_503
    np.savetxt(tmp_path / "raw.csv", table, delimiter=",", fmt="%.17g")
    facts = describe(tmp_path / "raw.csv", registered)
    section = yaml.safe_load(facts.mapping)["survey"]
    assert section["time"] == {"from": 0, "units": "s", "epoch": "unix"}
    assert section["sensors"]["S1"]["from"] == [3, 4, 5]
    magnitude = np.linalg.norm(pasted(facts, tmp_path, registered).values("b_raw")[:, 0], axis=1)
    assert np.median(magnitude) == pytest.approx(50_000, rel=0.02)


def test_a_time_with_its_unit_in_the_header(tmp_path: Path, registered: dict[str, Any]) -> None:
    table = np.column_stack([np.arange(N) * 0.5, field() / 1000, np.full(N, 48_000.0)])
    np.savetxt(tmp_path / "a.csv", table, delimiter=";", header="t (s);Bx (uT);By (uT);Bz (uT);F (nT)", comments="")
    survey = pasted(describe(tmp_path / "a.csv", registered), tmp_path, registered)
    np.testing.assert_array_equal(survey.time, table[:, 0])
    assert "t_s" not in survey.paths()


def test_a_date_and_a_clock_are_one_time(tmp_path: Path, registered: dict[str, Any]) -> None:
    rows = [f"2024-05-05,10:{i // 60:02d}:{i % 60:02d},{x},{y},{z}" for i, (x, y, z) in enumerate(field())]
    (tmp_path / "a.csv").write_text("date,time,mag_x,mag_y,mag_z\n" + "\n".join(rows) + "\n")
    survey = pasted(describe(tmp_path / "a.csv", registered), tmp_path, registered)
    np.testing.assert_array_equal(survey.time - survey.time[0], np.arange(N))


def test_an_array_and_a_base_station_with_their_own_clocks(tmp_path: Path, registered: dict[str, Any]) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["base/t"], file["base/F"] = np.arange(30) * 2.0, np.full(30, 48_000.0)
        file["rec/clock"], file["rec/mag"] = np.arange(N) * 0.1, np.hstack([field(1), field(2)])
    survey = pasted(describe(tmp_path / "a.h5", registered), tmp_path, registered)
    np.testing.assert_array_equal(survey.values("b_raw"), np.stack([field(1), field(2)], axis=1))
    np.testing.assert_array_equal(survey.values("reference/time"), np.arange(30) * 2.0)


def test_the_layout_without_an_epoch_gets_a_mapping(tmp_path: Path, registered: dict[str, Any]) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time"], file["b_raw"] = np.arange(N) * 0.1, np.stack([field(1), field(2)], axis=1)
        file["time"].attrs["units"], file["b_raw"].attrs["units"] = "s", "nT"
    facts = describe(tmp_path / "a.h5", registered)
    assert not facts.canonical
    assert pasted(facts, tmp_path, registered).values("b_raw").shape == (N, 2, 3)


def test_a_file_that_is_not_there_is_told_once(tmp_path: Path, registered: dict[str, Any]) -> None:
    with pytest.raises(DataError, match="there is no such file") as told:
        describe(tmp_path / "a.weird", registered)
    assert str(told.value).count("no such file") == 1


def test_a_column_called_y_survives_yaml(tmp_path: Path, registered: dict[str, Any]) -> None:
    np.savetxt(
        tmp_path / "a.csv", np.column_stack([np.arange(N), field()]), delimiter=",", header="t,x,y,z", comments=""
    )
    survey = pasted(describe(tmp_path / "a.csv", registered), tmp_path, registered)
    np.testing.assert_allclose(survey.values("b_raw")[:, 0], field())


def test_an_unknown_ending_is_tried_with_every_reader(tmp_path: Path, registered: dict[str, Any]) -> None:
    np.savetxt(tmp_path / "a.weird", np.column_stack([np.arange(N), field()]), header="t x y z", comments="")
    facts = describe(tmp_path / "a.weird", registered)
    assert facts.reader == "text"
    assert "reader: text" in facts.mapping
    (tmp_path / "b.weird").write_bytes(bytes(range(256)) * 20)
    with pytest.raises(DataError, match=r"b\.weird: no reader understands this file"):
        describe(tmp_path / "b.weird", registered)


def test_an_unknown_reader(tmp_path: Path, registered: dict[str, Any]) -> None:
    (tmp_path / "a.csv").write_text("1,2\n")
    with pytest.raises(UsageError, match="there is no reader txt"):
        describe(tmp_path / "a.csv", registered, "txt")


def test_show_prints_columns_and_mapping(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = np.column_stack([np.arange(N), field()])
    np.savetxt(tmp_path / "a.csv", table, header="t,bx [nT],by [nT],bz [nT]", comments="",
               delimiter=",")  # fmt: skip
    show(tmp_path / "a.csv")
    printed = capsys.readouterr().out
    assert "bx [nT]" in printed
    mapping = printed[printed.index("survey:") :]
    assert str(tmp_path / "a.csv") in mapping
    assert yaml.safe_load(mapping)["survey"]["sensors"]["S1"]["from"] == ["bx [nT]", "by [nT]", "bz [nT]"]
