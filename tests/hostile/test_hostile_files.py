"""Files that are damaged as files, outputs that cannot be, and the commands beside `run`."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from hostile_surveys import SCENARIO, Contents
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

COMMON = settings(
    max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture(scope="module")
def small(sound_contents: Contents, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A survey of a few kilobytes, so that random bytes hit what matters."""
    contents = sound_contents.copy()
    contents.rows(slice(0, 60))
    return contents.write(tmp_path_factory.mktemp("small") / "small.nc").read_bytes()


@pytest.mark.parametrize("share", [0.0, 1e-9, 0.005, 0.05, 0.3, 0.6, 0.9, 0.9999])
def test_truncated(bench: Any, command: Any, small: bytes, tmp_path: Path, share: float) -> None:
    path = tmp_path / "cut.nc"
    path.write_bytes(small[: int(np.ceil(share * (len(small) - 1)))])
    told = r"cut\.nc: (the file is empty|this is not an HDF5 file|the HDF5 file is (truncated|damaged))"
    bench("joint", path).refused(told)
    command("inspect", path).refused(told)


@pytest.mark.parametrize(
    "content",
    [b"hello world\n" * 10, bytes(5000), b"%PDF-1.4\n", b"PK\x03\x04" + bytes(100), b"CDF\x01" + bytes(100)],
    ids=["text", "zeros", "pdf", "zip", "netcdf3"],
)
def test_not_hdf5(bench: Any, command: Any, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other.nc"
    path.write_bytes(content)
    bench("joint", path).refused(r"other\.nc: this is not an HDF5 file", "inspect|reader")
    command("inspect", path).refused("this is not an HDF5 file")


def test_an_hdf5_signature_and_noise(bench: Any, tmp_path: Path) -> None:
    path = tmp_path / "noise.nc"
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + np.random.default_rng(1).bytes(3000))
    bench("joint", path).refused(r"noise\.nc: the HDF5 file is damaged")


