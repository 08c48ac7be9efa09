"""A calibration on another survey: what it cannot take off, and samples that nothing explains, there and in the fit."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import RECIPE, scenario, survey_file
from numpy.typing import NDArray

import magtensor
from magtensor.cli import status_of
from magtensor.closed_loop import ClosedLoop
from magtensor.loop.correcting.beyond import extrapolated
from magtensor.loop.correcting.stored import effect_variables
from magtensor.loop.fitting.model import Adopted
from magtensor.preparing import load_as
from magtensor.recipe.plan import read_plan
from magtensor.registry import Registry
from magtensor.standing_out import REASON, standing_out

TURNED = [100, 180, 260, 420, 500, 580]  # samples
MOTION = scenario()["motion"] | {"duration_s": 600.0}
VECTORS = [[0.9, -0.4, 0.6], [-0.5, 0.8, 0.1], [0.2, 0.5, -0.9], [0.7, -0.6, 0.3]]
HEATER = {"type": "current_field", "nT_per_A": [[8.0 * v for v in w] for w in VECTORS], "channel": "current_heater"}
SLOW = {"type": "latent_source", "nT_per_unit": VECTORS, "waveform_of": {"type": "smooth", "rms": 2.0, "time_s": 60.0}}
Change = Callable[[h5py.File], None]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("surveys")
    for name, seed, effects in (("clean", 5, ()), ("other", 6, ()), ("heated", 5, (HEATER,)), ("hot", 6, (HEATER,))):
        survey_file(place, scenario(seed, *effects, motion=MOTION), f"{name}.h5")
    return place


@pytest.fixture(scope="module")
def plain(folder: Path) -> ClosedLoop:
    return magtensor.close_loop(folder / "clean.h5", search=[])


@pytest.fixture(scope="module")
def heated(folder: Path) -> ClosedLoop:
    return magtensor.close_loop(folder / "heated.h5", search=["current_field"])


def changed(folder: Path, name: str, change: Change) -> Path:
    path = folder / f"changed_{name}"
    shutil.copy(folder / name, path)
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def spikes(samples: list[int]) -> Change:
    def change(file: h5py.File) -> None:
        raw = file["b_raw"][()]
        for k, i in enumerate(samples):
            raw[i, k % 4, k % 3] += 40.0
        file["b_raw"][...] = raw

    return change


def test_an_effect_that_a_survey_does_not_have_is_told(
    tmp_path: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A cable laid elsewhere since: the heater's current is logged, and makes no field any more."""
    found = magtensor.close_loop(folder / "heated.h5", search=["current_field"], verify=folder / "other.h5")
    assert "the verification survey worse, current_field above all: it does not carry over" in found.sentence
    found.calibration.save(tmp_path / "c.nc")
    for name, told in (("hot.h5", False), ("other.h5", True)):
        assert status_of(["apply", str(tmp_path / "c.nc"), str(folder / name), "--output", str(tmp_path / name)]) == 0
        said = capsys.readouterr().out
        words = "taken off, though |b| would be nearer to this survey's total field without: current_field\n"
        assert (words in said) is told


@pytest.mark.parametrize("times", [1.0, 1.5])
def test_a_missing_channel_is_told_with_survey_and_effect(
    tmp_path: Path, folder: Path, heated: ClosedLoop, capsys: pytest.CaptureFixture[str], times: float
) -> None:
    """In a stronger field than the calibration has seen as well."""

    def without(file: h5py.File) -> None:
        del file["current_heater"]
        file["b_raw"][...] = times * file["b_raw"][()]
        file["reference/total_field"][...] = times * file["reference/total_field"][()]

    heated.calibration.save(tmp_path / "c.nc")
    bare = changed(folder, "hot.h5", without)
    assert status_of(["apply", str(tmp_path / "c.nc"), str(bare), "--output", str(tmp_path / "a.nc")]) == 3
    said = capsys.readouterr().err
    assert re.search(
        r"changed_hot\.h5: the effect current_field of the calibration cannot be taken off: this survey has no channel "
        r"current_heater\n  it logs temperature; ",
        said,
    )
    assert not (tmp_path / "a.nc").exists()


SPIKED = [40, 41, 200, 203, 205, 700, 1100]  # a pair, three near each other, three alone


def length_error(said: str) -> float:
    """nT rms of |b| - F, as it is told."""
    found = re.search(r"\|b\| - F: ([\d.]+) nT rms on this survey", said)
    assert found is not None
    return float(found[1])


