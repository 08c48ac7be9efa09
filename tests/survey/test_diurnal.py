"""detrend_diurnal: the reference at the array's times, and everything a base station does wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from survey_cases import START, array_variables

from magtensor.between_readings import Course, breaks, course
from magtensor.errors import DataError
from magtensor.survey.model import Survey
from magtensor.survey.reference import noise, sample, spikes
from magtensor_stages import detrend_diurnal


def survey_with(time: Any, field: Any, origin: str = "measured") -> Survey:
    variables = array_variables()
    variables["reference/time"] = (("time",), np.asarray(time, dtype=float), {"units": START})
    attributes = {"units": "nT", "origin": origin}
    variables["reference/total_field"] = (("time",), np.asarray(field, dtype=float), attributes)
    return Survey.build(variables, {"source": "s.nc"})


def values(given: dict[str, Any], name: str) -> np.ndarray:
    return np.asarray(given[name][1])


PICOTESLAS = st.integers(-(10**8), 10**8)  # no magnetometer tells less, and the reciprocal of 1e-308 overflows
RECORD = arrays(np.float64, 12, elements=PICOTESLAS.map(lambda count: count * 1e-3))


@given(arrays(np.float64, 12, elements=st.floats(0.01, 3)), RECORD, st.sampled_from(["pchip", "linear"]))
def test_no_overshoot_and_exact_at_the_samples(steps: np.ndarray, record: np.ndarray, how: Course) -> None:
    time = np.cumsum(steps)
    at = np.linspace(time[0], time[-1], 300)
    found = sample(at, time, record, how=how, max_gap_s=100.0)
    right = np.clip(np.searchsorted(time, at, side="right"), 1, len(time) - 1)
    slack = 1e-12 * np.abs(record).max()
    assert (found.values >= np.minimum(record[right - 1], record[right]) - slack).all()
    assert (found.values <= np.maximum(record[right - 1], record[right]) + slack).all()
    np.testing.assert_array_equal(sample(time, time, record, how=how, max_gap_s=100.0).values, record)
    assert found.covered.all()
    assert (found.weight_norm <= 1 + 1e-12).all()
    assert (found.weight_norm >= np.sqrt(0.5) - 1e-12).all()


def test_a_slow_variation_is_followed() -> None:
    time = np.arange(-2.0, 45.0)
    given = detrend_diurnal(survey_with(time, 48_000 + 20 * np.sin(time / 8)))
    at = np.arange(400) * 0.1
    # Cubic interpolation of a sine of amplitude 20 and step 1/8 rad; monotone slopes cost a third power near its peaks.
    np.testing.assert_allclose(values(given, "total_field"), 48_000 + 20 * np.sin(at / 8), atol=20 * (1 / 8) ** 2 / 2)
    np.testing.assert_allclose(
        values(given, "diurnal"), values(given, "total_field") - values(given, "total_field").mean(), atol=1e-9
    )
    assert given["total_field"][2]["base_nT"] == pytest.approx(values(given, "total_field").mean())


def test_each_course_follows_a_sine_better_than_the_one_before() -> None:
    time = np.arange(-3.0, 45.0, 3.0)
    survey = survey_with(time, 48_000 + 20 * np.sin(time / 8))
    true = 48_000 + 20 * np.sin(np.arange(400) / 80)
    rms = [
        np.sqrt(np.mean((values(detrend_diurnal(survey, interpolation=how), "total_field") - true) ** 2))
        for how in ("linear", "pchip", "spline")
    ]
    assert rms[1] < 0.6 * rms[0] and rms[2] < 0.6 * rms[1]


def test_the_course_in_use_is_told() -> None:
    time = np.arange(-60.0, 100.0, 2.0)
    smooth = survey_with(time, 48_000 + 20 * np.sin(time / 3))
    rough = survey_with(time, 48_000 + np.random.default_rng(1).standard_normal(len(time)))
    assert detrend_diurnal(smooth)["total_field"][2]["interpolation"] == "spline"
    assert detrend_diurnal(rough)["total_field"][2]["interpolation"] == "pchip"
    assert detrend_diurnal(smooth, interpolation="linear")["total_field"][2]["interpolation"] == "linear"


@pytest.mark.parametrize(
    ("base", "expected"), [("mean", 48_019.95), ("median", 48_019.95), ("first", 48_000.0), (47_500.0, 47_500.0)]
)
def test_base_values(base: Any, expected: float) -> None:
    time = np.arange(0.0, 41.0)
    given = detrend_diurnal(survey_with(time, 48_000 + time), base=base)
    assert given["diurnal"][2]["base_nT"] == pytest.approx(expected, abs=1e-6)
    np.testing.assert_allclose(values(given, "diurnal") + given["diurnal"][2]["base_nT"], values(given, "total_field"))


def test_latency() -> None:
    """A ramp of 1 nT/s stamped 2 s late reads 2 nT too low until the stamps are moved back."""
    time = np.arange(-5.0, 50.0)
    late = survey_with(time, 48_000 + (time - 2))
    found = values(detrend_diurnal(late, latency_s=2.0), "total_field")
    np.testing.assert_allclose(found, 48_000 + np.arange(400) * 0.1, atol=1e-9)


def test_a_reference_that_ends_early() -> None:
    survey = survey_with(np.arange(0.0, 31.0), np.full(31, 48_000.0))
    with pytest.raises(DataError, match=r"does not cover 89 of 400 samples, first at t = 31\.100 s") as caught:
        detrend_diurnal(survey)
    assert "from t = 0.000 to 30.000 s, the survey from 0.000 to 39.900 s" in str(caught.value)
    assert "s.nc: reference/total_field" in str(caught.value)
    given = detrend_diurnal(survey, uncovered="mask")
    bad = np.isnan(values(given, "total_field"))
    np.testing.assert_array_equal(bad, np.arange(400) * 0.1 > 31.0)
    np.testing.assert_array_equal(values(given, "good"), np.repeat(~bad[:, None], 4, axis=1))
    assert [(f.samples, f.by) for f in given["flags"]] == [(89, "detrend_diurnal")]
    assert np.isfinite(given["diurnal"][2]["base_nT"])


@pytest.mark.parametrize("at", [-4.0, 64.0])
def test_the_reference_goes_on_for_a_step(at: float) -> None:
    """0.15 nT/s and a reading each five seconds: the last one held would be 0.6 nT off four seconds later."""
    time = np.arange(0.0, 61.0, 5.0)
    rng = np.random.default_rng(3)
    noises = 0.02 * rng.standard_normal((400, len(time)))
    found = [sample(np.array([at]), time, 0.15 * time + each, how="pchip", max_gap_s=25.0) for each in noises]
    wrong = np.array([f.values[0] for f in found]) - 0.15 * at
    assert found[0].covered.all()
    assert abs(wrong.mean()) < 0.02 / 5  # of 400 draws
    assert wrong.std() == pytest.approx(0.02 * found[0].weight_norm[0], rel=0.15)


def test_two_readings_make_a_line() -> None:
    found = sample(np.array([-0.5, 0.5, 1.5]), np.array([0.0, 1.0]), np.array([10.0, 12.0]), how="pchip", max_gap_s=5.0)
    np.testing.assert_allclose(found.values, [9.0, 11.0, 13.0])


def test_a_gap_in_the_reference() -> None:
    time = np.delete(np.arange(0.0, 41.0), slice(11, 20))
    survey = survey_with(time, np.full(len(time), 48_000.0))
    with pytest.raises(DataError, match=r"does not cover 99 of 400 samples, first at t = 10\.100 s"):
        detrend_diurnal(survey)
    assert detrend_diurnal(survey, max_gap_s=10.0)["flags"] == []
    given = detrend_diurnal(survey, uncovered="mask")
    assert np.isnan(values(given, "total_field")).sum() == 99


def test_no_overlap_at_all_is_refused_even_when_masking() -> None:
    survey = survey_with(np.arange(3600.0, 3700.0), np.full(100, 48_000.0))
    with pytest.raises(DataError, match="covers no sample of the survey"):
        detrend_diurnal(survey, uncovered="mask")


def test_a_constant_reference_covers_everything() -> None:
    given = detrend_diurnal(survey_with([5.0, 6.0], [48_000.0, 48_000.0], origin="constant"))
    np.testing.assert_array_equal(values(given, "total_field"), 48_000.0)
    np.testing.assert_array_equal(values(given, "diurnal"), 0.0)
    assert "total_field_std" not in given


def test_spikes() -> None:
    time = np.arange(-5.0, 50.0)
    rng = np.random.default_rng(1)
    clean = 48_000 + 5 * np.sin(time / 9)
    record = np.round(clean + 0.05 * rng.normal(size=len(time)), 1)
    spiky = record.copy()
    spiky[[12, 30, 31]] += [250, -90, -80]
    given = detrend_diurnal(survey_with(time, spiky), despike=10.0)
    true = np.interp(np.arange(400) * 0.1, time, clean)
    assert np.abs(values(given, "total_field") - true).max() < 0.6
    assert {f.sensor for f in given["flags"]} == {"reference"}
    assert sum(f.samples for f in given["flags"]) == 3
    assert not spikes(record, 10.0).any()
    assert np.abs(values(detrend_diurnal(survey_with(time, spiky)), "total_field") - true).max() > 200


def test_some_minutes_of_pulsations_are_no_spikes() -> None:
    time = np.arange(0.0, 3600.0, 5.0)
    rng = np.random.default_rng(3)
    active = np.where((time > 1200) & (time < 1800), 20 * np.sin(2 * np.pi * time / 25.0), 0.0)
    record = 48_000 + active + 0.05 * rng.normal(size=len(time))
    assert not spikes(record, 8.0).any()
    record[[100, 500]] += 5.0
    assert np.flatnonzero(spikes(record, 8.0)).tolist() == [100, 500]


def test_a_spike_of_a_stormy_record_is_found() -> None:
    at = np.arange(400)
    storm = 25.0 * np.sin(at / 9.0) + 40.0 * np.sin(at / 40.0)
    record = 48_000 + storm + 0.05 * np.random.default_rng(6).normal(size=400)
    record[[60, 61, 230]] += [4.0, 0.0, -6.0]
    assert np.flatnonzero(spikes(record, 8.0)).tolist() == [60, 230]


def test_spikes_near_the_end_of_a_record_are_found() -> None:
    """What is usual beside the end is not what the last reading is like, next to a spike."""
    at = np.arange(127)
    record = np.round(48_000 + 12.0 * np.sin(at / 15.0) + 0.2 * np.random.default_rng(6).normal(size=127), 1)
    record[[106, 124]] += [45.0, -60.0]
    assert np.flatnonzero(spikes(record, 8.0)).tolist() == [106, 124]


@pytest.mark.parametrize("slope", [0.0, -0.1, 0.3])
def test_the_readings_beside_a_step_are_no_spikes(slope: float) -> None:
    at = np.arange(400)
    record = 48_000 + slope * at + 1.5 * (at >= 165) + 0.02 * np.random.default_rng(4).normal(size=400)
    assert not spikes(np.round(record, 2), 8.0).any()


def test_the_reference_s_noise_is_carried() -> None:
    rng = np.random.default_rng(2)
    time = np.arange(-5.0, 50.0, 0.05)
    record = 48_000 + np.sin(time / 9) + 0.3 * rng.normal(size=len(time))
    assert noise(record) == pytest.approx(0.3, rel=0.1)
    given = detrend_diurnal(survey_with(time + 0.0125, record), interpolation="linear")
    true = 48_000 + np.sin((np.arange(400) * 0.1 - 0.0125) / 9)
    off = values(given, "total_field") - true
    assert np.sqrt(np.mean((off / values(given, "total_field_std")) ** 2)) == pytest.approx(1.0, abs=0.15)


def test_resolution_is_the_least_uncertainty() -> None:
    record = np.round(48_000 + np.arange(500) * 0.001, 1)
    assert noise(record) >= 0.1 / np.sqrt(12)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_spike_near_larger_ones_is_one(seed: int) -> None:
    """Near an end, where each of them counts twice, two make a quiet record seem active around them."""
    places = np.array([15, 27, 35, 300])
    values = 49_000.0 + 0.1 * np.random.default_rng(seed).standard_normal(420) + np.sin(np.arange(420) / 40.0)
    values[places] += [7.9, 20.0, 20.0, 7.9]
    assert np.flatnonzero(spikes(values, 8.0)).tolist() == places.tolist()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_spikes_that_are_many_do_not_hide_each_other(seed: int) -> None:
    """One reading in fifteen, two of them with one between: each makes the four beside it stray as well."""
    rng = np.random.default_rng(seed)
    places = np.concatenate([np.arange(7, 127, 15), [69]])
    values = 49_000.0 + 0.1 * rng.standard_normal(134) + np.sin(np.arange(134) / 20.0)
    values[places] += rng.choice([-1.0, 1.0], len(places)) * rng.uniform(20.0, 400.0, len(places))
    assert np.flatnonzero(spikes(values, 8.0)).tolist() == sorted(places)


def test_a_storm_with_a_gap_is_followed_to_both_sides_of_it() -> None:
    """The field went on during the gap: its far side is no neighbour of its near one, by which good readings would be
    spikes, or steps; a spike near it is one."""
    at = np.concatenate([np.arange(-100.0, 360.0, 5.0), np.arange(500.0, 1000.0, 5.0)])

    def storm(time: np.ndarray) -> np.ndarray:
        return 50_000 + 70.0 * np.sin(time / 40.0) + 40.0 * np.sin(time / 90.0)

    record = storm(at) + 0.02 * np.random.default_rng(8).standard_normal(len(at))
    assert not spikes(record, 8.0, at).any()
    spiky = record.copy()
    spiky[[89, 94]] += [5.0, -5.0]  # third from the gap on either side
    assert np.flatnonzero(spikes(spiky, 8.0, at)).tolist() == [89, 94]
    assert at[:-1][breaks(at, record)].tolist() == [355.0]
    near = np.concatenate([np.arange(330.0, 355.0, 0.1), np.arange(500.0, 525.0, 0.1)])
    off = course(at, record, "spline")(near) - storm(near)
    assert np.abs(off).max() < 0.12  # noise of 0.02 nT, and the ends of a spline


def test_a_step_in_the_last_interval_before_a_gap_is_one() -> None:
    at = np.concatenate([np.arange(50.0), np.arange(80.0, 130.0)])
    record = 0.02 * np.random.default_rng(9).standard_normal(100)
    record[49] += 5.0
    assert breaks(at, record)[48:50].all()