@COMMON
@given(data=st.data())
def test_random_damage_is_told_or_harmless(bench: Any, small: bytes, tmp_path: Path, data: st.DataObject) -> None:
    """Flipped bytes and truncation anywhere: exit status 0 or 3 and never an exception."""
    damaged = bytearray(small)
    for _ in range(data.draw(st.integers(1, 6))):
        damaged[data.draw(st.integers(0, len(small) - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del damaged[data.draw(st.integers(0, len(small))) :]
    path = tmp_path / "damaged.nc"
    path.write_bytes(damaged)
    shutil.rmtree(tmp_path / "results", ignore_errors=True)
    outcome = bench("joint", path)
    if outcome.status != 0:
        outcome.refused("")


@COMMON
@given(data=st.data())
def test_random_damage_to_the_index(command: Any, small: bytes, tmp_path: Path, data: st.DataObject) -> None:
    """The first kilobytes hold the list of datasets and their types."""
    damaged = bytearray(small)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(8, 4096))] = data.draw(st.integers(0, 255))
    path = tmp_path / "damaged.nc"
    path.write_bytes(damaged)
    outcome = command("inspect", path)
    if outcome.status != 0:
        outcome.refused("")


def test_links_references_and_sizes(bench: Any, command: Any, contents: Contents, tmp_path: Path) -> None:
    path = contents.write(tmp_path / "odd.nc")
    with h5py.File(path, "a") as file:
        file["nowhere"] = h5py.SoftLink("/gone")
        file["outside"] = h5py.ExternalLink("gone.h5", "/x")
        file["round"] = h5py.SoftLink("/round")
        references = file.create_dataset("references", (2,), dtype=h5py.ref_dtype)
        references[0] = file["b_raw"].ref
        file.create_dataset("ragged", (5,), dtype=h5py.vlen_dtype("f8"))
        file.create_dataset("huge", shape=(10**9, 10**6), dtype="f8", chunks=(1000, 1000))
    bench("joint", path).succeeded()
    command("inspect", path).succeeded()


def test_a_survey_that_no_memory_holds(bench: Any, tmp_path: Path) -> None:
    path = tmp_path / "endless.nc"
    with h5py.File(path, "w") as file:
        for name, shape in {"b_raw": (10**13, 4, 3), "time": (10**13,)}.items():
            file.create_dataset(name, shape=shape, dtype="f8", chunks=(1000, *shape[1:]))
        file["b_raw"].attrs["units"], file["time"].attrs["units"] = "nT", "seconds since 2026-01-01"
    bench("joint", path).refused(r"endless\.nc: time: its values do not fit into the memory")


@pytest.mark.parametrize("groups", [(), ("b_raw", "time")])
def test_hdf5_without_datasets(bench: Any, tmp_path: Path, groups: tuple[str, ...]) -> None:
    with h5py.File(tmp_path / "empty.nc", "w") as file:
        for name in groups:
            file.create_group(name)
    bench("joint", tmp_path / "empty.nc").refused("the HDF5 file holds no dataset")


def test_more_than_one_file(bench: Any, contents: Contents, tmp_path: Path) -> None:
    contents.write(tmp_path / "a.nc")
    contents.write(tmp_path / "b.nc")
    section = {"files": [str(tmp_path / "a.nc"), str(tmp_path / "b.nc")]}
    bench("joint", tmp_path / "a.nc", survey_section=section).refused("2 files, but a canonical survey is one file")


def test_a_file_that_is_not_there(bench: Any, tmp_path: Path, sound: Path) -> None:
    shutil.copy(sound, tmp_path / "survey.nc")
    bench("joint", tmp_path / "suvey.nc").refused("there is no such file", "did you mean survey.nc")


# --- outputs


@pytest.fixture
def finished(bench: Any, sound: Path) -> Path:
    folder: Path = bench("joint", sound).succeeded().folder
    return folder


def test_outputs_that_cannot_be_written(command: Any, finished: Path, sound: Path, tmp_path: Path) -> None:
    recipe, scenario = tmp_path / "recipe.yaml", tmp_path / "scenario.yaml"
    scenario.write_text(yaml.safe_dump(SCENARIO), encoding="utf-8")
    below = sound / "x"
    command("run", recipe, "--input", sound, "--output", below).refused("cannot be written", status=2)
    command("apply", finished / "calibration.nc", sound, "--output", below).refused("cannot be written", status=2)
    command("simulate", scenario, "--output", below).refused("cannot be written", status=2)
    assert command("run", recipe, "--input", sound, "--output", sound).status == 2


def test_no_output_over_its_input(command: Any, finished: Path, sound: Path, tmp_path: Path) -> None:
    recipe, survey = tmp_path / "recipe.yaml", tmp_path / "mine" / "result.nc"
    survey.parent.mkdir()
    shutil.copy(sound, survey)
    before = survey.read_bytes()
    calibration = finished / "calibration.nc"
    over = "would replace this input"
    command("run", recipe, "--input", survey, "--output", survey.parent).refused(over, status=2)
    command("apply", calibration, survey, "--output", survey).refused(over, status=2)
    command("apply", calibration, survey, "--output", calibration).refused(over, status=2)
    command("simulate", recipe, "--output", recipe).refused(over, status=2)
    assert survey.read_bytes() == before
    assert [p.name for p in survey.parent.iterdir()] == ["result.nc"]


def test_a_failed_run_leaves_the_old_result(bench: Any, finished: Path, contents: Contents) -> None:
    before = {p.name: p.read_bytes() for p in finished.iterdir()}
    contents.b[:, 2, 1] = 12.0
    assert bench("joint", contents).status == 3
    assert {p.name: p.read_bytes() for p in finished.iterdir()} == before


def test_a_result_is_no_survey(bench: Any, finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "copy")
    shutil.rmtree(finished)
    bench("joint", tmp_path / "copy" / "result.nc").refused("this is a result of magtensor, not a survey")


@pytest.mark.parametrize("copied", [False, True])
def test_the_survey_itself_verifies_nothing(command: Any, sound: Path, tmp_path: Path, copied: bool) -> None:
    verify = Path(shutil.copy(sound, tmp_path / "copy.h5")) if copied else sound
    recipe = tmp_path / "r.yaml"
    recipe.write_text("title: t\nstages: [load, detrend_diurnal, calibrate_joint]\n")
    told = command("run", recipe, "--input", sound, "--verify", verify, "--output", tmp_path / "out")
    told.refused("this is the survey itself", status=2)


# --- apply


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.values.update(sensor=np.array(list("ABCD"))), "for the sensors S1, S2, S3, S4, the survey has A"),
        (lambda c: c.values.update(sensor=c.values["sensor"][::-1]), "the survey has S4, S3, S2, S1"),
        (lambda c: c.rows(slice(0, 1)), "single sample"),
        (lambda c: c.values.update(b_raw=c.b / 1e3), "looks like uT labelled nT"),
        (lambda c: c.values.update(position=c.values["position"] * 1.5), "m away from where it was when calibrated"),
    ],
    ids=["other names", "other order", "one sample", "other units", "other places"],
)
def test_apply_to_another_instrument(
    command: Any, finished: Path, contents: Contents, tmp_path: Path, change: Any, message: str
) -> None:
    change(contents)
    target = tmp_path / "out.nc"
    command("apply", finished / "calibration.nc", contents.write(tmp_path / "other.nc"), "--output", target).refused(
        r"other\.nc", message
    )
    assert not target.exists()


