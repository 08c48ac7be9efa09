"""Surveys that no recipe may accept: each refused by all three, with one message that says where and what."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hostile_surveys import Contents

RECIPES = ("chi", "li", "joint")
Damage = Callable[[Contents], Any]
DAMAGES: dict[str, tuple[Damage, tuple[str, ...]]] = {}


def damage(*patterns: str) -> Callable[[Damage], Damage]:
    """Register a damage with what its refusal must say, the file's name apart."""

    def register(change: Damage) -> Damage:
        DAMAGES[change.__name__] = (change, (r"survey\.nc", *patterns))
        return change

    return register


def random() -> np.random.Generator:
    return np.random.default_rng(7)


# --- how much there is


@damage("b_raw", "holds no sample")
def no_samples(c: Contents) -> None:
    c.rows(slice(0, 0))


@damage("single sample")
def one_sample(c: Contents) -> None:
    c.rows(slice(0, 1))


@damage("9 samples", "at least 10")
def nine_samples(c: Contents) -> None:
    c.rows(slice(0, 9))


@damage("there is no dataset b_raw", "inspect")
def no_field(c: Contents) -> None:
    c.drop("b_raw")


@damage("there is no dataset time")
def no_time(c: Contents) -> None:
    c.drop("time")


@damage("needs position")
def no_position(c: Contents) -> None:
    c.drop("position")


@damage("needs reference/time", r"reference: \{constant:")
def no_reference(c: Contents) -> None:
    c.drop("reference/time", "reference/total_field")


@damage("no reference/time")
def reference_without_time(c: Contents) -> None:
    c.drop("reference/time")


# --- shapes and types


@damage(r"b_raw: shape \(500, 12\) is not \(time, sensor, axis\)")
def field_of_two_dimensions(c: Contents) -> None:
    c.values["b_raw"] = c.b.reshape(len(c.time), -1)


@damage(r"b_raw: shape \(4, 500, 3\)")
def field_transposed(c: Contents) -> None:
    c.values["b_raw"] = c.b.transpose(1, 0, 2)


@damage(r"b_raw: shape \(500, 4, 4\)")
def four_axes(c: Contents) -> None:
    c.values["b_raw"] = np.concatenate([c.b, c.b[:, :, :1]], axis=2)


@damage("b_raw", "holds no sensor")
def no_sensors(c: Contents) -> None:
    c.values["b_raw"] = c.b[:, :0]
    c.drop("sensor", "position")


@damage(r"time: shape \(500, 1\)")
def time_of_two_dimensions(c: Contents) -> None:
    c.values["time"] = c.time[:, None]


@damage(r"position: shape \(3, 3\)")
def position_of_another_array(c: Contents) -> None:
    c.values["position"] = c.values["position"][:3]


@damage(r"reference/total_field: shape \(186,\)")
def reference_of_another_length(c: Contents) -> None:
    c.values["reference/time"] = c.values["reference/time"][:-1]


@damage("b_raw: it holds text")
def text_for_numbers(c: Contents) -> None:
    c.values["b_raw"] = c.b.astype(str)


@damage("time: it holds text")
def text_for_time(c: Contents) -> None:
    c.values["time"] = c.time.astype(str)


@damage("b_raw: it holds complex numbers")
def complex_numbers(c: Contents) -> None:
    c.values["b_raw"] = c.b.astype(complex)


@damage("sensor S1: the median magnitude is")
def truth_values(c: Contents) -> None:
    c.values["b_raw"] = c.b > 0


@damage("b_raw: its _FillValue, scale_factor or add_offset is not a number")
def absurd_scale_factor(c: Contents) -> None:
    c.attributes["b_raw"]["scale_factor"] = "big"


@damage("sensor: 2 sensor names, but b_raw has 4")
def too_few_names(c: Contents) -> None:
    c.values["sensor"] = np.array(["a", "b"])


@damage("sensor names a, a, b, c are not unique")
def names_twice(c: Contents) -> None:
    c.values["sensor"] = np.array(["a", "a", "b", "c"])


@damage("the name '' of sensor 1 is empty")
def empty_name(c: Contents) -> None:
    c.values["sensor"] = np.array(["", "a", "b", "c"])