@pytest.mark.parametrize(
    ("times", "told", "share"), [(1.0, "", 0.0), (1.8, "extrapolated", 0.8), (3.0, "not_on_this_survey", 1.0)]
)
def test_an_effect_beyond_what_the_calibration_has_seen_is_told(
    tmp_path: Path,
    folder: Path,
    plain: ClosedLoop,
    heated: ClosedLoop,
    capsys: pytest.CaptureFixture[str],
    times: float,
    told: str,
    share: float,
) -> None:
    """It is taken off as it is known to be; but where less than half of it shows in |b| - F it is left in.

    The heater of the survey is the same, and its log says so many times the current: `share` of what the heater does
    is left."""

    def stronger(file: h5py.File) -> None:
        file["current_heater"][...] = times * file["current_heater"][()]

    heated.calibration.save(tmp_path / "c.nc")
    survey = changed(folder, "hot.h5", stronger)
    assert status_of(["apply", str(tmp_path / "c.nc"), str(survey), "--output", str(tmp_path / "a.nc")]) == 0
    out = capsys.readouterr().out
    beyond = re.search(r"current_heater goes ([\d.]+) A beyond what the calibration has seen", out)
    assert (beyond is not None and float(beyond[1]) > 1.0) is bool(told)
    with h5py.File(tmp_path / "a.nc") as file:
        for name in ("extrapolated", "not_on_this_survey"):
            words = str(file["calibrated/b"].attrs.get(name, ""))
            assert words.startswith("current_field") if name == told else not words
    error, of_the_heater = length_error(out), length_error(plain.calibration.apply(folder / "hot.h5").attrs["fit"])
    assert error == pytest.approx(share * of_the_heater, rel=0.05) if told else error < 0.08 * of_the_heater


@pytest.mark.long
def test_a_verification_survey_in_other_units_does_not_gainsay_the_effect(folder: Path) -> None:
    def in_mA(file: h5py.File) -> None:
        file["current_heater"][...] = 1000.0 * file["current_heater"][()]

    other = changed(folder, "hot.h5", in_mA)
    found = magtensor.close_loop(folder / "heated.h5", search=["current_field"], verify=other).sentence
    assert found.startswith("The residual was traced to current_field: ") and "on held-out blocks" in found
    assert re.search(
        r"NOT taken off the verification survey, for the lengths of its vectors refute it: "
        r"current_field \(current_heater goes [\d.e+]+ A beyond what the calibration has seen\)",
        found,
    )


def test_a_channel_that_is_missing_for_a_while_is_told(
    tmp_path: Path, folder: Path, heated: ClosedLoop, capsys: pytest.CaptureFixture[str]
) -> None:
    """What every third row lacks is not missing; two minutes without a reading are told."""

    def sparse(file: h5py.File) -> None:
        values = file["current_heater"][()]
        values[::3] = np.nan
        file["current_heater"][...] = values

    def lost(file: h5py.File) -> None:
        values, time = file["current_heater"][()], file["time"][()]
        values[(time - time[0] > 100.0) & (time - time[0] < 220.0)] = np.nan
        file["current_heater"][...] = values

    heated.calibration.save(tmp_path / "c.nc")
    for change, said in ((sparse, ""), (lost, "current_field: current_heater is missing from 100 to 220 s")):
        path = changed(folder, "hot.h5", change)
        assert status_of(["apply", str(tmp_path / "c.nc"), str(path), "--output", str(tmp_path / "a.nc")]) == 0
        out = capsys.readouterr().out
        assert said in out and ("taken to go straight" in out) is bool(said)


def test_what_had_no_part_in_the_calibration_was_not_seen_by_it(folder: Path) -> None:
    path = folder / "heated.h5"
    survey = load_as(read_plan(RECIPE, survey=path), path)
    current = np.asarray(survey.values("current_heater"))
    model = Adopted(Registry.load().find("error_model", "current_field"), {"channel": "current_heater", "lag_s": 0.0})

    def seen(believed: NDArray[np.bool_] | None) -> list[float]:
        stored = effect_variables([model], [np.zeros(12)], {"current_heater": np.zeros(1)}, survey, believed)
        ranges: dict[str, list[float]] = json.loads(stored["calibration/effects"][2]["channel_ranges"])
        return ranges["current_heater"]

    assert seen(None) == [current.min(), current.max()]
    assert seen(current < 0.5) == [current.min(), current[current < 0.5].max()]