def test_apply_to_a_survey_that_is_not_there(command: Any, finished: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.nc"
    command("apply", finished / "calibration.nc", tmp_path / "none.h5", "--output", target).refused(
        r"none\.h5: no such file"
    )
    assert not target.exists()


def test_apply_without_a_reference_and_with_gaps(
    command: Any, finished: Path, contents: Contents, tmp_path: Path
) -> None:
    contents.drop("reference/time", "reference/total_field", "position")
    contents.b[100:110, 1] = np.nan
    other, target = contents.write(tmp_path / "other.nc"), tmp_path / "out.nc"
    command("apply", finished / "calibration.nc", other, "--output", target).succeeded()
    with h5py.File(target) as file, h5py.File(finished / "result.nc") as own:
        good = file["calibrated/good"][()].astype(bool)
        np.testing.assert_array_equal(np.flatnonzero(~good), np.arange(100, 110))
        np.testing.assert_array_equal(file["calibrated/b"][()][good], own["calibrated/b"][()][good])


def test_calibrations_that_are_none(command: Any, finished: Path, sound: Path, tmp_path: Path) -> None:
    stored, target, other = finished / "calibration.nc", tmp_path / "out.nc", tmp_path / "c.nc"
    content = stored.read_bytes()

    def apply() -> Any:
        return command("apply", other, sound, "--output", target)

    apply().refused("no such file")
    for cut in (100, len(content) // 2, len(content) - 10):
        other.write_bytes(content[:cut])
        apply().refused(r"c\.nc: the HDF5 file is truncated")
    other.write_bytes(b"hello")
    apply().refused("this is not an HDF5 file")
    shutil.copy(sound, other)
    apply().refused(r"c\.nc")
    for name in ("matrix", "offset", "covariance"):
        shutil.copy(stored, other)
        with h5py.File(other, "a") as file:
            del file["calibration"][name]
        apply().refused(r"c\.nc")
    shutil.copy(stored, other)
    with h5py.File(other, "a") as file:
        file["calibration/matrix"][...] = np.nan
    apply().refused("the stored calibration is damaged")
    shutil.copy(stored, other)
    with h5py.File(other, "a") as file:
        del file["provenance"]
    assert apply().status in (2, 3)
    assert not target.exists()


def test_report_of_no_result(command: Any, tmp_path: Path) -> None:
    command("report", tmp_path).refused(r"result\.nc: no such file")
    (tmp_path / "result.nc").write_bytes(b"junk")
    command("report", tmp_path).refused(r"result\.nc: this is not an HDF5 file")


def test_a_batch_goes_on_and_lists_what_failed(command: Any, sound: Path, small: bytes, tmp_path: Path) -> None:
    (tmp_path / "recipe.yaml").write_text("title: t\nauthors: [a]\nstages: [load]\n", encoding="utf-8")
    for name, content in {"cut.nc": small[:2000], "text.nc": b"hello", "empty.nc": b""}.items():
        (tmp_path / name).write_bytes(content)
    surveys = [sound, *(tmp_path / n for n in ("cut.nc", "text.nc", "empty.nc", "absent.nc"))]
    outcome = command("batch", tmp_path / "recipe.yaml", *surveys, "--output", tmp_path / "out", "--workers", "1")
    assert outcome.status == 4
    assert "4 of 5 surveys failed" in outcome.error
    assert outcome.error.count("[data, 3]") == 4
    assert "Traceback" not in outcome.error + outcome.out


def test_as_the_user_sees_it(tmp_path: Path, small: bytes) -> None:
    """A real process: the status, the message on standard error, nothing else."""
    (tmp_path / "recipe.yaml").write_text("title: t\nauthors: [a]\nstages: [load]\n", encoding="utf-8")
    (tmp_path / "cut.nc").write_bytes(small[:2000])
    command = [sys.executable, "-m", "magtensor", "run", "recipe.yaml", "--input", "cut.nc", "--output", "out"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert done.stdout == ""
    assert done.stderr.startswith("error: cut.nc: the HDF5 file is truncated")
    assert "Traceback" not in done.stderr


def test_a_text_attribute_turned_into_a_sequence(bench: Any, contents: Contents, tmp_path: Path) -> None:
    """One damaged byte in an attribute's type did this to a survey, and the HDF5 library read beyond its memory."""
    path = contents.write(tmp_path / "turned.nc")
    with h5py.File(path, "a") as file:
        del file["b_raw"].attrs["long_name"]
        sequence = np.empty(1, dtype=object)
        sequence[0] = np.array([1, 2], dtype="i4")
        file["b_raw"].attrs.create("long_name", sequence, dtype=h5py.vlen_dtype("i4"))
    bench("joint", path).succeeded()
