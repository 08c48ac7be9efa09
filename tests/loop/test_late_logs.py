"""A log whose clock is late or early, or whose thermometer is slow: the logged value is wrong wherever it changes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import RECIPE, lasting_effects, scenario, survey_file, suspects, synthetic, verdict_of

from magtensor.applying import apply_and_refine
from magtensor.error_models.first_order import ahead, undone
from magtensor.error_models.settings import Range
from magtensor.loop.remainder.flagged import LONGEST_SPIKE
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import read_plan
from magtensor.runner import run

LATE = 3  # samples of half a second


def make_late(path: Path) -> None:
    """Write every value of the current so many samples later."""
    with h5py.File(path, "a") as file:
        logged = file["channels/current_heater"] if "channels" in file else file["current_heater"]
        values = logged[:]
        logged[:] = np.concatenate([np.repeat(values[:1], LATE), values[:-LATE]])


@pytest.mark.long
@pytest.mark.parametrize("rms_nT", [0.5, 5.0])
def test_it_is_found_with_its_delay(rms_nT: float, tmp_path: Path) -> None:
    effect = {"type": "current_field", "channel": "current_heater", "rms_nT": rms_nT}
    models = ["current_field", "channel_response", "offset_drift"]
    told = verdict_of(tmp_path, scenario(31, effect), make_late, models)
    assert [a["error_model"] for a in told["adopted"]] == ["current_field"], suspects(told)
    assert told["adopted"][0]["settings"]["lag_s"] == pytest.approx(-0.5 * LATE, abs=0.15)
    assert told["adopted"][0]["evidence"]["held_out_rms_after_nT"] < 1.1 * told["noise_floor_nT"]


def make_early(channel: str, samples: int) -> Callable[[Path], None]:
    """Write every value so many samples sooner: what it does comes later, as a whole."""

    def change(path: Path) -> None:
        with h5py.File(path, "a") as file:
            logged = file[f"channels/{channel}"] if "channels" in file else file[channel]
            values = logged[:]
            logged[:] = np.concatenate([values[samples:], np.repeat(values[-1:], samples)])

    return change


BEHIND_S = 60.0  # the thermometer's own time constant, or how late its log is
FINE = 100  # steps of the thermometer's equation to a sample


def make_slow(path: Path) -> None:
    """The log of a thermometer that follows what it measures with a time constant, stepped through in time."""
    with h5py.File(path, "a") as file:
        logged = file["channels/temperature"] if "channels" in file else file["temperature"]
        time, felt = file["time"][:], logged[:]
        felt = np.convolve(np.pad(felt, 10, mode="edge"), np.ones(21) / 21, mode="valid")  # the log's own noise
        shown = np.empty_like(felt)
        shown[0] = now = felt[0]
        for i in range(1, len(felt)):
            for k in range(FINE):
                outside = felt[i - 1] + (felt[i] - felt[i - 1]) * (k + 0.5) / FINE
                now += (outside - now) * (time[i] - time[i - 1]) / FINE / BEHIND_S
            shown[i] = now
        logged[:] = shown + 0.01 * np.random.default_rng(5).standard_normal(len(felt))


def make_temperature_late(path: Path) -> None:
    """The log of a thermometer whose clock is late; the survey begins when that has its first reading."""
    with h5py.File(path, "a") as file:
        name = "channels/temperature" if "channels" in file else "temperature"
        time = file["time"][:]
        file[name][:] = np.interp(time - BEHIND_S, time, file[name][:])
        begun = time >= time[0] + BEHIND_S
        found: list[str] = []
        file.visititems(lambda each, data: found.append(each) if isinstance(data, h5py.Dataset) else None)
        for each in [each for each in found if file[each].shape[:1] == time.shape]:
            kept, attributes = file[each][begun], dict(file[each].attrs)
            del file[each]
            file.create_dataset(each, data=kept).attrs.update(attributes)


@pytest.mark.long
@pytest.mark.parametrize(("change", "delayed"), [(make_slow, False), (make_temperature_late, True)])
def test_a_thermometer_may_be_behind_the_sensor(change: Callable[[Path], None], delayed: bool, tmp_path: Path) -> None:
    effect = {"type": "temperature_offset", "channel": "temperature", "rms_nT": 3.0}
    found = verdict_of(tmp_path, scenario(35, effect), change, lasting_effects())
    assert [a["error_model"] for a in found["adopted"]] == ["temperature_offset"], suspects(found)
    settings, evidence = found["adopted"][0]["settings"], found["adopted"][0]["evidence"]
    assert settings["delayed"] is delayed
    assert settings["lag_s"] == pytest.approx(-BEHIND_S, rel=0.1)
    assert evidence["held_out_rms_after_nT"] < 1.1 * found["noise_floor_nT"]
    words = f"temperature_offset acts {-settings['lag_s']:.4g} s before what it follows was logged, as where that log"
    assert (words in found["unexplained"]["description"]) is delayed


@pytest.mark.long
def test_of_the_end_a_late_log_tells_nothing(tmp_path: Path) -> None:
    """What went on there is no part of the calibration, and is flagged; so it is on another survey."""
    effect = {"type": "temperature_offset", "channel": "temperature", "rms_nT": 3.0}
    first = survey_file(tmp_path, scenario(38, effect))
    make_temperature_late(first)
    plan = read_plan(RECIPE, survey=first, overrides=["stages.close_loop.search=[temperature_offset, offset_step]"])
    made = run(plan, empty_survey(plan)).survey
    end = made.time > made.time[-1] - 0.9 * BEHIND_S
    assert not made.good[end].any() and made.good[~end].mean() > 0.98
    assert any("late" in flag.reason for flag in made.flags)
    second = survey_file(tmp_path, scenario(37), "second.h5")
    calibrated, _ = apply_and_refine(made, second, plan, tolerant=True, refine_rotation=False)
    end = calibrated.time > calibrated.time[-1] - 0.9 * BEHIND_S
    assert not calibrated.good[end].any() and calibrated.good[: len(end) // 2].all()


def test_a_lag_is_undone() -> None:
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(0.4, 0.6, 4000))
    course = np.sin(time / 150.0) + 0.3 * np.cos(time / 60.0)
    # of y with tau y' + y = x, in closed form for a sinusoid, after the start has died away
    shown = np.zeros_like(course)
    for size, phase, period in ((1.0, 0.0, 150.0), (0.3, np.pi / 2, 60.0)):
        turn = BEHIND_S / period
        shown += size / np.hypot(1.0, turn) * np.sin(time / period + phase - np.arctan(turn))
    assert np.abs(undone(time, shown, BEHIND_S) - course)[1:-1].max() < 1e-4
    early = ahead(time, np.sin(time / 150.0), 20.0)
    inside = time < time[-1] - 20.0
    assert np.abs(early - np.sin((time + 20.0) / 150.0))[inside].max() < 1e-5
    slope = np.diff(early[~inside]) / np.diff(time[~inside])
    assert np.ptp(slope) < 1e-9


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "channel", "samples"), [("current_field", "current_heater", 6), ("channel_response", "wind", 40)]
)
def test_a_delay_is_told_from_a_time_constant(name: str, channel: str, samples: int, tmp_path: Path) -> None:
    survey = scenario(33, {"type": name, "channel": channel, "rms_nT": 3.0})
    wind = {"type": "smooth", "mean": 5.0, "rms": 1.0, "time_s": 40.0, "units": "m/s", "log_noise": 0.002}
    survey["channels"] = survey["channels"] | {"wind": wind}
    searched = ["current_field", "channel_response", "latent_source", "offset_step"]
    told = verdict_of(tmp_path, survey, make_early(channel, samples), searched)
    assert [a["error_model"] for a in told["adopted"]] == [name], suspects(told)
    settings = told["adopted"][0]["settings"]
    assert settings["delayed"]
    assert settings["lag_s"] == pytest.approx(0.5 * samples, rel=0.02)
    # before the log begins nothing is known of what it does then
    words = f"{name} acts {settings['lag_s']:.4g} s after what it follows was logged: the first"
    assert (words in told["unexplained"]["description"]) is (samples > LONGEST_SPIKE)
    assert told["adopted"][0]["evidence"]["held_out_rms_after_nT"] < 1.1 * told["noise_floor_nT"]


@pytest.mark.long
def test_a_time_constant_is_told_from_a_delay(tmp_path: Path) -> None:
    effect = {"type": "current_field", "channel": "current_heater", "rms_nT": 3.0, "lag_s": 3.0}
    told = verdict_of(tmp_path, scenario(34, effect), models=["current_field", "channel_response"])
    (adopted,) = told["adopted"]
    assert not adopted["settings"]["delayed"]
    assert adopted["settings"]["lag_s"] == pytest.approx(3.0, abs=0.1)


@pytest.mark.long
def test_a_log_in_time_is_not_said_to_be_late(tmp_path: Path) -> None:
    effect = {"type": "current_field", "channel": "current_heater", "rms_nT": 0.5}
    told = verdict_of(tmp_path, scenario(32, effect), models=["current_field", "offset_drift"])
    assert told["adopted"][0]["settings"]["lag_s"] == 0.0


def test_a_range_on_both_sides_of_zero() -> None:
    record = synthetic(1)  # of twenty minutes
    x = record.excitation(record.raw, record.raw)
    grid = Range(-2.0, 10.0, count=6, spacing="log").values(x)
    assert grid == sorted(grid) and 0.0 in grid and -2.0 <= grid[0] < grid[1] < 0
    assert grid[grid.index(0.0) :] == Range(0.0, 10.0, count=6, spacing="log").values(x)
    late = Range(-3600.0, 3600.0, count=9, spacing="log").values(x)
    assert -0.2 * x.duration <= min(late) < 0  # of more the log would tell too little
