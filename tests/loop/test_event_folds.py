"""What happened once and is over soon is asked to predict its own parts, for no other part of the survey knows it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import adopted_names, linear_state, scenario, synthetic, verdict_of

from magtensor.error_models.terms import Terms
from magtensor.loop.evidence.assessment import WHITE, assess
from magtensor.loop.evidence.folds import FOLDS, LEAST_PER_BLOCK, Blocks, known_until
from magtensor.loop.evidence.gains import Gain
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.searching.gates import MOST_LEFT
from magtensor.registry import Registry

SAMPLES = 1200  # one a second; ten folds of 120
MODELS = ["passing_source", "offset_while", "offset_step", "offset_drift", "reference_step", "temperature_offset"]
PASSING: dict[str, Any] = {"type": "passing_source", "closest_m": [12.0, 0.0, 0.0], "velocity_m_s": [0.0, 0.5, 0.0]}

RESTLESS = np.arange(-60.0, 61.0, 12.0), [0.0, 1.0, -0.6, 0.8, 1.2, -1.0, 0.4, -1.1, 0.7, -0.9, 0.0]  # s, and a course


def terms_of(name: str, **settings: float) -> Terms:
    """The regressors of an error model on an ordinary survey."""
    state = linear_state(synthetic(3, samples=SAMPLES))
    made: Terms = Registry.load().find("error_model", name).function(state.excitation, **settings)
    return made.at(state.residual.samples)


@pytest.mark.parametrize("at", [600.0, 655.0], ids=["across the edge of two folds", "within one"])
def test_it_is_divided_into_parts_that_know_equally_much(at: float) -> None:
    terms = terms_of("passing_source", time_s=at, passage_s=10.0)
    blocks, plain = Blocks.of_an_event(terms), Blocks.equal(SAMPLES)
    first, after = blocks.divided
    starts, known = blocks.edges[blocks.folds], known_until(terms)
    of_each = np.diff(known[starts])[slice(*blocks.divided)]
    assert FOLDS // 2 < after - first <= FOLDS and of_each.min() > 0.02 and of_each.max() < 0.3
    assert np.diff(blocks.edges).min() >= LEAST_PER_BLOCK
    assert blocks.edges[0] == 0 and blocks.edges[-1] == SAMPLES and blocks.folds[-1] == len(blocks.edges) - 1
    outside = set(plain.edges[plain.folds].tolist()) - set(range(int(starts[first]) + 1, int(starts[after])))
    assert outside <= set(starts.tolist())  # all other folds are as they were


def test_what_few_samples_know_has_fewer_parts() -> None:
    blocks = Blocks.of_an_event(terms_of("offset_while", time_s=640.0, until_s=663.0))
    lengths = np.diff(blocks.edges[blocks.folds])[slice(*blocks.divided)]
    assert 2 < len(lengths) < FOLDS and lengths.min() >= LEAST_PER_BLOCK


@pytest.mark.parametrize(
    ("name", "settings"),
    [("offset_step", {"time_s": 500.0}), ("offset_while", {"time_s": 300.0, "until_s": 800.0})],
)
def test_what_many_folds_know_is_asked_of_equal_ones(name: str, settings: dict[str, float]) -> None:
    blocks, plain = Blocks.of_an_event(terms_of(name, **settings)), Blocks.equal(SAMPLES)
    assert blocks.divided == (0, 0)
    assert np.array_equal(blocks.edges, plain.edges) and np.array_equal(blocks.folds, plain.folds)


def test_the_same_parts_of_a_survey_without_some_samples() -> None:
    blocks = Blocks.of_an_event(terms_of("passing_source", time_s=600.0, passage_s=10.0))
    fewer = blocks.among(SAMPLES - 60)
    assert fewer.edges[-1] == SAMPLES - 60 and fewer.divided == blocks.divided
    assert np.abs(fewer.edges / (SAMPLES - 60) - blocks.edges / SAMPLES).max() < 1e-3
    assert blocks.among(SAMPLES) is blocks


@pytest.mark.parametrize(
    ("course", "shaped"),
    [("a vehicle", True), ("a walk", False), ("a vehicle and another swing", False), ("faint", True)],
)
def test_what_wanders_has_no_shape(course: str, shaped: bool) -> None:
    """The total field's own error for two minutes; a tenth of its square may be left, or what chance leaves."""
    rng, passage, at = np.random.default_rng(11), 12.0, 600.0
    t = np.arange(SAMPLES) - at
    vehicle = (1.0 - (t / passage) ** 2) / (1.0 + (t / passage) ** 2) ** 2.5
    walk = np.interp(t, *RESTLESS)
    swing = -0.7 * np.exp(-0.5 * ((t - 70.0) / 10.0) ** 2)
    added = {"a walk": walk, "a vehicle and another swing": vehicle + swing}.get(course, vehicle)
    record = synthetic(5, samples=SAMPLES, noise_nT=0.2)
    assert record.total_field is not None
    strength = 0.2 if course == "faint" else 1.0
    total = record.total_field - strength * added + 0.05 * rng.standard_normal(SAMPLES)
    state = linear_state(replace(record, total_field=total, quiet_field=total))
    model = Registry.load().find("error_model", "passing_source")
    terms = model.function(state.excitation, time_s=at, passage_s=passage).at(state.residual.samples)
    found = assess(Whitened.of(state.residual, WHITE.across, WHITE.along), terms, once=True)
    assert found.parts.divided != (0, 0)
    assert (found.left_there <= MOST_LEFT) == shaped, found.left_there


