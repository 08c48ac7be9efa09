"""Damage that a survey survives: the calibration must be as good as without it, and the flags say what was left out.

The errors are those of the calibrated field against the simulated one, over the samples in use, after the best
rotation common to all sensors. With 0.5 nT of noise, and a correction that is close to the identity, the differences
from the mean of four sensors err by 0.5 sqrt(3/4) = 0.43 nT, the mean by 0.25 nT; a quarter is granted for the
parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import h5py
import numpy as np
import pytest
from hostile_surveys import Contents

MEAN, DIFFERENCE = 0.25 * 1.25, 0.433 * 1.25
RECIPES = ("chi", "li", "joint")
N = 500
Damage = Callable[[Contents], Any]


def random() -> np.random.Generator:
    return np.random.default_rng(5)


def gone(*parts: Any) -> np.ndarray:
    """(N,) the samples that must not be in use."""
    out = np.zeros(N, dtype=bool)
    for part in parts:
        out[part] = True
    return out


def short_gap(c: Contents) -> tuple[np.ndarray, str]:
    c.b[100:110, 1] = np.nan
    return gone(slice(100, 110)), "missing value"


def scattered_gaps(c: Contents) -> tuple[np.ndarray, str]:
    holes = random().random(c.b.shape[:2]) < 0.05
    c.b[holes] = np.nan
    return holes.any(axis=1), "missing value"


def infinities(c: Contents) -> tuple[np.ndarray, str]:
    c.b[7, 0, 0], c.b[9, 1, 1] = np.inf, -np.inf
    return gone([7, 9]), "infinite value"


def absurd_values(c: Contents) -> tuple[np.ndarray, str]:
    c.b[::25, 0, 0], c.b[8, 1, 2] = 1e200, -1e308
    return gone(slice(0, N, 25), 8), "impossible value"


def stuck_from_half_way(c: Contents) -> tuple[np.ndarray, str]:
    c.b[260:, 2] = c.b[260, 2]
    return gone(slice(260, N)), "stuck"


def one_axis_stuck(c: Contents) -> tuple[np.ndarray, str]:
    c.b[400:, 2, 1] = c.b[400, 2, 1]
    return gone(slice(400, N)), "axis y stuck"


def recorder_hangs(c: Contents) -> tuple[np.ndarray, str]:
    c.b[300:380] = c.b[300]
    return gone(slice(300, 380)), "frozen"


def saturated(c: Contents) -> tuple[np.ndarray, str]:
    c.b[:, 1] = np.clip(c.b[:, 1], -44e3, 44e3)
    return (np.abs(c.b[:, 1]) == 44e3).any(axis=1), "saturated on axis"


def reference_with_holes(c: Contents) -> tuple[np.ndarray, str]:
    """Missing, infinite and zero values, none longer than the gap that is bridged."""
    c.reference[[60, 80, 100]] = np.nan, np.inf, 0.0
    return gone(), ""


SURVIVED: list[Damage] = [
    short_gap, scattered_gaps, infinities, absurd_values, stuck_from_half_way, one_axis_stuck, recorder_hangs,
    saturated, reference_with_holes,
]  # fmt: skip


def right(outcome: Any, truth: np.ndarray, sound: Contents, left_out: np.ndarray, reason: str) -> None:
    mean, difference, used = outcome.succeeded().error_against(truth, sound.time)
    assert mean < MEAN
    assert difference < DIFFERENCE
    assert not (used & left_out).any()
    assert used[~left_out].mean() > 0.97
    assert not reason or any(f["reason"].startswith(reason) for f in outcome.flags)


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("damage", SURVIVED, ids=lambda d: d.__name__)
def test_survived(
    bench: Any, contents: Contents, sound_contents: Contents, truth: np.ndarray, damage: Damage, recipe: str
) -> None:
    left_out, reason = damage(contents)
    right(bench(recipe, contents), truth, sound_contents, left_out, reason)


@pytest.mark.parametrize("recipe", RECIPES)
def test_bad_times_are_dropped_when_asked(
    bench: Any, contents: Contents, sound_contents: Contents, truth: np.ndarray, recipe: str
) -> None:
    contents.time[50] = contents.time[49]
    contents.time[200:205] -= 100
    outcome = bench(recipe, contents, load={"time_faults": "drop"})
    right(outcome, truth, sound_contents, gone(50, slice(200, 205)), "")


@pytest.mark.parametrize("recipe", RECIPES)
def test_ways_to_write_the_same_numbers(
    bench: Any, contents: Contents, sound_contents: Contents, truth: np.ndarray, recipe: str
) -> None:
    """Big-endian microtesla, whole nanoseconds, a reference in float32, names that no file would have."""
    contents.values["b_raw"] = (contents.b / 1e3).astype(">f8")
    contents.values["time"] = np.round(contents.time * 1e9).astype(np.int64)
    contents.attributes["time"]["units"] = "nanoseconds since 2026-03-21T09:00:00Z"
    contents.attributes["b_raw"] = {"units": "µT", "odd": np.zeros((3, 3)), "none": h5py.Empty("f"), "ü": "ü"}
    contents.values["sensor"] = np.array(["磁/1", "a:b", "../x", "<b>&"])
    contents.values |= {"good": np.zeros(N), "total_field": np.ones(N), "comment": np.array(["x"] * N)}
    right(bench(recipe, contents), truth, sound_contents, gone(), "")


def test_a_reference_that_covers_half(
    bench: Any, contents: Contents, sound_contents: Contents, truth: np.ndarray
) -> None:
    half = contents.values["reference/time"] < 125
    for name in ("reference/time", "reference/total_field"):
        contents.values[name] = contents.values[name][half]
    last = contents.values["reference/time"][-1] + 2.0  # it goes on for one step
    bench("chi", contents).refused("does not cover 2[0-9]{2} of 500 samples", "uncovered: mask")
    beyond = sound_contents.time > last
    right(bench("joint", contents), truth, sound_contents, beyond, "the reference does not cover")


def spikes(c: Contents) -> np.ndarray:
    """One sample in a hundred of one sensor is off by 1000 nT an axis."""
    hit = random().random(N) < 0.01
    assert hit.sum() > 2
    c.b[hit, 1] += 1000 * random().choice([-1, 1], (hit.sum(), 3))
    return hit


def disturbed_for_a_while(c: Contents) -> np.ndarray:
    """A vehicle beside the array for a third of the survey."""
    c.b[:150] += 300 * random().normal(size=(150, 4, 3))
    return gone(slice(0, 150))


def third_of_one_sensor(c: Contents) -> np.ndarray:
    hit = random().random(N) < 0.3
    c.b[hit, 1] += 1000 * random().normal(size=(hit.sum(), 3))
    return hit


@pytest.mark.parametrize("damage", [spikes, disturbed_for_a_while, third_of_one_sensor], ids=lambda d: d.__name__)
def test_disturbed_samples(
    bench: Any, contents: Contents, sound_contents: Contents, truth: np.ndarray, damage: Damage
) -> None:
    """The robust fit leaves them out and is right; the published ones are wrong, and their QC says so."""
    hit = damage(contents)
    outcome = bench("joint", contents).succeeded()
    mean, difference, used = outcome.error_against(truth, sound_contents.time)
    assert mean < MEAN
    assert difference < DIFFERENCE * 1.05
    assert used[~hit].mean() > 0.97
    assert any(f["reason"].startswith("no calibration") for f in outcome.flags)
    for recipe in ("chi", "li"):
        outcome = bench(recipe, contents).succeeded()
        mean, difference, _ = outcome.error_against(truth, sound_contents.time)
        assert difference > 10 * DIFFERENCE, "else there is nothing to warn of"
        assert outcome.verdicts["outliers S2"] in ("warn", "fail")
        assert "fail" in outcome.verdicts.values()
        assert "QC failed" in outcome.out


def test_spikes_in_the_reference(bench: Any, contents: Contents, truth: np.ndarray, sound_contents: Contents) -> None:
    contents.reference[[50, 75, 100, 125]] += 3000
    mean, difference, _ = bench("joint", contents).succeeded().error_against(truth, sound_contents.time)
    assert mean < MEAN
    assert difference < DIFFERENCE
    assert "total_field_rms S1: " in bench("chi", contents).succeeded().out


def test_most_samples_disturbed(bench: Any, contents: Contents) -> None:
    """What most samples have passes for noise; only its size tells."""
    hit = random().random(N) < 0.6
    contents.b[hit] += 1000 * random().normal(size=(hit.sum(), 4, 3))
    for recipe in RECIPES:
        verdicts = bench(recipe, contents).succeeded().verdicts
        assert "fail" in {state for name, state in verdicts.items() if name.startswith(("noise", "outliers"))}


@pytest.mark.parametrize("recipe", ["chi", "joint"])
def test_a_sensor_mounted_turned_is_no_fault(
    bench: Any, contents: Contents, sound_contents: Contents, truth: np.ndarray, recipe: str
) -> None:
    x, y, z = np.moveaxis(contents.b[:, 1].copy(), 1, 0)
    contents.b[:, 1] = np.stack([y, -x, z], axis=1)
    outcome = bench(recipe, contents)
    right(outcome, truth, sound_contents, gone(), "")
    with h5py.File(outcome.folder / "result.nc") as file:
        noted = str(file["calibration/matrix"].attrs["diagnostics"])
    assert "sensor S2 is mounted turned against sensor S1" in noted


def test_li_needs_like_axes(bench: Any, contents: Contents) -> None:
    """The mean of differently mounted sensors is no sensor."""
    x, y, z = np.moveaxis(contents.b[:, 1].copy(), 1, 0)
    contents.b[:, 1] = np.stack([y, -x, z], axis=1)
    bench("li", contents).refused("sensor S2 is mounted turned", "one order and sign")


@pytest.mark.parametrize("recipe", RECIPES)
def test_sensors_all_mirrored_alike_cannot_be_told(
    bench: Any, contents: Contents, truth: np.ndarray, sound_contents: Contents, recipe: str
) -> None:
    contents.b[:, :, 0] *= -1
    outcome = bench(recipe, contents).succeeded()
    difference = outcome.error_against(truth * [-1.0, 1, 1], sound_contents.time)[1]
    assert difference < DIFFERENCE
