"""A sensor that is taken off and put back: it is turned and has another offset, or other scale factors, from one moment
on, and neither explains what the other leaves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import BASE, adopted_names, linear_state, loaded, scenario, verdict_of

from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.contribution import eliminate
from magtensor.registry import Registry

AT = 500.0
RISING = BASE["channels"]["temperature"] | {"trend_degC_per_h": 15.0}
BOTH = ("turn_step", "offset_step")


def remounted(seed: int) -> dict[str, Any]:
    none = [0.0] * 3
    turned = {"type": "turn_step", "time_s": AT, "arcmin": [none, none, [-0.4, -0.2, 0.15], none]}
    moved = {"type": "offset_step", "time_s": [AT], "nT": [none, none, [-1.4, -2.5, -3.6], none]}
    return scenario(seed, turned, moved)


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 4])
def test_both_steps_are_found(seed: int, tmp_path: Path) -> None:
    found = verdict_of(tmp_path, remounted(seed), models=[*BOTH, "temperature_offset", "temperature_alignment"])
    assert adopted_names(found) == set(BOTH)
    assert all("S3" in a["sensors"] for a in found["adopted"])
    assert not found["unexplained"]["present"], found["unexplained"]["description"]


def test_a_step_beside_another_model_is_tested_as_a_single_series(tmp_path: Path) -> None:
    """Terms of a model beside others are those that it has alone, so that the exact law of one series holds."""
    record = loaded(tmp_path, remounted(3))
    models = [Adopted(Registry.load().find("error_model", name), {"time_s": AT}, ("S3",)) for name in BOTH]
    state = joint_state(record, models, Fitting())
    assert eliminate(record, state, Fitting(), 0)[1] == ()
    assert state.terms is not None
    turn, step = state.terms.only(range(3)), state.terms.only(range(3, 6))
    x = linear_state(record).excitation
    alone = models[1].terms(x).at(state.residual.samples)
    assert step.series.shape == alone.series.shape and np.array_equal(step.series, alone.series)
    noise = OwnNoise(state.residual, turn)
    assert noise.p_value(step) == pytest.approx(noise.p_value(alone))


@pytest.mark.long
@pytest.mark.parametrize("angles", [3, 6])
def test_what_changed_at_the_moment_of_a_jump_is_more_of_it(tmp_path: Path, angles: int) -> None:
    """A piece of iron has moved: the scale factor that changed stands for most of the jump of C, and a hundredth of
    that, which is an angle, is neither lost nor blamed on a temperature that rises."""
    none = [0.0] * 3
    scaled = {"type": "scale_step", "time_s": [AT], "ppm": [none, none, [0.0, 0.0, 400.0], none]}
    turned = {"type": "turn_step", "time_s": AT, "arcmin": [none, none, [-0.014, 0.02, 0.006], none]}
    made = scenario(5, scaled, *([turned] if angles == 3 else []), channels={"temperature": RISING})

    def leaning(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            raw, since = file["b_raw"][()], file["time"][()] - file["time"][0] >= AT
            raw[since, 2] += raw[since, 2] @ (6e-6 * np.array([[0.0, 0.5, 1.0], [0.5, 0.0, 0.7], [1.0, 0.7, 0.0]]))
            file["b_raw"][...] = raw

    models = ["scale_step", "turn_step", "temperature_alignment", "alignment_drift", "scale_drift"]
    found = verdict_of(tmp_path, made, leaning if angles == 6 else None, models)
    assert adopted_names(found) == {"scale_step", "turn_step"}
    assert [a["settings"]["angles"] for a in found["adopted"] if a["error_model"] == "turn_step"] == [angles]
    assert not found["unexplained"]["present"], found["unexplained"]["description"]


@pytest.mark.long
def test_iron_that_was_moved_by_one_sensor_is_no_counter_of_samples(tmp_path: Path) -> None:
    """Every product of a steady channel with the field explains more than the scale factors of the jump alone do."""

    def moved(path: Path) -> None:
        matrix = 1e-4 * np.array([[2.0, 1.0, -1.0], [1.0, -1.0, 0.7], [-1.0, 0.7, 0.5]])
        with h5py.File(path, "r+") as file:
            raw, since = file["b_raw"][()], file["time"][()] - file["time"][0] >= AT
            raw[since, 1] += raw[since, 1] @ matrix
            file["b_raw"][...] = raw
            file["counter"] = np.arange(len(raw), dtype=float)
            file["counter"].attrs["units"] = "1"

    models = ["scale_step", "turn_step", "alignment_drift", "scale_drift", "channel_response"]
    found = verdict_of(tmp_path, scenario(5), moved, models)
    assert sorted((a["error_model"], *a["sensors"]) for a in found["adopted"]) == [
        ("scale_step", "S2"),
        ("turn_step", "S2"),
    ]
    assert not found["unexplained"]["present"], found["unexplained"]["description"]