@damage("cannot be printed")
def name_that_writes_on_the_terminal(c: Contents) -> None:
    c.values["sensor"] = np.array(["\x1b[31mred", "a", "b", "c"])


@damage("axes are z, y, x")
def axes_in_another_order(c: Contents) -> None:
    c.values["axis"] = np.array(["z", "y", "x"])


# --- units


@damage("b_raw: it has no units")
def no_units(c: Contents) -> None:
    del c.attributes["b_raw"]["units"]


@damage("b_raw: unknown unit 'furlong'; a magnetic flux density may be in nT")
def nonsense_unit(c: Contents) -> None:
    c.attributes["b_raw"]["units"] = "furlong"


@damage("b_raw: 'V' is a voltage")
def volts(c: Contents) -> None:
    c.attributes["b_raw"]["units"] = "V"


@damage("sensor S1", "looks like uT labelled nT")
def microtesla_labelled_nanotesla(c: Contents) -> None:
    c.b[:] /= 1e3


@damage("sensor S1", "looks like T labelled nT")
def tesla_labelled_nanotesla(c: Contents) -> None:
    c.b[:] /= 1e9


@damage("sensor S1", "looks like G labelled nT")
def gauss_labelled_nanotesla(c: Contents) -> None:
    c.b[:] /= 1e5


@damage("sensor S4: the median magnitude is")
def one_sensor_ten_times_too_large(c: Contents) -> None:
    c.b[:, 3] *= 10


@damage("sensor S2", "looks like uT labelled nT")
def one_sensor_in_other_units(c: Contents) -> None:
    c.b[:, 1] /= 1e3


@damage("reference/total_field", "looks like uT labelled nT")
def reference_in_microtesla(c: Contents) -> None:
    c.reference[:] /= 1e3


@damage("reference/total_field")
def reference_of_zeros(c: Contents) -> None:
    c.reference[:] = 0


@damage("position: two sensors are 500 m apart", "mm labelled m")
def millimetres_labelled_metres(c: Contents) -> None:
    c.values["position"] *= 1e3


# --- times


@damage("time: sample 50 has the same time as the one before, t = 24.500 s", "time_faults: drop")
def a_time_twice(c: Contents) -> None:
    c.time[50] = c.time[49]


@damage("time: the clock steps back at sample 50")
def clock_steps_back(c: Contents) -> None:
    c.time[50:55] -= 100


@damage("time: the time of sample 20 is missing")
def missing_time(c: Contents) -> None:
    c.time[20] = np.nan


@damage("time: no time is a number")
def no_time_is_a_number(c: Contents) -> None:
    c.time[:] = np.nan


@damage("time: it has no units", "seconds since")
def time_without_units(c: Contents) -> None:
    del c.attributes["time"]["units"]


@damage("the reference covers no sample of the survey", "epochs")
def another_epoch(c: Contents) -> None:
    c.attributes["time"]["units"] = "seconds since 1970-01-01T00:00:00Z"


@damage("reference/time", "does not move on")
def reference_clock_steps_back(c: Contents) -> None:
    c.values["reference/time"][20] -= 50


# --- values


@damage("sensor S2: axis z holds no number at all")
def axis_without_numbers(c: Contents) -> None:
    c.b[:, 1, 2] = np.nan


@damage("sensor S1: axis x holds no number at all")
def no_numbers(c: Contents) -> None:
    c.b[:] = np.nan


@damage("sensor S1: axis x holds no number at all")
def infinite(c: Contents) -> None:
    c.b[:] = np.inf


@damage("sample")
def sensors_never_together(c: Contents) -> None:
    half = len(c.time) // 2
    c.b[:half, 0], c.b[half:, 1] = np.nan, np.nan


@damage("sensor S3: axis y is dead: it is 12 nT in every sample")
def dead_axis(c: Contents) -> None:
    c.b[:, 2, 1] = 12.0


@damage("sensor S3: axis y is dead: it varies a hundred times less")
def dead_axis_with_noise(c: Contents) -> None:
    c.b[:, 2, 1] = random().normal(size=len(c.time))


@damage("sensor S3: the sensor is stuck")
def stuck_from_the_start(c: Contents) -> None:
    c.b[:, 2] = c.b[0, 2]


