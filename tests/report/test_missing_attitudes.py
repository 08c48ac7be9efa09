"""The picture of missing attitudes: what is marked where, and the command that draws it after a refusal."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml

from magtensor import seen_attitudes
from magtensor.calibration.coverage import Coverage, coverage, same_postures
from magtensor.cli import status_of
from magtensor.errors import NotEnoughData
from magtensor.report import attitude_pictures
from magtensor.report.missing_attitudes import Seen, in_words, picture

pytestmark = pytest.mark.pictures

FIELD = 50_000.0
SINCE = "seconds since 2026-03-21T09:00:00Z"
JOINT: dict[str, Any] = {"title": "joint", "stages": [{"load": {}}, {"detrend_diurnal": {}}, "calibrate_joint"]}


def cap(seed: int, count: int, half_angle_deg: float) -> np.ndarray:
    """Directions (count, 3) within a cone about +z."""
    rng = np.random.default_rng(seed)
    z, turn = rng.uniform(np.cos(np.radians(half_angle_deg)), 1.0, count), rng.uniform(0, 2 * np.pi, count)
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])


def seen(unit: np.ndarray, *, noise: float = 1.0) -> Seen:
    raw = FIELD * unit + noise * np.random.default_rng(5).standard_normal(unit.shape)
    return Seen("S1", unit, coverage(raw, np.full(len(unit), FIELD)))


def written(path: Path, unit: np.ndarray, sensors: int, *, total_field: bool = True, noise: float = 1.0) -> Path:
    """A survey in the canonical layout whose sensors differ by some per cent and some hundred nT."""
    rng = np.random.default_rng(6)
    forward = np.eye(3) + 0.01 * rng.standard_normal((sensors, 3, 3))
    raw = FIELD * np.einsum("sij,nj->nsi", forward, unit) + 100.0 * rng.standard_normal((sensors, 3))
    with h5py.File(path, "w") as file:
        for name, values, units in (
            ("time", np.arange(len(unit)) * 0.5, SINCE),
            ("b_raw", raw + noise * rng.standard_normal(raw.shape), "nT"),
            *((("reference/time", np.arange(len(unit)) * 0.5, SINCE),) if total_field else ()),
            *((("reference/total_field", np.full(len(unit), FIELD), "nT"),) if total_field else ()),
        ):
            file[name] = values
            file[name].attrs["units"] = units
        file["sensor"], file["axis"] = [f"M{k + 1}" for k in range(sensors)], list("xyz")
    return path


def marked(figure: Any) -> dict[int, np.ndarray]:
    """The directions at which numbers stand in the first sensor's discs, the projection undone."""
    found = {}
    for axes, sign in zip(figure.axes[:2], (1.0, -1.0), strict=True):
        for text in axes.texts:
            if text.get_text().isdigit():
                x, y = text.get_position()
                squared = x**2 + y**2
                stretch = np.sqrt(2 - squared)
                found[int(text.get_text())] = np.array([x * stretch, y * stretch, sign * (1 - squared)])
    return found


def change(unit: np.ndarray) -> np.ndarray:
    """(N, 9): of |b| with a symmetric matrix and an offset, by finite differences."""
    steps = [((i, j), None) for i in range(3) for j in range(i, 3)] + [(None, k) for k in range(3)]
    columns = []
    for element, axis in steps:
        matrix, offset = np.eye(3), np.zeros(3)
        if element is not None:
            matrix[element] += 1e-6
            matrix[element[::-1]] = matrix[element]
        if axis is not None:
            offset[axis] = 1e-6
        columns.append((np.linalg.norm(unit @ matrix + offset, axis=1) - 1) / 1e-6)
    return np.stack(columns, axis=1)


