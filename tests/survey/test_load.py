"""The stage load on surveys that are damaged, each in one way."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr
from survey_cases import array_variables

from magtensor.errors import DataError, NotEnoughData, UsageError
from magtensor.survey.model import Survey
from magtensor.survey.repeated import written_twice
from magtensor.survey.sections import SurveySection
from magtensor.survey.source import Source
from magtensor.survey.time_base import moves_on
from magtensor_stages import load

Load = Callable[..., Survey]
Variables = dict[str, Any]


def changed(variables: Variables, name: str, change: Callable[[Any], Any]) -> Variables:
    dims, values, attributes = variables[name]
    values = np.array(values, copy=True)
    result = change(values)
    return {**variables, name: (dims, values if result is None else result, attributes)}


def set_to(where: Any, value: Any) -> Callable[[Any], None]:
    def change(values: Any) -> None:
        values[where] = value

    return change


def test_a_sound_survey_loses_nothing(load_variables: Load, variables: Variables) -> None:
    survey = load_variables(variables)
    assert survey.good_by_sensor.all()
    assert survey.flags == ()
    assert survey.source is not None
    assert "notes" not in survey.attributes
    assert survey["time"].attrs["rate_Hz"] == pytest.approx(10.0)
    assert survey["time"].attrs["gaps"] == 0
    for path, (_, values, _) in variables.items():
        np.testing.assert_array_equal(survey.values(path), values, err_msg=path)


def test_a_survey_without_a_source_is_the_users_mistake() -> None:
    with pytest.raises(UsageError, match="no survey was named"):
        load(Survey(xr.DataTree()))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_to(7, 6 * 0.1), r"time: sample 7 has the same time as the one before, t = 0\.600 s; 1 sample of 400"),
        (
            set_to(slice(7, 10), 0.1),
            r"time: the clock steps back at sample 7, from t = 0\.600 s to t = 0\.100 s; 3 samples",
        ),
        (set_to(7, np.nan), r"time: the time of sample 7 is missing"),
        (set_to(7, 1e9), r"time: the time of sample 7, t = 1000000000\.000 s, is later than times after it; 1 sample"),
    ],
)
def test_time_faults(load_variables: Load, variables: Variables, change: Any, message: str) -> None:
    damaged = changed(variables, "time", change)
    with pytest.raises(DataError, match=message) as caught:
        load_variables(damaged)
    assert "survey.nc" in str(caught.value)
    survey = load_variables(damaged, time_faults="drop")
    assert (np.diff(survey.time) > 0).all()
    assert len(survey.time) in (397, 399)
    keep = np.isin(variables["time"][1], survey.time)
    np.testing.assert_array_equal(survey.values("b_raw"), variables["b_raw"][1][keep])
    assert "left out whose time does not move on" in survey.attributes["notes"][0]


@pytest.mark.parametrize("early", [-1e6, 1.0])
def test_a_stamp_too_late_and_one_too_early_cost_two_samples(early: float) -> None:
    time = 0.1 * np.arange(1000)
    time[100], time[900] = 1e6, early
    kept = moves_on(time)
    assert (np.diff(time[kept]) > 0).all()
    assert list(np.flatnonzero(~kept)) == [100, 900]


def test_of_a_clock_that_steps_back_the_samples_before_it_are_kept() -> None:
    time = 0.1 * np.concatenate([np.arange(600), np.arange(300, 1000)])
    assert list(np.flatnonzero(~moves_on(time))) == list(range(600, 900))


def test_reference_times(load_variables: Load, variables: Variables) -> None:
    damaged = changed(variables, "reference/time", set_to(5, 1.0))
    with pytest.raises(DataError, match=r"reference/time: the time of the reference's sample 5, t = 1\.000 s"):
        load_variables(damaged)
    survey = load_variables(damaged, time_faults="drop")
    assert len(survey.values("reference/time")) == len(variables["reference/time"][1]) - 1


def test_missing_reference_values_are_left_out(load_variables: Load, variables: Variables) -> None:
    survey = load_variables(changed(variables, "reference/total_field", set_to(slice(3, 6), np.nan)))
    assert np.isfinite(survey.values("reference/total_field")).all()
    assert "3 of 43 reference samples have no value" in survey.attributes["notes"][0]
    with pytest.raises(DataError, match="reference/total_field: every value is missing"):
        load_variables(changed(variables, "reference/total_field", set_to(slice(None), np.nan)))


WARM = 18.0 + 4.0 * np.sin(np.arange(400) / 60.0)


@pytest.mark.parametrize(
    ("values", "found"),
    [
        (np.where(np.arange(400) % 90 == 7, -999.0, WARM), -999.0),
        (np.where(np.arange(400) > 300, 9999.9, WARM).astype(np.float32), 9999.9),
        (np.where(np.arange(400) == 3, -9999.0, np.where(np.arange(400) % 3, np.nan, WARM)), -9999.0),
        (np.where(np.arange(400) % 7 == 2, 1e30, WARM), 1e30),
        (np.where(np.arange(400) % 3 == 2, 9.969209968386869e36, WARM), 9.969209968386869e36),  # of netCDF
        (np.where(np.arange(400) % 7 == 2, 1e4, WARM), None),
        (WARM, None),
        (np.arange(600.0, 1000.0), None),  # a counter gets there
        (np.where(np.arange(400) % 2, 999.0, WARM), None),  # as often as not: a switch
        (np.where(np.arange(400) % 5, 0.0, 999.0), None),  # two levels
        (np.full(400, 999.0), None),
        (np.full(400, np.nan), None),
    ],
)
def test_numbers_that_stand_for_missing_values_of_a_channel(
    load_variables: Load, variables: Variables, values: Any, found: float | None
) -> None:
    survey = load_variables({**variables, "temperature": (["time"], values, {"units": "degC"})})
    kept = survey.values("temperature")
    if found is None:
        np.testing.assert_array_equal(kept, values)
        assert "notes" not in survey.attributes
    else:
        lost = np.isclose(values, found)
        np.testing.assert_array_equal(kept, np.where(lost, np.nan, values))
        assert survey["temperature"].attrs["units"] == "degC"
        assert f"temperature: {lost.sum()} values of {found:.6g}, far from all" in survey.attributes["notes"][0]


def test_a_thermometer_below_absolute_zero_is_refused(load_variables: Load, variables: Variables) -> None:
    board = {"board": (["time"], WARM - 40.0, {"units": "K"})}
    with pytest.raises(DataError, match=r"board: its median is -29\d\.\d+ degC, below absolute zero\n  .*labelled K"):
        load_variables({**variables, **board})
    assert "board" in load_variables({**variables, **board}, magnitude="accept")
    for cold in ((["time"], WARM, {"units": "K"}), (["time"], WARM - 300.0, {"units": "V"})):
        assert "board" in load_variables({**variables, "board": cold})


def test_a_sensor_without_a_place_is_named(load_variables: Load, variables: Variables) -> None:
    position = np.zeros((len(load_variables(variables).sensors), 3))
    position[:, 0] = np.arange(len(position)) * 0.5
    position[1, 2] = np.nan
    with pytest.raises(DataError, match=r"position: the position of sensor S2 is not a finite number\n  .*or of none"):
        load_variables({**variables, "position": (["sensor", "axis"], position, {"units": "m"})})


def test_missing_and_infinite_values_are_flagged(load_variables: Load, variables: Variables) -> None:
    damaged = changed(variables, "b_raw", set_to((slice(20, 30), 1, 2), np.nan))
    damaged = changed(damaged, "b_raw", set_to((50, 3, 0), np.inf))
    survey = load_variables(damaged)
    bad = ~survey.good_by_sensor
    assert bad[20:30, 1].all()
    assert bad[50, 3]
    assert bad.sum() == 11
    assert [(f.sensor, f.samples, f.reason) for f in survey.flags] == [
        ("S2", 10, "missing value"),
        ("S4", 1, "infinite value"),
    ]
    assert (survey.flags[0].start, survey.flags[0].stop) == (2.0, pytest.approx(2.9))


def test_zero_on_all_axes_is_no_field(load_variables: Load, variables: Variables) -> None:
    dims, values, attributes = variables["b_raw"]
    values = np.array(values)
    values[5, 1], values[7:9, [0, 3]] = 0.0, 0.0
    values[11, 2, 0] = 0.0  # on one axis a field may be
    survey = load_variables({**variables, "b_raw": (dims, values, attributes)})
    assert {(f.sensor, f.samples, f.reason) for f in survey.flags} == {
        (name, count, "zero on all axes") for name, count in (("S1", 2), ("S2", 1), ("S4", 2))
    }
    assert np.flatnonzero(~survey.good).tolist() == [5, 7, 8]


def test_too_many_missing_values(load_variables: Load, variables: Variables) -> None:
    damaged = changed(variables, "b_raw", set_to((slice(0, 300), 1), np.nan))
    with pytest.raises(DataError, match=r"sensor S2: 75 % of its samples cannot be used: missing value"):
        load_variables(damaged)
    assert load_variables(damaged, max_flagged_share=0.8).good_by_sensor[:, 1].sum() == 100
    assert load_variables(damaged, sensors=("S1", "S3")).sensors == ["S1", "S3"]


def test_an_axis_without_any_number(load_variables: Load, variables: Variables) -> None:
    with pytest.raises(DataError, match="sensor S2: axis z holds no number at all"):
        load_variables(changed(variables, "b_raw", set_to((slice(None), 1, 2), np.nan)))


def test_dead_axes(load_variables: Load, variables: Variables) -> None:
    with pytest.raises(DataError, match="sensor S3: axis y is dead: it is 12 nT in every sample"):
        load_variables(changed(variables, "b_raw", set_to((slice(None), 2, 1), 12.0)))
    noise = np.random.default_rng(3).normal(size=400)
    with pytest.raises(DataError, match="sensor S3: axis y is dead: it varies a hundred times less"):
        load_variables(changed(variables, "b_raw", set_to((slice(None), 2, 1), noise)))


def test_an_axis_that_copies_another_is_not_called_dead(load_variables: Load, variables: Variables) -> None:
    def copied(b: Any) -> None:
        b[:, 2, 1] = b[:, 2, 0]

    with pytest.raises(DataError, match="S3 x and S3 y hold the same numbers in every sample"):
        load_variables(changed(variables, "b_raw", copied))


def test_a_stretch_that_was_written_twice(load_variables: Load, variables: Variables) -> None:
    """Its noise would be there twice, and every pattern in it would predict the other half."""

    def again(b: Any) -> None:
        b[300:380] = b[100:180]

    spoilt = changed(variables, "b_raw", again)
    with pytest.raises(DataError, match="samples 301 to 380 hold the same readings as samples 101 to 180"):
        load_variables(spoilt)
    assert load_variables(spoilt, copied_rows="accept").good.all()


def test_a_sensor_that_rests_or_comes_back_repeats_no_sequence(load_variables: Load, variables: Variables) -> None:
    """Coarse steps and three postures: rows that are alike, in no order."""
    rng = np.random.default_rng(6)
    postures = 30e3 * rng.standard_normal((3, 4, 3)) / np.sqrt(3.0)

    def coarse(b: Any) -> None:
        b[...] = np.round((postures[np.arange(len(b)) // 50 % 3] + 2.0 * rng.standard_normal(b.shape)) / 5.0) * 5.0

    assert written_twice(changed(variables, "b_raw", coarse)["b_raw"][1]) is None


def test_a_planar_rotation_is_no_dead_axis(load_variables: Load, variables: Variables) -> None:
    """All sensors share the direction that does not vary; that is the motion's fault, not a sensor's."""
    rng = np.random.default_rng(4)
    angle = np.linspace(0, 20, 400)
    field = np.stack([40e3 * np.cos(angle), 40e3 * np.sin(angle), np.full(400, 20e3)], axis=1)
    field = field[:, None] + rng.normal(size=(400, 4, 3))
    assert load_variables(changed(variables, "b_raw", lambda _: field)).good.all()


def test_a_stuck_sensor(load_variables: Load, variables: Variables) -> None:
    whole = changed(variables, "b_raw", set_to((slice(None), 2), [30e3, 1e3, 20e3]))
    with pytest.raises(DataError, match="sensor S3: the sensor is stuck: all its samples are the same"):
        load_variables(whole)
    held = variables["b_raw"][1][100, 2]
    survey = load_variables(changed(variables, "b_raw", set_to((slice(100, 160), 2), held)))
    assert (~survey.good_by_sensor[:, 2]).sum() == 60
    assert (~survey.good_by_sensor[100:160, 2]).all()
    assert survey.flags[0].reason.startswith("stuck")


def test_a_sensor_that_hangs_for_a_moment(load_variables: Load, variables: Variables) -> None:
    """Short holds are no calm of the platform while the other sensors turn with it; single repeated rows may be."""
    field = variables["b_raw"][1].copy()
    for start, stop in ((60, 66), (150, 157), (300, 312)):
        field[start:stop, 2] = field[start, 2]
    field[220, 1] = field[219, 1]
    survey = load_variables(changed(variables, "b_raw", lambda _: field))
    stuck = np.flatnonzero(~survey.good_by_sensor[:, 2])
    np.testing.assert_array_equal(stuck, [*range(60, 66), *range(150, 157), *range(300, 312)])
    assert survey.good_by_sensor[:, [0, 1, 3]].all()


def test_a_slow_sensor_is_not_stuck(load_variables: Load, variables: Variables) -> None:
    field = variables["b_raw"][1][(np.arange(400) // 3) * 3]
    survey = load_variables(changed(variables, "b_raw", lambda _: field))
    assert survey.good.all()
    assert survey["b_raw"].attrs["new_sample_share"] == pytest.approx([1 / 3] * 4, abs=0.01)


def test_coarse_steps_at_rest_are_not_stuck(load_variables: Load, variables: Variables) -> None:
    """A sensor of 100 nT steps repeats itself for minutes when the platform rests between postures."""
    rng = np.random.default_rng(5)
    postures = rng.normal(size=(8, 3))
    postures = 48e3 * postures / np.linalg.norm(postures, axis=1, keepdims=True)
    field = np.repeat(postures, 50, axis=0)[:, None] + 30 * rng.normal(size=(1, 4, 3)) + rng.normal(size=(400, 4, 3))
    field[:, 2] = 100 * np.round(field[:, 2] / 100)
    survey = load_variables(changed(variables, "b_raw", lambda _: field))
    assert survey.good_by_sensor[:, 2].mean() > 0.98
    assert survey["b_raw"].attrs["quantisation_nT"][2] == pytest.approx(100.0)


def test_saturation(load_variables: Load, variables: Variables) -> None:
    field = variables["b_raw"][1].copy()
    field[:, 1, 0] = np.clip(field[:, 1, 0], -35e3, 35e3)
    clipped = np.abs(field[:, 1, 0]) == 35e3
    assert 10 < clipped.sum() < 200
    survey = load_variables(changed(variables, "b_raw", lambda _: field))
    np.testing.assert_array_equal(~survey.good_by_sensor[:, 1], clipped)
    assert {f.reason for f in survey.flags} == {"saturated on axis x"}
    assert survey.good_by_sensor[:, [0, 2, 3]].all()


def test_a_stated_end_of_range(load_variables: Load, variables: Variables) -> None:
    survey = load_variables(variables, saturation_nT=45_000.0, max_flagged_share=0.9)
    expected = (np.abs(variables["b_raw"][1]) < 45_000).all(axis=2)
    np.testing.assert_array_equal(survey.good_by_sensor, expected)
    assert (~expected).sum() > 0


@pytest.mark.parametrize(
    ("factor", "suspect"),
    [(1e-3, "uT"), (1e-2, "mG"), (1e-5, "G"), (1e-9, "T"), (1e3, "nT labelled uT, or pT labelled nT")],
)
def test_magnitudes_betray_wrong_units(load_variables: Load, variables: Variables, factor: float, suspect: str) -> None:
    wrong = changed(variables, "b_raw", lambda b: b * factor)
    with pytest.raises(DataError, match=rf"sensor S1: the median magnitude is .*looks like {suspect}"):
        load_variables(wrong)
    assert load_variables(wrong, magnitude="accept").good.all()


def test_a_reference_in_the_wrong_units(load_variables: Load, variables: Variables) -> None:
    with pytest.raises(DataError, match=r"reference/total_field: the median .*looks like uT labelled nT"):
        load_variables(changed(variables, "reference/total_field", lambda f: f / 1000))


def test_a_reference_of_another_survey(load_variables: Load, variables: Variables) -> None:
    with pytest.raises(DataError, match=r"sensor S1: the median magnitude is .* nT, that of the reference 2[34]"):
        load_variables(changed(variables, "reference/total_field", lambda f: f * 0.49))


def test_copied_columns(load_variables: Load, variables: Variables) -> None:
    copied = changed(variables, "b_raw", set_to((slice(None), 3, 1), variables["b_raw"][1][:, 0, 1]))
    with pytest.raises(DataError, match="b_raw: S1 y and S4 y hold the same numbers"):
        load_variables(copied)
    assert load_variables(copied, copied_axes="accept").good.all()


def test_a_single_sample(load_variables: Load) -> None:
    variables = array_variables(1)
    with pytest.raises(NotEnoughData, match="a single sample is no survey"):
        load_variables(variables)


def test_window(load_variables: Load, variables: Variables) -> None:
    survey = load_variables(variables, window_s=(1.0, 2.0))
    assert survey.time[0] == pytest.approx(1.0)
    assert survey.time[-1] == pytest.approx(2.0)
    assert len(survey.values("reference/time")) == 43
    with pytest.raises(NotEnoughData, match="fewer than two samples between 100 and 200 s"):
        load_variables(variables, window_s=(100.0, 200.0))


def test_an_unknown_sensor(load_variables: Load, variables: Variables) -> None:
    with pytest.raises(DataError, match=r"there is no sensor S33 \(did you mean S3"):
        load_variables(variables, sensors=("S1", "S33"))


def test_gaps_are_reported(load_variables: Load, variables: Variables) -> None:
    time = variables["time"][1].copy()
    time[100:] += 3.0
    attributes = load_variables(changed(variables, "time", lambda _: time))["time"].attrs
    assert attributes["gaps"] == 1
    assert attributes["longest_gap_s"] == pytest.approx(3.1)
    assert attributes["missing_samples"] == 30


def test_readers_and_options_are_checked_before_any_file_is_opened(tmp_path: Any, registered: dict[str, Any]) -> None:
    section = SurveySection.model_validate_json(
        '{"file": "absent.csv", "reader": "txet", "sensors": {"A": {"from": [0, 1, 2], "units": "nT", '
        '"file": "b.csv", "options": {"delimeter": "comma"}}}}'
    )
    problems = dict(Source(section, tmp_path, registered).problems())
    assert problems["reader"] == "there is no reader txet (did you mean text?)"
    assert "has no option delimeter (did you mean delimiter?)" in problems["sensors.A.options.delimeter"]
    with pytest.raises(UsageError, match="txet"):
        Source(section, tmp_path, registered).read()


def test_readings_of_a_channel_that_cannot_be(load_variables: Load, variables: Variables) -> None:
    values = np.where(np.arange(400) % 90 == 7, 85.0, WARM)
    survey = load_variables({**variables, "temperature": (["time"], values, {"units": "degC"})})
    np.testing.assert_array_equal(survey.values("temperature"), np.where(values == 85.0, np.nan, WARM))
    said = "temperature: 5 values (85), alone and far from all others, are taken for missing"
    assert survey.attributes["notes"] == [said]


def test_several_numbers_that_stand_for_missing_readings(load_variables: Load, variables: Variables) -> None:
    """The one of them is no near value of the other; and an infinite one is none either."""
    values = WARM.copy()
    places = {-999.0: slice(10, 50), 1e20: slice(60, 63), np.inf: slice(100, 130)}
    for number, place in places.items():
        values[place] = number
    survey = load_variables({**variables, "temperature": (["time"], values, {"units": "degC"})})
    missing = np.isin(values, list(places))
    np.testing.assert_array_equal(survey.values("temperature"), np.where(missing, np.nan, WARM))
    said = [
        "30 infinite values are",
        "3 values of 1e+20, far from all others, are",
        "40 values of -999, far from all others, are",
    ]
    assert survey.attributes["notes"] == [f"temperature: {each} taken for missing ones" for each in said]
