"""What the verdict says of a residual that no error model explains."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loop_cases import Array, adopted_names, linear_state, scenario, synthetic, verdict_of

from magtensor.loop.evidence.gains import Gain
from magtensor.loop.fitting.model import Fitting
from magtensor.loop.remainder.predictable import predictable_in_the_total_field
from magtensor.loop.searching.latent import Sought
from magtensor.loop.searching.search import search
from magtensor.loop.searching.unexplained import NOISE, unexplained


def cubed(raw: Array) -> Array:
    """(N,) the third power of the field's direction along the first axis."""
    b = raw[:, 0] - raw[:, 0].mean(axis=0)
    return np.asarray((b[:, 0] / np.linalg.norm(b, axis=1)) ** 3)


def test_a_site_whose_field_changes_as_the_array_moves_is_told() -> None:
    record = synthetic(5, samples=2400)
    moved = replace(record, total_field=record.total_field + 6.0 * cubed(record.raw))
    assert predictable_in_the_total_field(linear_state(moved)) > 0
    assert predictable_in_the_total_field(linear_state(record)) == 0.0
    told = unexplained(search(moved, [], Fitting()), moved)
    assert told["present"] and "as the array moves" in told["description"]
    amount = float(re.findall(r"([\d.]+) nT rms of \|b\| - F", told["description"])[0])
    # of x^3 on a sphere, of mean square 1/7, an offset takes off 0.6 x
    assert amount == pytest.approx(6.0 * np.sqrt(1 / 7 - 0.36 / 3), rel=0.15)


def test_slow_noise_is_no_effect_but_its_amount_is_told() -> None:
    rng = np.random.default_rng(6)
    added = np.zeros((1200, 4, 3))
    added[:, 2] = 0.2 * np.cumsum(rng.standard_normal((1200, 3)), axis=0)
    record = synthetic(6, added=added)
    told = unexplained(search(record, [], Fitting()), record)
    assert not told["present"]
    assert told["description"].startswith(NOISE) and "is not white, mostly on S3" in told["description"]
    quiet = synthetic(6)
    assert unexplained(search(quiet, [], Fitting()), quiet)["description"] == NOISE


def test_slow_noise_of_one_sensor_is_told_where_the_others_hide_it_in_the_sum() -> None:
    """An axis that wanders by 2 nT rms within some 20 s."""
    bell = np.exp(-0.5 * (np.arange(-80, 81) / 20.0) ** 2)
    course = np.convolve(np.random.default_rng(16).standard_normal(2560), bell, mode="valid")
    added = np.zeros((2400, 4, 3))
    added[:, 2, 1] = 2.0 * course / course.std()
    record = synthetic(6, added=added, samples=2400)
    told = unexplained(search(record, [], Fitting()), record)
    assert not told["present"]
    amount = re.fullmatch(
        rf"{NOISE}; not white, in the components of the field: ([\d.]+) nT rms on S3", told["description"]
    )
    # three quarters of its power lie across the plane of the field that all sensors see, before C takes its share
    assert amount and float(amount[1]) == pytest.approx(2.0 * np.sqrt(0.75), rel=0.15)


@pytest.mark.parametrize(("share", "told"), [(0.01, False), (0.5, True)])
def test_a_small_waveform_that_predicts_nothing_is_not_told(share: float, told: bool) -> None:
    """Noise that grows louder makes one by chance."""
    record = synthetic(7)
    found = search(record, [], Fitting())
    predicts_nothing = Gain(np.ones(10), np.full(10, 2.0), np.ones(10))
    shared = Sought(
        time=record.time, values=np.ones(len(record.time)), std=0.1, direction=np.full((4, 3), 0.05), period_s=1.0,
        p=1e-6, share=share, gain=predicts_nothing, like=None, switches=False, of_the_log=False, objection="small",
    )  # fmt: skip
    assert shared.significant and not shared.gain.consistent
    assert unexplained(replace(found, shared=shared), record)["present"] is told


@pytest.mark.long
def test_what_the_law_of_something_far_larger_may_miss_is_told_as_that(tmp_path: Path) -> None:
    """A base station that reads too little by 0.6 nT, beside an offset that jumps by some hundred."""
    step = {"type": "offset_step", "rms_nT": 300.0, "time_s": [500.0]}
    scale = {"type": "reference_scale", "rms_nT": 0.6}
    told = verdict_of(tmp_path, scenario(91, step, scale), models=["offset_step", "reference_scale"])
    assert adopted_names(told) == {"offset_step"}
    assert (
        "reference_scale: significant, and less than 0.3% of the size of what is adopted, whose law may miss as much"
        in told["unexplained"]["description"]
    )