def length_std(unit: np.ndarray, weight: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Of |b| in directions `at` after a least-squares fit to `weight` samples in each direction of `unit`, noise of one
    in each sample."""
    std: np.ndarray = np.linalg.norm(change(at) @ np.linalg.pinv(np.sqrt(weight)[:, None] * change(unit)), axis=1)
    return std


@pytest.mark.parametrize("half_angle_deg", [40.0, 70.0])
def test_each_number_stands_where_the_length_is_known_worst_without_it(half_angle_deg: float) -> None:
    unit = cap(1, 200, half_angle_deg)
    anywhere = np.random.default_rng(7).standard_normal((4000, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    one, weight = seen(unit), np.ones(len(unit))
    at = marked(picture([one], "a survey"))
    assert len(at) >= 2 and sorted(at) == list(range(1, len(at) + 1))
    for k in sorted(at):
        worst = length_std(unit, weight, anywhere).max()
        assert one.found.further.error[k - 1] == pytest.approx(worst, rel=0.05)
        assert length_std(unit, weight, at[k][None])[0] > 0.95 * worst
        unit, weight = np.vstack([unit, at[k]]), np.append(weight, one.found.further.each)


def test_the_report_marks_what_its_words_name() -> None:
    unit = cap(1, 200, 40.0)
    one = seen(unit)
    figure = attitude_pictures.coverage(unit[:, None], np.zeros((200, 1)), ["S1"], [one.found])
    at = marked(figure)
    named = str(one.found.further).split("(")[1:]
    assert len(at) == len(named) == min(4, len(one.found.further.directions))
    for k, words in enumerate(named, 1):
        assert np.allclose(at[k], [float(v) for v in words.split(")")[0].split(",")], atol=0.01)


def test_tinted_cones_hold_no_sample_and_reach_to_one() -> None:
    one = seen(cap(2, 300, 60.0))
    axes = picture([one], "a survey").axes[1]  # the lower half: nothing was seen there
    tint = np.asarray(axes.images[-1].get_array())
    rows = np.linspace(-1, 1, len(tint))
    x, y = np.meshgrid(rows, rows)
    inside = x**2 + y**2 < 0.98
    assert (tint[inside] == 0).all()  # the cap of 60 deg leaves the whole lower half empty
    for cone in one.found.empty_cones:
        angle = np.degrees(np.arccos(np.clip(one.unit @ np.array(cone.axis), -1, 1)))
        assert cone.half_angle_deg - 3 < angle.min() < cone.half_angle_deg + 3
        for up in (True, False):
            rim = attitude_pictures.rim(cone, up)
            known = rim[np.isfinite(rim[:, 0])]
            squared = np.sum(known**2, axis=1, keepdims=True)
            z = (1 - squared) * (1 if up else -1)
            direction = np.hstack([known * np.sqrt(2 - squared), z])
            cosine = direction @ np.array(cone.axis)
            assert np.allclose(np.degrees(np.arccos(np.clip(cosine, -1, 1))), cone.half_angle_deg, atol=1e-6)


def test_a_sensor_mounted_turned_is_told_the_same_postures_in_its_own_axes(tmp_path: Path) -> None:
    unit = cap(3, 200, 50.0)
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # from the axes of the first to those of the second
    survey = written(tmp_path / "turned.h5", unit, 2)
    with h5py.File(survey, "r+") as file:
        file["b_raw"][:, 1] = file["b_raw"][:, 1] @ turn.T
    lines = seen_attitudes.draw_attitudes(survey, tmp_path / "turned.svg")
    assert [line.split(":")[0] for line in lines] == ["M1", "M2"]
    plan = seen_attitudes.plan(seen_attitudes.loop_document({}), survey=survey)
    (first, second), measured = seen_attitudes.seen_attitudes(plan)
    assert measured and len(first.found.further.directions) >= 2
    assert np.allclose(first.found.further.directions @ turn.T, second.found.further.directions, atol=0.05)


def test_directions_in_words() -> None:
    assert in_words(np.array([0.02, -0.05, 0.99])) == "along +z"
    assert in_words(np.array([0.1, -0.8, 0.59])) == "between -y and +z"
    assert in_words(np.array([-0.58, 0.57, 0.58])) == "amid -x, +z and +y"


@pytest.mark.parametrize("sensors", [1, 2, 4, 8])
@pytest.mark.parametrize("total_field", [True, False])
def test_any_number_of_sensors(tmp_path: Path, sensors: int, total_field: bool) -> None:
    unit = np.repeat(cap(4, 8, 60.0), 10, axis=0)
    survey = written(tmp_path / "survey.h5", unit, sensors, total_field=total_field)
    plan = seen_attitudes.plan(seen_attitudes.loop_document({}), survey=survey)
    found, measured = seen_attitudes.seen_attitudes(plan)
    assert measured is total_field and len(found) == sensors
    for one in found:
        assert not one.found.determined and "NOT determined" in one.verdict
        assert one.postures[1].endswith("unknown") and len(one.postures) == len(one.found.further.directions) + 3
    figure = picture(found, "a survey")
    assert len([axes for axes in figure.axes if axes.get_title()]) == 2 * sensors


def test_a_long_record_is_read_in_windows_and_judged_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unit = np.vstack([cap(5, 12_000, 20.0), -cap(6, 12_000, 20.0)])  # each half of the record sees one side alone
    survey = written(tmp_path / "long.h5", unit, 2)
    plan = seen_attitudes.plan(seen_attitudes.loop_document({}), survey=survey)
    whole, _ = seen_attitudes.seen_attitudes(plan)
    sizes = []
    load = seen_attitudes.load_as
    monkeypatch.setattr(
        seen_attitudes, "load_as", lambda *given, **how: sizes.append(len((s := load(*given, **how)).time)) or s
    )
    monkeypatch.setattr(seen_attitudes, "MEMORY_GiB", 0.1)  # the least: windows of at most ten thousand rows
    windowed, _ = seen_attitudes.seen_attitudes(plan)
    assert len(sizes) > 1 and max(sizes) <= 10_000 and sum(sizes) == len(unit)
    for one, other in zip(whole, windowed, strict=True):
        assert one.found.determined == other.found.determined
        assert one.found.unseen == other.found.unseen
        assert other.found.samples <= seen_attitudes.MOST_SAMPLES
        assert one.found.worst_error == pytest.approx(other.found.worst_error, rel=0.2)


def refused(recipe: Path, survey: Path, capsys: pytest.CaptureFixture[str], *more: str) -> list[str]:
    """The command that a refused run names, as words."""
    assert status_of(["run", str(recipe), "--input", str(survey), "--output", "out", *more]) == 3
    said = capsys.readouterr().err
    assert "the attitudes do not determine" in said
    assert not Path("out/result.nc").exists()
    (line,) = [part for part in said.splitlines() if "a picture of what is missing: " in part]
    return shlex.split(line.split("missing: ", 1)[1])


@pytest.mark.parametrize("stage", ["calibrate_joint", "calibrate_scalar", {"close_loop": {"undetermined": "refuse"}}])
def test_a_refusal_names_a_command_that_works_as_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], stage: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    survey = written(tmp_path / "my survey.h5", cap(7, 60, 12.0), 2, noise=20.0)
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(yaml.safe_dump(JOINT | {"stages": [*JOINT["stages"][:2], stage]}), encoding="utf-8")
    words = refused(recipe, survey, capsys, "--set", "stages.load.time_faults=drop")
    assert words[:2] == ["magtensor", "inspect"] and str(survey) in words
    assert status_of(words[1:]) == 0
    drawn = Path("my survey.attitudes.svg")
    assert capsys.readouterr().out.splitlines()[-1] == f"attitudes: {drawn}"
    first = drawn.read_bytes()
    assert first.startswith(b"<?xml") and status_of(words[1:]) == 0 and drawn.read_bytes() == first
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == sorted(
        [drawn.name, recipe.name, survey.name]
    )  # nothing half-written


def test_the_command_of_a_mapped_survey_and_of_a_batch_works_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    unit = cap(8, 60, 12.0)
    rows = np.column_stack([np.arange(60.0), FIELD * unit + 20 * np.random.default_rng(1).standard_normal(unit.shape)])
    np.savetxt("flight.csv", rows, delimiter=",", header="t,bx,by,bz", comments="")
    section = {
        "file": "flight.csv",
        "time": {"from": "t"},
        "sensors": {"A": {"from": ["bx", "by", "bz"], "units": "nT"}},
    }
    stages = [{"load": {}}, {"calibrate_joint": {"total_field_nT": FIELD}}]
    Path("flight.yaml").write_text(yaml.safe_dump(JOINT | {"survey": section, "stages": stages}), encoding="utf-8")
    for start, words in (("run", ["--output", "out"]), ("batch", ["flight.csv", "--output", "all", "--workers", "1"])):
        status = status_of([start, "flight.yaml", *words])
        said = capsys.readouterr()
        text = said.err if start == "run" else json.loads(Path("all/batch.json").read_text())["surveys"][0]["message"]
        assert status == (3 if start == "run" else 4), said
        (line,) = [part for part in text.splitlines() if "a picture of what is missing: " in part]
        assert status_of(shlex.split(line.split("missing: ", 1)[1])[1:]) == 0
        drawn = Path("flight.attitudes.svg")
        assert drawn.stat().st_size > 10_000
        drawn.unlink()
        capsys.readouterr()


def test_what_cannot_be_drawn_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    survey = written(tmp_path / "survey.h5", cap(9, 60, 12.0), 1)
    before = survey.read_bytes()

    def told(status: int, *words: str) -> str:
        assert status_of(["inspect", *words]) == status
        return capsys.readouterr().err

    target = str(tmp_path / "seen.svg")
    assert ".svg, .png, .pdf" in told(2, str(survey), "--attitudes", str(tmp_path / "seen.html"))
    assert "is no recipe" in told(2, str(survey), "--input", str(survey), "--attitudes", target)
    assert "--attitudes" in told(2, str(survey), "--input", str(survey))
    linked = tmp_path / "link.svg"
    linked.symlink_to(survey)
    assert "would replace" in told(2, str(survey), "--attitudes", str(linked))
    assert "no such file" in told(3, str(tmp_path / "none.h5"), "--attitudes", target)
    assert survey.read_bytes() == before
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "pip install 'magtensor[report]'" in told(2, str(survey), "--attitudes", target)
    assert not Path(target).exists()


def test_of_very_many_sensors_those_are_drawn_that_lack_most(tmp_path: Path) -> None:
    unit = np.vstack([cap(13, 20, 12.0), cap(14, 60, 180.0)])
    survey = written(tmp_path / "many.h5", unit, 30, noise=20.0)
    with h5py.File(survey, "r+") as file:
        file["b_raw"][20:, 17] = np.nan  # this one saw a narrow cone alone
    recipe = {**JOINT, "stages": [{"load": {"max_flagged_share": 0.9}}, *JOINT["stages"][1:]]}
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(recipe), encoding="utf-8")
    lines = seen_attitudes.draw_attitudes(tmp_path / "recipe.yaml", tmp_path / "many.svg", survey=survey)
    assert len(lines) == 30 and [line.split(":")[0] for line in lines if "NOT determined" in line] == ["M18"]
    drawn = (tmp_path / "many.svg").read_text(encoding="utf-8")
    assert "<!-- M18 -->" in drawn and drawn.count("  z &gt; 0 -->") == 12
    assert "Of 30 sensors the 12 that know their worst direction least are shown." in drawn


def test_sensors_of_one_array_share_their_postures_and_keep_their_verdicts() -> None:
    rng = np.random.default_rng(11)
    unit = [cap(10, 100, 30.0), np.vstack([cap(10, 100, 30.0), rng.standard_normal((100, 3))])]
    unit[1] /= np.linalg.norm(unit[1], axis=1, keepdims=True)
    alone: list[Coverage] = [seen(u, noise=30.0).found for u in unit]
    assert not len(alone[1].further.directions)  # spread well
    together = same_postures(alone, unit, np.tile(np.eye(3), (2, 1, 1)))
    assert np.array_equal(together[0].further.directions, together[1].further.directions)
    assert np.allclose(together[0].further.directions[:4], alone[0].further.directions[:4])  # the one that lacks them
    assert [t.faults for t in together] == [a.faults for a in alone]


def test_a_sensor_without_samples_in_use_is_named(tmp_path: Path) -> None:
    survey = written(tmp_path / "survey.h5", cap(12, 60, 12.0), 2)
    with h5py.File(survey, "r+") as file:
        file["b_raw"][:-2, 1] = np.nan
    recipe = {
        "title": "t",
        "stages": [{"load": {"max_flagged_share": 0.99}}, {"detrend_diurnal": {}}, "calibrate_joint"],
    }
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(recipe), encoding="utf-8")
    with pytest.raises(NotEnoughData, match=r"survey\.h5: M2: 2 samples are in use"):
        seen_attitudes.draw_attitudes(tmp_path / "recipe.yaml", tmp_path / "seen.png", survey=survey)
    assert not (tmp_path / "seen.png").exists()