def test_one_part_that_is_made_worse_contradicts_the_others() -> None:
    """By four standard deviations: where each of ten gains 25, noise makes that scatter by 10."""
    before, values = np.full(10, 200.0), np.full(10, 100.0)
    gained = np.full(10, 25.0)
    gained[3] = -12.0
    assert not Gain(before, before - gained, values).contradicted
    gained[3] = -25.0
    assert Gain(before, before - gained, values).contradicted


@pytest.mark.long
@pytest.mark.parametrize("at", [600.0, 660.0])
def test_a_vehicle_is_found_wherever_it_passes(at: float, tmp_path: Path) -> None:
    told = verdict_of(tmp_path, scenario(31, PASSING | {"time_s": at, "rms_nT": 0.3}), models=MODELS)
    assert adopted_names(told) == {"passing_source"}
    assert abs(told["adopted"][0]["settings"]["time_s"] - at) < 5.0
    assert not told["unexplained"]["present"]


@pytest.mark.long
def test_a_base_station_that_is_restless_for_a_while_is_no_vehicle(tmp_path: Path) -> None:
    def restless(path: Path) -> None:
        with h5py.File(path, "a") as file:
            time = file["reference/time"][:] - file["time"][0]
            readings = file["reference/total_field"]
            readings[:] = readings[:] + 0.7 * np.interp(time - 600.0, *RESTLESS)

    told = verdict_of(tmp_path, scenario(32), restless, models=MODELS)
    assert not adopted_names(told)
    assert told["unexplained"]["present"]


@pytest.mark.long
@pytest.mark.parametrize(("closest_m", "means"), [
    (8.0, "it passed these"), (60.0, "may have passed the base station"),
])  # fmt: skip
def test_a_passage_is_near_or_anywhere(closest_m: float, means: str, tmp_path: Path) -> None:
    """As strong in either case, a car or a ship: the gradient tells."""
    passing = {"type": "passing_source", "closest_m": [closest_m, 0.0, 0.0], "time_s": 600.0, "rms_nT": 0.5}
    passing["velocity_m_s"] = [0.0, closest_m / 6.0, 0.0]
    (adopted,) = verdict_of(tmp_path, scenario(44, passing), None, ["passing_source"])["adopted"]
    assert means in adopted["means"]