@pytest.mark.parametrize(("warmer", "told"), [(False, False), (True, True)])
def test_a_channel_is_judged_as_it_is_seen_through_the_lag(folder: Path, warmer: bool, told: bool) -> None:
    """Through a lag far longer than the survey a temperature stays near its first value: another first value within
    what the thermometer has shown is far outside what has acted."""
    path = folder / "clean.h5"
    survey = load_as(read_plan(RECIPE, survey=path), path)
    temperature = np.asarray(survey.values("temperature"))
    component = Registry.load().find("error_model", "temperature_offset")
    model = Adopted(component, {"channel": "temperature", "lag_s": 20_000.0, "order": 1, "at_start": 0.0})
    stored = effect_variables([model], [np.zeros(12)], {"temperature": np.zeros(1)}, survey)
    calibration: Any = {"calibration/effects": SimpleNamespace(attrs=stored["calibration/effects"][2])}
    first = temperature[0] + (0.9 * (temperature.max() - temperature[0]) if warmer else 0.0)
    other = survey.merged({"temperature": (("time",), np.full_like(temperature, first), {"units": "degC"})})
    said = extrapolated(other, calibration, [model], {"temperature": np.zeros(1)})
    assert ("temperature, through a lag of 2e+04 s, goes" in said.get(model.name, "")) is told and bool(said) is told


@pytest.mark.parametrize(("times", "told"), [(1.2, False), (1.9, True)])
def test_a_curve_of_the_sensor_in_a_stronger_field_is_told(folder: Path, times: float, told: bool) -> None:
    """What grows in proportion with the field, or not at all, holds in any."""
    path = folder / "clean.h5"
    survey = load_as(read_plan(RECIPE, survey=path), path)
    bent = ["nonlinearity_quadratic", "nonlinearity_cubic", "cross_field", "hysteresis"]
    straight = ["offset_drift", "scale_drift", "eddy_current", "temperature_scale", "sampling_lag", "turn_step"]
    registry = Registry.load()
    models = [Adopted(registry.find("error_model", name), {}) for name in (*straight, *bent)]
    stored = effect_variables(models, [np.zeros(0)] * len(models), {"temperature": np.zeros(1)}, survey)
    calibration: Any = {"calibration/effects": SimpleNamespace(attrs=stored["calibration/effects"][2])}
    raw = survey["b_raw"]
    other = survey.merged({"b_raw": (("time", "sensor", "axis"), times * raw.values, dict(raw.attrs))})
    said = extrapolated(other, calibration, models, {"temperature": np.zeros(1)})
    assert list(said) == (bent if told else [])
    assert all(f"{times:.3g} times as large" in what for what in said.values())


def test_spikes_of_another_survey_are_flagged(tmp_path: Path, folder: Path, plain: ClosedLoop) -> None:
    calibrated = plain.calibration.apply(changed(folder, "other.h5", spikes(SPIKED)))
    assert np.flatnonzero(~calibrated["calibrated/good"].values).tolist() == SPIKED
    flags = json.loads(calibrated["qc"].attrs["flag_record"])
    assert sum(f["samples"] for f in flags) == len(SPIKED)
    assert {(f["by"], f["reason"]) for f in flags} == {("apply", REASON)}
    clean = plain.calibration.apply(folder / "other.h5")
    assert clean["calibrated/good"].all()
    keep = calibrated["calibrated/good"]
    np.testing.assert_array_equal(calibrated["calibrated/b"][keep.values], clean["calibrated/b"][keep.values])


def test_an_effect_in_a_quick_turn_is_taken_off_there_and_a_spike_is_flagged(tmp_path: Path) -> None:
    """A sample of another attitude than those beside it stands out by its effect, and has nothing wrong with it."""
    law = {
        "type": "nonlinearity_cubic",
        "nT_at_full_scale": [[60.0, -40.0, 20.0], [-30.0, 50.0, -60.0], [0.0] * 3, [0.0] * 3],
    }
    survey = survey_file(tmp_path, scenario(5, law, motion=MOTION))
    loop = magtensor.close_loop(survey, search=["nonlinearity_cubic"])
    assert [a["error_model"] for a in loop.verdict["adopted"]] == ["nonlinearity_cubic"]
    another = survey_file(tmp_path, scenario(6, law, motion=MOTION), "another.h5")
    with h5py.File(another, "r+") as file:
        raw = file["b_raw"][()]
        raw[TURNED], raw[[t + 300 for t in TURNED]] = raw[[t + 300 for t in TURNED]], raw[TURNED].copy()
        raw[350, 3, 1] += 40.0
        file["b_raw"][...] = raw
    calibrated = loop.calibration.apply(another)
    assert np.flatnonzero(~calibrated["calibrated/good"].values).tolist() == [350]
    b = calibrated["calibrated/b"].values
    apart = np.linalg.norm(b - b.mean(axis=1, keepdims=True), axis=(1, 2))
    apart[350] = np.nan
    assert np.nanmax(apart[TURNED]) < 1.5 * np.nanquantile(apart, 0.99)


