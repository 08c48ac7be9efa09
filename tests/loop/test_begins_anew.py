"""What goes with time, on another survey: it goes on, as iron does, or begins anew, as electronics switched on do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import scenario, survey_file

import magtensor
from magtensor.closed_loop import ClosedLoop

MOTION = scenario()["motion"] | {"duration_s": 600.0}
DRIFT = {"type": "offset_drift", "rms_nT": 0.6}
FADING = {"type": "scale_drift", "rms_nT": 0.6}
STEP = {"type": "offset_step", "time_s": [250.0], "nT": [[0.0] * 3, [0.6, -0.5, 0.8], [0.0] * 3, [0.0] * 3]}
SLIP = {"type": "lag_step", "time_s": 250.0, "lag_s": [[0.0] * 3, [0.02] * 3, [0.0] * 3, [0.0] * 3]}
WARMING = {"type": "warm_up", "tau_s": 120.0, "nT": [[0.0] * 3, [2.0, -1.5, 1.0], [0.0] * 3, [0.0] * 3]}
RETUNED = {"type": "scale_step", "time_s": [250.0], "ppm": [[0.0] * 3, [20.0, -15.0, 25.0], [0.0] * 3, [0.0] * 3]}
MOVED = {"type": "reference_step", "time_s": [250.0], "steps_nT": [1.5]}
Found = Callable[[dict[str, Any]], tuple[ClosedLoop, Path]]
STEPS = ["offset_step", "scale_step", "turn_step"]
LATER = "2026-06-12T09:00:00Z"


def of_a_day(seed: int, *effects: dict[str, Any], start: str | None = None) -> dict[str, Any]:
    made = scenario(seed, *effects, motion=MOTION)
    return made | ({} if start is None else {"start": start})


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Found:
    """The first day's survey with an effect, the loop closed; each once."""
    folder, known = tmp_path_factory.mktemp("first"), dict[str, tuple[ClosedLoop, Path]]()

    def of(effect: dict[str, Any]) -> tuple[ClosedLoop, Path]:
        name = str(effect["type"])
        if name not in known:
            path = survey_file(folder, of_a_day(5, effect), f"{name}.h5")
            known[name] = magtensor.close_loop(path, search=[name]), path
        assert [a["error_model"] for a in known[name][0].verdict["adopted"]] == [name]
        return known[name]

    return of


@pytest.mark.parametrize("effect", [DRIFT, FADING, STEP], ids=lambda e: str(e["type"]))
def test_another_day_begins_anew(tmp_path: Path, found: Found, effect: dict[str, Any]) -> None:
    done, _ = found(effect)
    same, later = (survey_file(tmp_path, of_a_day(6, effect, start=s), f"{s is None}.h5") for s in (None, LATER))
    there = done.calibration.apply(later)
    assert there["calibrated/b"].attrs["begins_anew"] == effect["type"]
    there_again = done.calibration.apply(same)  # on the clock of the first survey the two are the same
    np.testing.assert_allclose(there["calibrated/b"], there_again["calibrated/b"], atol=1e-3)