@damage("sensor S3: 60 % of its samples cannot be used: stuck")
def stuck_for_most_of_it(c: Contents) -> None:
    c.b[200:, 2] = c.b[200, 2]


@damage("sensor S1: 100 % of its samples cannot be used: saturated on axis x, y, z")
def saturated_in_every_attitude(c: Contents) -> None:
    np.clip(c.b, -20e3, 20e3, out=c.b)


@damage("no ellipsoid comes nearer to the samples than", "saturated")
def saturated_softly(c: Contents) -> None:
    np.clip(c.b, -40e3, 40e3, out=c.b)
    c.b[:] += 0.5 * random().normal(size=c.b.shape)


@damage("b_raw: S2 x and S3 x hold the same numbers")
def sensor_copied(c: Contents) -> None:
    c.b[:, 2] = c.b[:, 1]


# --- sensors that do not belong together


@damage("the x and y axes of sensor S2 are swapped against sensor S1")
def swapped_axes(c: Contents) -> None:
    c.b[:, 1] = c.b[:, 1][:, [1, 0, 2]]


@damage("the z axis of sensor S3 is inverted against sensor S1")
def mirrored_axis(c: Contents) -> None:
    c.b[:, 2, 2] *= -1


@damage("the x, y and z axes of sensor S3 are inverted against sensor S1")
def three_mirrored_axes(c: Contents) -> None:
    c.b[:, 2] *= -1


@damage("the x axis of sensor S1 is inverted against (the other sensors|sensor S2)")
def first_sensor_mirrored(c: Contents) -> None:
    c.b[:, 0, 0] *= -1


@damage("sensor S2 is inverted", "sensor S3 is inverted")
def two_of_four_mirrored(c: Contents) -> None:
    c.b[:, [1, 2], 0] *= -1


@damage("sensor S2 does not see the field that the others see")
def samples_in_another_order(c: Contents) -> None:
    c.b[:, 1] = c.b[random().permutation(len(c.time)), 1]


@damage("sensor S2 does not see the field that the others see")
def another_clock(c: Contents) -> None:
    c.b[:, 1] = np.roll(c.b[:, 1], 2, axis=0)


@damage("sensor S2")
def random_sensor(c: Contents) -> None:
    c.b[:, 1] = 28e3 * random().normal(size=(len(c.time), 3))


@damage("do not determine|no ellipsoid|determine no")
def random_everything(c: Contents) -> None:
    c.b[:] = 28e3 * random().normal(size=c.b.shape)


@damage("500 samples in 1 distinct attitudes", "x and y and z output never changed")
def one_attitude(c: Contents) -> None:
    c.b[:] = c.b[:1] + 0.5 * random().normal(size=c.b.shape)


# --- geometry


@damage("position: the position of sensor S2 is not a finite number")
def position_missing(c: Contents) -> None:
    c.values["position"][1, 0] = np.nan


@damage("position: Gxx, Gxy, Gxz, Gyy, Gyz cannot be determined: the 4 sensors are all at one place")
def all_at_one_place(c: Contents) -> None:
    c.values["position"][:] = 1.0


@damage("position: Gyy, Gyz cannot be determined: the 3 sensors lie on one line")
def three_on_a_line(c: Contents) -> None:
    c.values |= {"b_raw": c.b[:, :3], "sensor": c.values["sensor"][:3]}
    c.values["position"] = np.outer([0, 0.1, 0.2], [1.0, 0, 0])


@damage("cannot be determined: the 2 sensors lie on one line")
def two_sensors(c: Contents) -> None:
    for name in ("sensor", "position"):
        c.values[name] = c.values[name][:2]
    c.values["b_raw"] = c.b[:, :2]


@damage("there is only one sensor")
def one_sensor(c: Contents) -> None:
    for name in ("sensor", "position"):
        c.values[name] = c.values[name][:1]
    c.values["b_raw"] = c.b[:, :1]


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("name", DAMAGES)
def test_refused(bench: Any, contents: Contents, name: str, recipe: str) -> None:
    change, patterns = DAMAGES[name]
    change(contents)
    bench(recipe, contents).refused(*patterns)
