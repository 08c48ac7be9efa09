"""Where one sensor of several is silent for a while, what remembers the field sees it as the others do."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import RECIPE, Array, loaded, scenario, survey_file, synthetic

from magtensor.applying import apply_and_refine
from magtensor.calibration.types import ArrayCalibration
from magtensor.errors import NotEnoughData
from magtensor.loop.correcting.another_survey import Here
from magtensor.loop.correcting.filled import filled
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import read_plan
from magtensor.runner import run
from magtensor.survey.model import Survey
from magtensor.verdict import verdict

SILENT = slice(1000, 1200)  # samples, of the third sensor
OTHERS = [0, 1, 3]
NOISE_NT = 0.15  # of each output of the simulator's surveys

N = 900
PERIOD = 60  # samples in which the field turns once


def turning_field(sensors: int, samples: int = N) -> tuple[Array, Array]:
    """(samples, 3) nT, a field that turns, and (samples, S, 3) nT what a gradient that grows along a straight line adds
    at each sensor."""
    phase = 2.0 * np.pi * np.arange(samples) / PERIOD
    field = 5e4 * np.stack([np.cos(phase), np.sin(phase), 0.5 * np.cos(2.0 * phase)], axis=1)
    along = 1.0 + np.arange(samples)[:, None, None] / samples
    apart = np.random.default_rng(4).normal(0.0, 20.0, (sensors, 3))
    return field, along * apart


def test_what_is_there_stays() -> None:
    field, offset = turning_field(3)
    values = field[:, None] + offset
    assert filled(values) is values
    values[100:150, 1, 2] = np.nan
    known = np.isfinite(values)
    found = filled(values)
    assert np.isnan(values[100:150, 1, 2]).all()  # what was given is left as it was
    np.testing.assert_array_equal(found[known], values[known])


def test_a_silent_sensor_sees_what_the_others_see() -> None:
    """Differences that go straight are found exactly, whichever of the others is there."""
    field, offset = turning_field(4)
    whole = field[:, None] + offset
    values = whole.copy()
    values[200:400, 2] = np.nan
    values[250:300, 0] = np.nan  # so that the third is seen through the second and the fourth alone
    values[390:420, 3, 1] = np.nan  # one axis only, and across the end of the gap
    values[600:601, 1] = np.nan
    values[700:730, :3] = np.nan
    np.testing.assert_allclose(filled(values), whole, atol=1e-6)


def test_differences_hold_their_last_value_at_the_ends() -> None:
    field, offset = turning_field(3)
    whole = field[:, None] + offset
    values = whole.copy()
    values[:200, 1] = np.nan
    values[800:, 2] = np.nan
    found, moving = filled(values), 1.0 + np.arange(N) / N  # what the differences go with
    apart = offset / moving[:, None, None]
    for sensor, others, gap, edge in ((1, [0, 2], slice(0, 200), 200), (2, [0, 1], slice(800, N), 799)):
        own = apart[0, sensor] - apart[0, others].mean(axis=0)
        off = np.abs(moving[gap] - moving[edge])[:, None] * np.abs(own)
        np.testing.assert_allclose(np.abs(found[gap, sensor] - whole[gap, sensor]), off, atol=1e-6)


def test_a_sensor_that_never_spoke_has_the_mean_of_the_others() -> None:
    field, offset = turning_field(4)
    values = field[:, None] + offset
    values[:, 3] = np.nan
    values[500, 3, 0] = np.inf
    found = filled(values)
    np.testing.assert_allclose(found[:, 3], values[:, :3].mean(axis=1), atol=1e-6)


def test_straight_in_time_where_nobody_is_there() -> None:
    field, offset = turning_field(3)
    whole = field[:, None] + offset
    values = whole.copy()
    values[300:500, 0] = np.nan
    values[400:403] = np.nan
    found = filled(values)
    part = (np.arange(1, 4) / 4.0)[:, None, None]
    np.testing.assert_allclose(found[400:403], (1.0 - part) * whole[399] + part * whole[403], atol=1e-6)
    elsewhere = np.delete(np.arange(N), np.arange(400, 403))
    np.testing.assert_allclose(found[elsewhere], whole[elsewhere], atol=1e-6)


def test_a_single_sensor_goes_straight() -> None:
    whole = np.arange(50.0)[:, None, None] * np.array([1.0, -2.0, 3.0])
    values = whole.copy()
    values[10:20] = np.nan
    values[30, 0, 1] = np.nan
    values[45:, 0, 2] = np.nan
    whole[45:, 0, 2] = whole[44, 0, 2]
    np.testing.assert_allclose(filled(values), whole, atol=1e-9)
    np.testing.assert_array_equal(filled(np.full((5, 1, 3), np.nan)), 0.0)


def test_differences_are_not_those_of_a_disturbed_sample() -> None:
    """A connector that fails may spoil the last sample before it is silent."""
    field, offset = turning_field(4)
    whole = field[:, None] + offset
    values, good = whole.copy(), np.ones(N, dtype=bool)
    values[300:500, 2] = np.nan
    values[299, 2] += 5000.0
    good[299:500] = False
    np.testing.assert_allclose(filled(values, good)[300:500], whole[300:500], atol=1e-6)
    nowhere = np.zeros(N, dtype=bool)  # believed: then there is nothing but the samples as they are
    np.testing.assert_array_equal(filled(values, nowhere), filled(values))


def test_the_state_that_a_response_began_with_is_sought_in_such_a_field() -> None:
    record = synthetic(3, turning_s=20.0)
    unit = np.broadcast_to(np.eye(3), (4, 3, 3)).copy()
    calibration = ArrayCalibration(unit, np.zeros((4, 3)), np.full((48, 48), np.nan), "platform")
    raw = np.repeat(record.raw[:, :1], 4, axis=1) + 10.0 * np.arange(4.0)[:, None]
    gap = raw.copy()
    gap[400:600, 1] = np.nan
    record = replace(record, raw=gap, position=0.25 * np.random.default_rng(1).standard_normal((4, 3)))
    np.testing.assert_allclose(Here.of(record, calibration).excitation.field, raw, atol=1e-6)


def applied_with_and_without(tmp_path: Path, effect: dict[str, Any], silence: float) -> tuple[Survey, Survey]:
    """A calibration that knows an effect applied to another survey, as it is and with one sensor silent for a while."""
    surveys = [survey_file(tmp_path, scenario(seed, effect), f"{seed}.h5") for seed in (52, 53)]
    silent = tmp_path / "silent.h5"
    shutil.copy(surveys[1], silent)
    with h5py.File(silent, "a") as file:
        file["b_raw"][SILENT, 2] = silence
    plan = read_plan(RECIPE, survey=surveys[0], overrides=[f"stages.close_loop.search=[{effect['type']}]"])
    made = run(plan, empty_survey(plan)).survey
    assert [a["error_model"] for a in verdict(made)["adopted"]] == [effect["type"]]
    whole, lost = (
        apply_and_refine(made, path, plan, tolerant=True, refine_rotation=False)[0] for path in (surveys[1], silent)
    )
    assert not lost.good_by_sensor[SILENT, 2].any() and lost.good_by_sensor[SILENT][:, OTHERS].mean() > 0.99
    return whole, lost


@pytest.mark.parametrize(
    ("effect", "silence"),
    [
        ({"type": "averaging", "spread_s2": [0.15**2 / 12.0] * 4}, np.nan),
        pytest.param({"type": "eddy_current", "rms_nT": 20.0}, np.nan, marks=pytest.mark.long),
        pytest.param({"type": "eddy_current", "rms_nT": 20.0}, 0.0, marks=pytest.mark.long),
    ],
    ids=["averaging", "eddy current", "eddy current, zeros"],
)
def test_nothing_is_spoiled_beside_a_gap(tmp_path: Path, effect: dict[str, Any], silence: float) -> None:
    """What is taken off before and after a gap of one sensor is what is taken off where there is none."""
    whole, lost = applied_with_and_without(tmp_path, effect, silence)
    moved = np.abs(lost.values("calibrated/b") - whole.values("calibrated/b"))
    beside = np.delete(moved, np.r_[SILENT], axis=0)
    assert np.isfinite(beside).all() and beside.max() < 0.1 * NOISE_NT
    assert moved[SILENT][:, OTHERS].max() < 0.1 * NOISE_NT
    known = (np.delete(s.values("calibrated/tensor_std"), np.r_[SILENT], axis=0) for s in (lost, whole))
    np.testing.assert_allclose(*known, rtol=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("silence", [np.nan, 0.0])
def test_the_others_are_brought_back_to_their_time_meanwhile(tmp_path: Path, silence: float) -> None:
    whole, lost = applied_with_and_without(tmp_path, {"type": "sampling_lag", "rms_nT": 30.0}, silence)
    moved = np.abs(lost.values("calibrated/b") - whole.values("calibrated/b"))
    assert moved[:, OTHERS].max() < 0.1 * NOISE_NT
    far = np.delete(moved[:, 2], np.r_[SILENT.start - 6 : SILENT.stop + 6], axis=0)  # from where a spline forgets it
    assert far.max() < NOISE_NT


def test_where_some_sensor_is_silent_at_all_times_there_is_nothing_to_search(tmp_path: Path) -> None:
    """With a channel logged beside them, of which no sample is left either."""

    def change(path: Path) -> None:
        with h5py.File(path, "r+") as survey:
            raw = survey["b_raw"][:]
            raw[np.arange(len(raw)), np.arange(len(raw)) % raw.shape[1]] = np.nan
            survey["b_raw"][...] = raw

    with pytest.raises(
        NotEnoughData, match="no samples with readings of all sensors and a total field are left in use"
    ):
        loaded(tmp_path, scenario(1), change)