def half(path: Path, second: bool) -> Path:
    """One half of a survey's samples, on the clock of the whole."""
    out = path.with_name(f"{'second' if second else 'first'}_{path.name}")
    with h5py.File(path) as whole, h5py.File(out, "w") as part:
        n = len(whole["time"])
        for name, data in whole.items():
            if isinstance(data, h5py.Dataset):
                values = data[()]
                part[name] = values if len(values) != n else values[n // 2 :] if second else values[: n // 2]
                if "units" in data.attrs:
                    part[name].attrs["units"] = data.attrs["units"]
        for name, data in whole["reference"].items():
            part[f"reference/{name}"] = data[()]
            part[f"reference/{name}"].attrs["units"] = data.attrs["units"]
    return out


def test_a_drift_that_goes_on_does_not_begin_anew(tmp_path: Path) -> None:
    whole = survey_file(tmp_path, scenario(5, {"type": "offset_drift", "rms_nT": 1.2}), "whole.h5")
    done = magtensor.close_loop(half(whole, second=False), search=["offset_drift"])
    assert [a["error_model"] for a in done.verdict["adopted"]] == ["offset_drift"]
    told = done.calibration.apply(half(whole, second=True))["calibrated/b"].attrs
    assert "begins_anew" not in told
    assert told["held"] == "offset_drift (for 600 s)"
    assert "held" not in done.calibration.apply(half(whole, second=False))["calibrated/b"].attrs


@pytest.mark.parametrize("effect", [DRIFT, STEP], ids=lambda e: str(e["type"]))
@pytest.mark.parametrize("seed", [6, pytest.param(7, marks=pytest.mark.long)])
def test_what_stays_does_not_begin_anew(tmp_path: Path, found: Found, effect: dict[str, Any], seed: int) -> None:
    """On the other day the offsets are what they were at the end of the first, and a little besides."""
    done, first = found(effect)
    bare = survey_file(tmp_path, of_a_day(seed, start=LATER), "bare.h5")
    with h5py.File(first) as file:
        last = file[f"truth/effect_00_{effect['type']}"][-1]
    with h5py.File(bare, "r+") as file:
        file["b_raw"][...] += last + 0.3 * np.random.default_rng(seed).standard_normal(last.shape)
    assert "begins_anew" not in done.calibration.apply(bare)["calibrated/b"].attrs


@pytest.mark.parametrize("effect", [STEP, pytest.param(RETUNED, marks=pytest.mark.long)], ids=lambda e: str(e["type"]))
@pytest.mark.parametrize(("at", "when"), [([0.1], "happened before"), ([], "not yet"), ([250.0], "")])
def test_outputs_come_before_the_dates(
    tmp_path: Path, found: Found, effect: dict[str, Any], at: list[float], when: str
) -> None:
    """A second survey on the clock of the first: its jump was at that time, or the clock was set back to it."""
    done, _ = found(effect)
    there = survey_file(tmp_path, of_a_day(6, *([effect | {"time_s": at}] if at else [])), "there.h5")
    b = done.calibration.apply(there)["calibrated/b"]
    assert b.attrs.get("not_as_dated", "") == (f"{effect['type']} ({when})" if when else "")
    with h5py.File(there) as file:
        error = np.linalg.norm(b, axis=2) - file["truth/total_field_true"][()][:, None]
    assert np.sqrt(np.mean(error**2)) < 0.17  # the noise is 0.15 nT; the jump moves |b| by 0.6 nT


@pytest.mark.parametrize("more_nT", [0.0, 0.4], ids=["the sensor was never knocked", "its offset is a third one"])
def test_offsets_from_before_a_jump_are_known_by_just_that_difference(
    tmp_path: Path, found: Found, more_nT: float
) -> None:
    done, _ = found(STEP)
    there = survey_file(tmp_path, of_a_day(6, start=LATER), "there.h5")
    with h5py.File(there, "r+") as file:
        file["b_raw"][:, 1] += more_nT * np.array([1.0, 1.0, -1.0])
    b = done.calibration.apply(there)["calibrated/b"]
    assert b.attrs.get("not_as_dated", "") == ("" if more_nT else "offset_step (not yet)")
    if not more_nT:
        with h5py.File(there) as file:
            error = np.linalg.norm(b, axis=2) - file["truth/total_field_true"][()][:, None]
        assert np.sqrt(np.mean(error**2)) < 0.17


@pytest.mark.parametrize("again", [True, False])
def test_a_slip_goes_on_where_the_outputs_show_it(tmp_path: Path, found: Found, again: bool) -> None:
    """Recorders begin in step on another day, but not all of them."""
    done, _ = found(SLIP)
    there = survey_file(tmp_path, of_a_day(6, *([SLIP | {"time_s": 0.0}] if again else []), start=LATER), "there.h5")
    b = done.calibration.apply(there)["calibrated/b"]
    assert b.attrs.get("not_as_dated", "") == ("lag_step (happened before)" if again else "")
    assert "held" not in b.attrs
    apart = b[:, 1] - b[:, [0, 2, 3]].mean(axis=1)
    assert np.sqrt(np.mean(apart**2)) < 0.25  # of noise 0.17 nT; the slip makes some 150 nT


@pytest.mark.parametrize("switched_on_s", [pytest.param(-1e5, marks=pytest.mark.long), -110.0, 0.0])
def test_what_was_switched_on_before_is_warm(tmp_path: Path, found: Found, switched_on_s: float) -> None:
    done, _ = found(WARMING)
    before = WARMING | {"switched_on_s": switched_on_s}
    there = survey_file(tmp_path, of_a_day(6, before, start=LATER), "there.h5")
    b = done.calibration.apply(there)["calibrated/b"]
    with h5py.File(there) as file:
        error = np.linalg.norm(b[:, 1], axis=1) - file["truth/total_field_true"][()]
    assert np.sqrt(np.mean(error[:240] ** 2)) < 0.17  # of noise 0.15 nT; the warming up makes 1.0 nT of |b| there
    assert "not_as_dated" not in b.attrs and "begins_anew" not in b.attrs


@pytest.mark.long
def test_beside_a_source_that_nobody_logged(tmp_path: Path) -> None:
    """The source's waveform on the other day is found without the drift, which has to be known before."""
    vectors = [[2.7, -1.2, 1.8], [-1.5, 2.4, 0.3], [0.6, 1.5, -2.7], [2.1, -1.8, 0.9]]
    waveform = {"type": "switched", "levels": [-1.0, 1.0], "mean_hold_s": 40.0}
    source = {"type": "latent_source", "nT_per_unit": vectors, "waveform_of": waveform}
    first, later = (
        survey_file(tmp_path, of_a_day(seed, DRIFT, source, start=start), f"{seed}.h5")
        for seed, start in ((5, None), (6, LATER))
    )
    done = magtensor.close_loop(first, search=["offset_drift", "latent_source"])
    assert {a["error_model"] for a in done.verdict["adopted"]} == {"offset_drift", "latent_source"}
    there = done.calibration.apply(later)
    with h5py.File(later) as file:
        error = np.linalg.norm(there["calibrated/b"], axis=2) - file["truth/total_field_true"][()][:, None]
    assert np.sqrt(np.mean(error**2)) < 0.3  # twice the noise; the source moves |b| by 1.7 nT, the drift by 0.6


def of_two(path: Path) -> None:
    """The first two sensors of a survey alone."""
    with h5py.File(path, "r+") as file:
        for name in ("b_raw", "position", "sensor"):
            values, attributes = file[name][()], dict(file[name].attrs)
            del file[name]
            file[name] = values[:, :2] if name == "b_raw" else values[:2]
            file[name].attrs.update(attributes)


@pytest.mark.parametrize("later_s", [0.0, pytest.param(86_400.0, marks=pytest.mark.long)])
def test_what_is_still_warm_goes_on(tmp_path: Path, later_s: float) -> None:
    """Two sensors do not show how warm they are. Of a recording in two files the second begins as the first ended, and
    the next day's begins cold."""
    strong = WARMING | {"nT": [[0.0] * 3, [4.0, -3.0, 2.0], [0.0] * 3, [0.0] * 3], "tau_s": 250.0}
    whole = survey_file(tmp_path, scenario(5, strong), "whole.h5")
    first, second = (half(whole, second=part) for part in (False, True))
    with h5py.File(whole) as file, h5py.File(second, "r+") as part:
        n, added = len(file["time"]), file["truth/effect_00_warm_up"][()]
        field = file["truth/total_field_true"][n // 2 :]
        if later_s:
            part["b_raw"][...] += added[: n - n // 2] - added[n // 2 :]
        for name in ("time", "reference/time"):
            part[name][...] += later_s
    for path in (first, second):
        of_two(path)
    done = magtensor.close_loop(first, search=["warm_up"])
    assert [a["error_model"] for a in done.verdict["adopted"]] == ["warm_up"]
    b = done.calibration.apply(second)["calibrated/b"]
    error = np.linalg.norm(b[:, 1], axis=1) - field
    assert np.sqrt(np.mean(error[:240] ** 2)) < 0.18  # of noise 0.15 nT; taken wrongly it makes 1 nT


@pytest.mark.parametrize("anew", [True, False])
@pytest.mark.parametrize("effect", [FADING, MOVED], ids=lambda e: str(e["type"]))
def test_lengths_tell_what_sensors_do_not(tmp_path: Path, effect: dict[str, Any], anew: bool) -> None:
    """Two sensors, and a base station whose jump no sensor shows: lengths and total field say whether it is another."""
    two = {"instrument": scenario()["instrument"] | {"array": {"positions_m": [[0.0] * 3, [0.5, 0.0, 0.0]]}}}
    first = survey_file(tmp_path, of_a_day(5, effect) | two, "first.h5")
    later = survey_file(tmp_path, of_a_day(6, *[effect] * anew, start=LATER) | two, "later.h5")
    if not anew and effect is FADING:
        with h5py.File(first) as file, h5py.File(later, "r+") as there:
            there["b_raw"][...] += file[f"truth/effect_00_{FADING['type']}"][-1]
    done = magtensor.close_loop(first, search=[effect["type"]])
    assert [a["error_model"] for a in done.verdict["adopted"]] == [effect["type"]]
    b = done.calibration.apply(later)["calibrated/b"]
    assert b.attrs.get("begins_anew", "") == (effect["type"] if anew else "")
    if anew:
        with h5py.File(later) as file:
            error = np.linalg.norm(b, axis=2) - file["truth/total_field_true"][()][:, None]
        assert np.sqrt(np.mean(error**2)) < 0.17  # of noise 0.15 nT; the drift makes 0.6 nT


@pytest.mark.long
def test_what_happened_at_one_moment_is_dated_together(tmp_path: Path) -> None:
    """A tool, taken away after a third of the survey, that the second one has never seen, whatever the dates say; and
    the error before is that of who looks for no effect, and so has flagged that third."""
    first, second = (survey_file(tmp_path, scenario(seed, rate_Hz=1.0), f"{seed}.h5") for seed in (31, 32))
    tool = 1e-4 * np.array([[3.0, 1.0, -2.0], [1.0, -2.0, 1.0], [-2.0, 1.0, -1.0]])
    with h5py.File(first, "a") as file:
        raw = file["b_raw"][:]
        third = raw[: len(raw) // 3]
        share = np.array([1.0, 0.5, 0.3, 0.4])[:, None]
        third += share * (np.array([30.0, -50.0, 20.0]) + third @ tool)
        file["b_raw"][:] = raw
    told, alone = (
        magtensor.close_loop(first, search=names, verify=second).verdict["error"]["verify"] for names in (STEPS, [])
    )
    before, after, linear = (v["total_field_rms_nT"]["all"] for v in (told["before"], told["after"], alone["after"]))
    assert before == pytest.approx(linear, rel=0.02)
    assert after == pytest.approx(linear, rel=0.02)
