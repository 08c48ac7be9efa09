"""calibrate_joint from files to files: without a scalar reference, with further surveys, with a logged attitude."""

from __future__ import annotations

import hashlib
import io
import json
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

from magtensor import provenance
from magtensor.cli import status_of

SENSORS, NOISE_NT, FIELD_NT = 4, 0.2, 48_500.0
WORLD = FIELD_NT * np.array([0.35, 0.05, np.sqrt(1 - 0.35**2 - 0.05**2)])
FORWARD = np.eye(3) + 0.02 * np.random.default_rng(1).standard_normal((SENSORS, 3, 3))
OFFSET = 100.0 * np.random.default_rng(2).standard_normal((SENSORS, 3))
POSITION = 0.25 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0.0]])


def quaternions(rng: np.random.Generator, count: int) -> np.ndarray:
    """(N, 4) scalar last, platform to world, tumbling slowly."""
    q = np.cumsum(0.05 * rng.standard_normal((count, 4)), axis=0) + rng.standard_normal(4)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def to_world(q: np.ndarray) -> np.ndarray:
    """(N, 3, 3), by the textbook's elements."""
    x, y, z, w = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def written(
    path: Path,
    seed: int,
    *,
    samples: int = 3000,
    apart_nT: float = 0.0,
    reference: bool = False,
    attitude_deg: float | None = None,
    levels: int = 1,
    forward: np.ndarray = FORWARD,
    offset: np.ndarray = OFFSET,
    date: str = "2026-01-01",
) -> np.ndarray:
    """A canonical survey of the array above; the true field (N, 3) in the platform's frame."""
    rng = np.random.default_rng(seed)
    time, q = np.arange(samples) / 10.0, quaternions(rng, samples)
    segment = np.arange(samples) * levels // samples
    size = (FIELD_NT + (200.0 * rng.standard_normal(levels) if levels > 1 else np.zeros(1)))[segment]
    field = np.einsum("nji,j->ni", to_world(q), WORLD / FIELD_NT) * size[:, None]
    offset = offset + apart_nT * rng.standard_normal(OFFSET.shape)
    raw = np.einsum("sij,nj->nsi", forward, field) + offset + NOISE_NT * rng.standard_normal((samples, SENSORS, 3))
    epoch = f"seconds since {date}T00:00:00Z"
    content = {"time": (time, epoch), "b_raw": (raw, "nT"), "position": (POSITION, "m"), "segment": (segment, "1")}
    if reference:
        content |= {"reference/time": (time[::10], epoch), "reference/total_field": (size[::10], "nT")}
    if attitude_deg is not None:
        small = np.column_stack([0.5 * np.radians(attitude_deg) * rng.standard_normal((samples, 3)), np.ones(samples)])
        content["attitude"] = (product(q, small), "1")
    with h5py.File(path, "w") as file:
        for name, (values, units) in content.items():
            file[name] = values
            file[name].attrs["units"] = units
    return field


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of quaternions (N, 4), normalised."""
    vector = a[:, 3:] * b[:, :3] + b[:, 3:] * a[:, :3] + np.cross(a[:, :3], b[:, :3])
    out = np.column_stack([vector, a[:, 3] * b[:, 3] - np.sum(a[:, :3] * b[:, :3], axis=1)])
    return out / np.linalg.norm(out, axis=1, keepdims=True)


@dataclass(frozen=True)
class Done:
    exit_code: int
    output: str


def command(*arguments: object) -> Done:
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(out):
        status = status_of([str(a) for a in arguments])
    return Done(status, out.getvalue())


def run(folder: Path, stages: str, *, further: str = "") -> Done:
    recipe = folder / "r.yaml"
    recipe.write_text(f"title: t\nsurvey: {{file: a.h5{further}}}\nstages: {stages}\n")
    return command("run", recipe, "--output", folder / "out")


def matrix_of(path: Path) -> tuple[xr.DataTree, np.ndarray]:
    with xr.open_datatree(path, engine="h5netcdf", decode_times=False) as opened:
        tree = opened.load()
    return tree, tree["calibration/matrix"].values


def misalignment(matrix: np.ndarray) -> np.ndarray:
    """Singular values less one of every M C: zero for a correction that is right up to a rotation."""
    return np.linalg.svd(matrix @ FORWARD, compute_uv=False) - 1.0


def test_without_a_reference(tmp_path: Path) -> None:
    written(tmp_path / "a.h5", 3)
    done = run(tmp_path, "[load, calibrate_joint: {total_field: constant}, assemble_tensor, qc]")
    assert done.exit_code == 0, done.output
    assert "one scale that all sensors share" in done.output and "no total field was measured" in done.output
    tree, matrix = matrix_of(tmp_path / "out" / "calibration.nc")
    assert np.mean(np.log(np.linalg.det(matrix))) == pytest.approx(0.0, abs=1e-12)
    off = misalignment(matrix)
    assert np.ptp(off) < 2e-5 and abs(off).max() > 1e-4  # one scale of all, and nothing else, is wrong
    facts = json.loads(tree["calibration/matrix"].attrs["diagnostics"])
    assert facts["total_field_nT"] == pytest.approx(FIELD_NT * (1 + off.mean()), abs=1.0)
    applied = command("apply", tmp_path / "out/calibration.nc", tmp_path / "a.h5")
    assert applied.exit_code == 0, applied.output


def test_a_scale_that_was_not_measured_fails_no_verdict(tmp_path: Path) -> None:
    written(tmp_path / "a.h5", 3, reference=True)  # a wrong size of 1000 nT: 5000 times the noise
    joint = f"calibrate_joint: {{total_field: constant, total_field_nT: {FIELD_NT + 1000.0}}}"
    done = run(tmp_path, f"[load, detrend_diurnal, {joint}, qc]")
    assert done.exit_code == 0 and "QC failed" not in done.output, done.output
    tree, _ = matrix_of(tmp_path / "out/result.nc")
    state = dict(zip(tree["qc/metric"].values, tree["qc/state"].values, strict=True))
    assert [state[f"total_field_rms S{i + 1}"] for i in range(SENSORS)] == ["pass"] * SENSORS
    assert "after the scale that was not measured" in str(tree["qc/words"].values)
    # a field that varies is not what the scale explains
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["reference/total_field"][:] += np.linspace(0, 100, len(file["reference/total_field"]))
    assert "QC failed: total_field_rms" in run(tmp_path, f"[load, detrend_diurnal, {joint}, qc]").output


def test_what_needs_the_whole_survey_at_once(tmp_path: Path) -> None:
    written(tmp_path / "a.h5", 3, samples=600, reference=True)
    recipe = tmp_path / "r.yaml"
    for options, said in (
        ("{total_field: constant}", "total_field: constant and the like) needs the whole survey"),
        ("{vector_reference: true}", "calibrate_joint with a vector reference needs the whole survey"),
        ("{error_models: [temperature_offset]}", "error_models: [temperature_offset] needs the whole survey"),
    ):
        recipe.write_text(f"title: t\nsurvey: a.h5\nstages: [load, detrend_diurnal, calibrate_joint: {options}]\n")
        done = command("run", recipe, "--output", tmp_path / "out", "--memory", 1)
        assert done.exit_code == 2 and said in done.output, done.output


def test_a_declared_total_field(tmp_path: Path) -> None:
    written(tmp_path / "a.h5", 3)
    done = run(tmp_path, f"[load, calibrate_joint: {{total_field_nT: {FIELD_NT}}}]")
    assert done.exit_code == 0, done.output
    assert "the total field was declared" in done.output
    assert abs(misalignment(matrix_of(tmp_path / "out/calibration.nc")[1])).max() < 2e-5


@pytest.mark.parametrize("kind", ["constant", "per_survey", "per_segment", "constant, total_field_nT: 48500"])
def test_a_measured_total_field_that_is_put_aside_is_not_called_missing(tmp_path: Path, kind: str) -> None:
    written(tmp_path / "a.h5", 3, samples=600, reference=True)
    done = run(tmp_path, f"[load, detrend_diurnal, calibrate_joint: {{total_field: {kind}}}]")
    unprepared = run(tmp_path, f"[load, calibrate_joint: {{total_field: {kind}}}]")
    for one in (done, unprepared):
        assert one.exit_code == 0, one.output
        assert "the measured total field was put aside, as asked" in one.output
        assert "no total field was measured" not in one.output


def test_unknown_in_every_segment(tmp_path: Path) -> None:
    field = written(tmp_path / "a.h5", 3, levels=4)
    done = run(tmp_path, "[load, calibrate_joint: {total_field: per_segment}, qc]")
    assert done.exit_code == 0, done.output
    tree, matrix = matrix_of(tmp_path / "out/result.nc")
    assert np.ptp(misalignment(matrix)) < 4e-5
    found, true = tree["calibration/total_field"].values, np.linalg.norm(field, axis=1)[::750]
    np.testing.assert_allclose(found / found.mean(), true / true.mean(), atol=1e-6)
    wrong = run(tmp_path, "[load, calibrate_joint]")
    assert wrong.exit_code == 2 and "needs total_field" in wrong.output


def test_further_surveys(tmp_path: Path) -> None:
    for name, seed in (("a", 3), ("b", 4), ("c", 5)):
        written(tmp_path / f"{name}.h5", seed, samples=600, apart_nT=30.0, reference=True)
    stages = "[load, detrend_diurnal, calibrate_joint{}, assemble_tensor, qc]"
    done = run(tmp_path, stages.format(""), further=", with: '[abc].h5'")
    assert done.exit_code == 0, done.output
    tree, matrix = matrix_of(tmp_path / "out/calibration.nc")
    assert abs(misalignment(matrix)).max() < 3e-5
    assert list(tree["calibration/survey"].values) == ["a.h5", "b.h5", "c.h5"]
    np.testing.assert_array_equal(tree["calibration/survey_offset"].values[0], tree["calibration/offset"].values)
    size = 9 * SENSORS + 3 * SENSORS * 3
    assert tree["calibration/survey_covariance"].shape == (size, size)
    # every file that was read is in the provenance, with its hash
    inputs = {Path(i["path"]).name: i["sha256"] for i in provenance.read(tmp_path / "out/result.nc").inputs}
    for name in ("a.h5", "b.h5", "c.h5"):
        assert inputs[name] == hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
    again = command("run", tmp_path / "out/result.nc", "--output", tmp_path / "again")
    assert again.exit_code == 0 and "reproduced bit for bit" in again.output, again.output
    with h5py.File(tmp_path / "c.h5", "r+") as file:
        file["b_raw"][5] += 1.0
    changed = command("run", tmp_path / "out/result.nc", "--output", tmp_path / "again")
    assert changed.exit_code == 3 and "c.h5" in changed.output and "has changed" in changed.output


def test_no_survey_counts_twice(tmp_path: Path) -> None:
    for name, seed in (("a", 3), ("b", 4)):
        written(tmp_path / f"{name}.h5", seed, samples=600)
    stages = "[load, calibrate_joint: {total_field: constant}]"
    once = run(tmp_path, stages, further=", with: b.h5")
    assert once.exit_code == 0 and "named more than once" not in once.output, once.output
    variances = matrix_of(tmp_path / "out/calibration.nc")[0]["calibration/covariance"].values
    again = run(tmp_path, stages, further=", with: [a.h5, b.h5, ./b.h5, '[b]*.h5']")
    assert again.exit_code == 0, again.output
    assert again.output.count("b.h5 is named more than once") == again.output.count("a.h5 is named more than once") == 1
    found = matrix_of(tmp_path / "out/calibration.nc")[0]["calibration/covariance"].values
    np.testing.assert_array_equal(found, variances)
    (tmp_path / "copy.h5").write_bytes((tmp_path / "a.h5").read_bytes())
    copied = run(tmp_path, stages, further=", with: [b.h5, copy.h5]")
    assert copied.exit_code == 3 and "a.h5 and " in copied.output and "copy.h5 hold the same samples" in copied.output


def test_offsets_for_another_survey_are_declared_and_told(tmp_path: Path) -> None:
    for name, seed in (("a", 3), ("b", 4), ("c", 5), ("d", 6)):
        written(tmp_path / f"{name}.h5", seed, samples=600, apart_nT=30.0, reference=True)
    std = {}
    for which, words in (("this", "those of a.h5; they scatter"), ("mean", "the mean of a.h5, b.h5, c.h5")):
        joint = f"calibrate_joint: {{offset_of: {which}}}"
        done = run(tmp_path, f"[load, detrend_diurnal, {joint}, assemble_tensor]", further=", with: [b.h5, c.h5]")
        assert done.exit_code == 0, done.output
        applied = command("apply", tmp_path / "out/calibration.nc", tmp_path / "d.h5")
        assert applied.exit_code == 0 and f"Offsets: {words}" in applied.output, applied.output
        with xr.open_datatree(tmp_path / "d.calibrated.nc", engine="h5netcdf", decode_times=False) as tree:
            assert words in tree["calibrated/b"].attrs["offset_of"]
            std[which] = float(tree["calibrated/tensor_std"].values.mean())
    assert std["this"] == pytest.approx(std["mean"] * np.sqrt(2.0 / (4.0 / 3.0)), rel=0.02)
    # offsets that scatter by 30 nT make a tensor of baselines of 0.5 m uncertain by some 30 / 0.5 nT/m and more; those
    # of one survey lie off by twice the variance, the mean of three by 4 / 3
    assert 20.0 < std["mean"] < 200.0


@pytest.mark.parametrize("matrices", [pytest.param("common", marks=pytest.mark.long), "linear"])
def test_offsets_of_this_survey_are_uncertain_in_another(tmp_path: Path, matrices: str) -> None:
    dates = ("2024-01-01", "2024-06-01", "2025-01-01", "2025-06-01")
    for k, date in enumerate(dates):
        written(tmp_path / f"{'abcd'[k]}.h5", 3 + k, samples=600, apart_nT=30.0, reference=True, date=date)
    joint = f"calibrate_joint: {{matrices: {matrices}}}"
    done = run(tmp_path, f"[load, detrend_diurnal, {joint}, assemble_tensor]", further=", with: [b.h5, c.h5]")
    assert done.exit_code == 0, done.output
    std, said = {}, {}
    for name, more in (("a", ()), ("b", ()), ("d", ()), ("d", ("--memory", 0.5))):
        output = tmp_path / f"{name}{len(more)}.nc"
        applied = command("apply", tmp_path / "out/calibration.nc", tmp_path / f"{name}.h5", "--output", output, *more)
        assert applied.exit_code == 0, applied.output
        with xr.open_datatree(output, engine="h5netcdf", decode_times=False) as tree:
            std[output.stem] = tree["calibrated/tensor_std"].values.mean(axis=0)
            said[output.stem] = tree["calibrated/b"].attrs["offset_of"]
            if name == "d":
                tensor = tree["calibrated/tensor"].values.mean(axis=0)
                assert np.sqrt(np.mean(np.square(tensor / std[output.stem]))) < 2.0
    assert std["a0"].max() < 3.0 < 20.0 < std["d0"].min()
    np.testing.assert_allclose(std["b0"], std["d0"], rtol=0.02)
    np.testing.assert_allclose(std["d2"], std["d0"], rtol=1e-6)
    assert "do not hold" in said["a0"] and "do not hold" not in said["d0"] and "hold" in said["d0"]
    again = command("run", tmp_path / "out/result.nc", "--output", tmp_path / "again")
    assert again.exit_code == 0 and "reproduced bit for bit" in again.output, again.output


def test_a_vector_reference_ties_the_frame(tmp_path: Path) -> None:
    field = written(tmp_path / "a.h5", 3, attitude_deg=0.3)
    joint = "calibrate_joint: {vector_reference: true}"
    world = f", reference: {{world_field: {{value: {WORLD.tolist()}, units: nT}}}}"
    done = run(tmp_path, f"[load, {joint}, fix_rotation, assemble_tensor, qc]", further=world)
    assert done.exit_code == 0, done.output
    assert "one rotation" not in done.output
    tree, matrix = matrix_of(tmp_path / "out/result.nc")
    assert tree["calibration/matrix"].attrs["frame"].startswith("platform")
    assert json.loads(tree["calibration/matrix"].attrs["diagnostics"])["attitude_std_deg"] == pytest.approx(
        0.3, rel=0.06
    )
    b = tree["calibrated/b"].values.mean(axis=1)
    angle = np.linalg.norm(np.cross(b, field), axis=1) / np.sum(b * field, axis=1)
    assert np.degrees(angle.max()) < 5 * 0.3 / np.sqrt(2 * 3000 / 3)
    np.testing.assert_allclose(matrix @ FORWARD, np.tile(np.eye(3), (4, 1, 1)), atol=5e-4)


@pytest.mark.parametrize(
    ("order", "signs", "said"),
    [
        ([0, 1, 2, 3], [-1, -1, -1, 1], "read as the inverse (`maps: world to platform`)"),
        ([3, 0, 1, 2], [1, 1, 1, 1], "read as one with the scalar first (`scalar: first`)"),
    ],
)
def test_an_attitude_that_is_misread_is_not_blamed_on_samples(
    tmp_path: Path, order: list[int], signs: list[int], said: str
) -> None:
    written(tmp_path / "a.h5", 3, samples=600, attitude_deg=0.3)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["attitude"][...] = file["attitude"][()][:, order] * signs
    world = f", reference: {{world_field: {{value: {WORLD.tolist()}, units: nT}}}}"
    done = run(tmp_path, "[load, calibrate_joint: {vector_reference: true}]", further=world)
    assert done.exit_code == 3 and "the attitude does not go with the field" in done.output, done.output
    assert said in done.output and "disturbed samples" not in done.output


@pytest.mark.parametrize(
    ("options", "further", "status", "said"),
    [
        ("{offset_of: mean}", "", 2, "needs further surveys"),
        ("{vector_reference: true}", "", 3, "needs attitude"),
        ("{total_field: per_segment}", ", with: missing.h5", 3, "missing.h5"),
        ("{total_field_nT: 48.5}", "", 2, "greater than 1000"),
        ("{total_field_nT: 48500}", "", 2, "say total_field: constant"),
        ("{vector_reference: true, total_field: constant}", "", 2, "knows the size of the world field"),
        ("{attitude_std_deg: 0.3}", "", 2, "r.yaml:3: stages[2].calibrate_joint: attitude_std_deg needs vector"),
        ("{offset_of: mean, offsets: common}", ", with: a.h5", 2, "offsets of their own"),
    ],
)
def test_mistakes(tmp_path: Path, options: str, further: str, status: int, said: str) -> None:
    written(tmp_path / "a.h5", 3, reference=True, levels=2)
    done = run(tmp_path, f"[load, detrend_diurnal, calibrate_joint: {options}]", further=further)
    assert done.exit_code == status, done.output
    assert said in done.output and "Traceback" not in done.output


@pytest.mark.parametrize(
    ("options", "further", "said"),
    [
        ("{offset_of: mean}", "", "offset_of: mean needs further surveys with offsets of their own"),
        ("{offset_of: mean}", ", with: b.h5", ""),
        ("{error_models: [temperature_offset], matrices: linear}", ", with: b.h5", "not fitted together with matrices"),
        ("{error_models: [temperature_offset]}", "", ""),
        ("{total_field: constant}", ", with: b.h5", ""),
    ],
)
def test_what_further_surveys_contradict_is_found_without_data(
    tmp_path: Path, options: str, further: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = tmp_path / "r.yaml"
    survey = f"{{file: nowhere.h5{further}}}"
    recipe.write_text(f"title: t\nsurvey: {survey}\nstages: [load, detrend_diurnal,\n  calibrate_joint: {options}]\n")
    assert status_of(["validate", str(recipe)]) == (2 if said else 0)
    told = capsys.readouterr().err
    assert (f"{recipe}:4" in told and said in told) if said else not told
    assert "no stage here fits several surveys" not in told


def test_further_surveys_of_a_stage_that_has_no_use_for_them(tmp_path: Path) -> None:
    written(tmp_path / "a.h5", 3, reference=True)
    for stages in ("[load, detrend_diurnal, calibrate_scalar]", "[load, detrend_diurnal, close_loop]"):
        done = run(tmp_path, stages, further=", with: a.h5")
        assert done.exit_code == 2 and "calibrate_joint does" in done.output


def test_another_array_is_refused(tmp_path: Path) -> None:
    for name, seed in (("a", 3), ("b", 4)):
        written(tmp_path / f"{name}.h5", seed, samples=600, reference=True)
    with h5py.File(tmp_path / "b.h5", "r+") as file:
        raw = file["b_raw"][:, :3]
        del file["b_raw"], file["position"]
        file["b_raw"] = raw
        file["b_raw"].attrs["units"] = "nT"
    done = run(tmp_path, "[load, detrend_diurnal, calibrate_joint]", further=", with: b.h5")
    assert done.exit_code == 3 and "b.h5" in done.output and "the survey has S1, S2, S3" in done.output