def test_a_survey_of_two_sensors_whose_places_are_known(tmp_path: Path) -> None:
    """Field and gradient together can make any outputs of two sensors: nothing stands out but what has no foot."""
    pair = scenario(5, motion=MOTION)
    pair["instrument"] = pair["instrument"] | {"array": {"positions_m": [[0.25, 0.0, 0.0], [-0.25, 0.0, 0.0]]}}
    calibration = magtensor.close_loop(survey_file(tmp_path, pair, "pair.h5"), search=[]).calibration
    another = survey_file(tmp_path, pair | {"seed": 6}, "another.h5")
    assert calibration.apply(another)["calibrated/good"].all()
    with h5py.File(another, "a") as file:
        file["b_raw"][100, 0] += [3000.0, 1000.0, -2000.0]
    good = calibration.apply(another)["calibrated/good"].values
    assert np.flatnonzero(good == 0).tolist() == [100]


@pytest.mark.long
def test_spikes_do_not_spoil_the_verification(folder: Path) -> None:
    blocks = [
        magtensor.close_loop(folder / "heated.h5", search=["current_field"], verify=path).verdict["error"]["verify"]
        for path in (folder / "hot.h5", changed(folder, "hot.h5", spikes(SPIKED)))
    ]
    for block in ("before", "after"):
        clean, spiked = (b[block] for b in blocks)
        assert spiked["samples"] == clean["samples"] - len(SPIKED)
        for figure in ("total_field_rms_nT", "tensor_rms_nT_per_m"):
            assert spiked[figure]["all"] == pytest.approx(clean[figure]["all"], rel=0.02)


def test_a_command_says_what_it_flagged(
    tmp_path: Path, folder: Path, plain: ClosedLoop, capsys: pytest.CaptureFixture[str]
) -> None:
    plain.calibration.save(tmp_path / "c.nc")
    survey = changed(folder, "other.h5", spikes(SPIKED))
    assert status_of(["apply", str(tmp_path / "c.nc"), str(survey), "--output", str(tmp_path / "a.nc")]) == 0
    assert f"apply: 7 samples: {REASON}" in capsys.readouterr().out


def test_near_a_source_nothing_is_flagged(folder: Path, plain: ClosedLoop) -> None:
    """A dipole a few baselines away shows off field and gradient for seconds, and not for a sample."""
    source = {"position_m": [1.5, 0.0, 0.5], "moment_Am2": [0.0, 30.0, 0.0]}
    field = scenario()["field"] | {"dipoles": [source]}
    near = survey_file(folder, scenario(6, motion=MOTION, field=field), "near.h5")
    calibrated = plain.calibration.apply(near)
    assert float(abs(calibrated["calibrated/tensor"]).max()) > 1000.0
    assert calibrated["calibrated/good"].all()


@pytest.mark.parametrize("samples", [60, 600, 6000])
def test_clean_noise_rarely_stands_out(samples: int) -> None:
    """One survey in a hundred: of 300, more than nine would be chance of one in a thousand."""
    rng = np.random.default_rng(samples)
    tries = 300 if samples < 6000 else 100

    def alone(parts: list[NDArray[np.float64]]) -> bool:
        return bool(standing_out(parts).any())

    count = sum(alone([rng.standard_normal((samples, k)) for k in (4, 1)]) for _ in range(tries))
    assert count <= 9


def test_what_lasts_is_left_to_speak_for_itself() -> None:
    rng = np.random.default_rng(1)
    values = rng.standard_normal((600, 4))
    values[100] += 30.0
    values[200:202] += 30.0
    values[300:310] += 30.0
    values[400:] += 30.0
    assert np.flatnonzero(standing_out([values])).tolist() == [100, 200, 201]


@pytest.mark.parametrize("at", [0, 1, 2, 5, 597, 599])
def test_near_an_end_a_spike_stands_out_however_large(at: int) -> None:
    """Beside an end one sample serves as both its neighbours."""
    values = np.random.default_rng(1).standard_normal((600, 1))
    values[at] += 1e6
    assert np.flatnonzero(standing_out([values])).tolist() == [at]


def crossing(baselines: float, a_sample: float) -> NDArray[np.float64]:
    """(600,) relative gradient of a dipole that is passed at sample 300, so many baselines away: it falls with r^-4."""
    along = a_sample * (np.arange(600.0) - 300.0)
    return np.asarray((1.0 + (along / baselines) ** 2) ** -2)


@pytest.mark.parametrize(("of_gradient", "out"), [(crossing(3.0, 1e3), True), (crossing(3.0, 6.0), False)])
def test_along_a_gradient_only_what_has_no_foot_stands_out(of_gradient: NDArray[np.float64], out: bool) -> None:
    """A disturbance of one sensor of three in a plane may look like a gradient; a source leaves more beside it."""
    rng = np.random.default_rng(1)
    gradient = rng.standard_normal((600, 3)) + 1000.0 * of_gradient[:, None] * np.array([0.3, -0.8, 0.5])
    quiet = rng.standard_normal((600, 1))
    assert np.flatnonzero(standing_out([quiet], gradient)).tolist() == ([300] if out else [])
    assert not standing_out([quiet], rng.standard_normal((600, 3))).any()


@pytest.mark.long
def test_a_source_that_cannot_be_taken_off_is_told(
    tmp_path: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    longer = scenario()["motion"] | {"duration_s": 1200.0}
    survey, other = (survey_file(folder, scenario(s, SLOW, motion=longer), f"slow{s}.h5") for s in (8, 9))
    bare = changed(folder, other.name, lambda f: f.pop("position"))
    found = magtensor.close_loop(survey, search=["latent_source"], verify=bare)
    assert [a["error_model"] for a in found.verdict["adopted"]] == ["latent_source"]
    words = "latent_source: the sensors' positions are not known"
    assert found.verdict["error"]["verify"]["not_taken_off"] == words
    finished = found.save(tmp_path / "out")
    assert f"NOT taken off the verification survey: {words}" in finished.notes
    calibration = str(tmp_path / "out" / "calibration.nc")
    assert status_of(["apply", calibration, str(bare), "--output", str(tmp_path / "a.nc")]) == 0
    assert f"NOT taken off: {words}" in capsys.readouterr().out
    with h5py.File(tmp_path / "a.nc") as file:
        assert file["calibrated/b"].attrs["not_taken_off"] == words
    assert status_of(["apply", calibration, str(other), "--output", str(tmp_path / "a.nc")]) == 0
    assert "NOT taken off" not in capsys.readouterr().out


def saturated(span: slice, limit_nT: float) -> Change:
    """An axis at the end of its range, noise on it, so that no number repeats itself."""

    def change(file: h5py.File) -> None:
        raw = file["b_raw"][()]
        rng = np.random.default_rng(1)
        own = raw[span, 1, 0]
        raw[span, 1, 0] = np.minimum(own, limit_nT + 0.15 * rng.standard_normal(len(own)))
        file["b_raw"][...] = raw

    return change


@pytest.mark.long
def test_a_saturated_stretch_is_told_as_what_it_is(folder: Path) -> None:
    path = changed(folder, "clean.h5", saturated(slice(500, 580), 15_000.0))
    with h5py.File(path) as file, h5py.File(folder / "clean.h5") as clean:
        away = np.abs(file["b_raw"][:, 1, 0] - clean["b_raw"][:, 1, 0])
    first, last = np.flatnonzero(away > 1000.0)[[0, -1]] / 2.0
    found = magtensor.close_loop(path)
    left: dict[str, Any] = found.verdict["unexplained"]
    assert found.verdict["adopted"] == []
    assert left["present"]
    told = re.search(
        r"(\d+) samples in \d+ stretch\w* \(([\d.]+) to ([\d.]+) s.*mostly on S2: they are flagged", left["description"]
    )
    assert told is not None
    assert abs(float(told[2]) - first) <= 2.0 and abs(float(told[3]) - last) <= 2.0
    assert int(told[1]) <= (~found.computed.survey.good).sum()
    # what is left when they are out of use is noise, and nothing is said against it
    assert "of no use" not in left["description"] and "above the white noise" not in left["description"]
    assert found.verdict["error"]["held_out"]["after"]["total_field_rms_nT"]["all"] < 0.25
