"""What remembers the field, where the way from one sample to the next is not seen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import adopted_names, linear_state, scenario, synthetic, verdict_of

from magtensor.loop.fitting.model import Adopted
from magtensor.loop.searching.likeness import of_an_unseen_path, with_the_turn_before
from magtensor.registry import Registry

POSTURES = {"type": "postures", "random_count": 136, "rest_s": 10.0, "turn_s": 3.0, "average": True}
SWITCHED = {"type": "switched", "mean_hold_s": 70.0}
ADOPTED = {
    "nonlinearity_cubic": {},
    "hysteresis": {"half_width_nT": 4000.0},
    "offset_drift": {"order": 2, "span_s": 1200.0},
    "viscous_magnetisation": {"tau_s": 2.0},
    "offset_step": {"time_s": 500.0},
}


@pytest.mark.parametrize(("turning_s", "places"), [(0.0, [1, 3]), (8.0, [])])
def test_memory_is_known_by_what_other_samples_change(turning_s: float, places: list[int]) -> None:
    state = linear_state(synthetic(5, turning_s=turning_s))
    registry = Registry.load()
    adopted = tuple(Adopted(registry.find("error_model", n), settings) for n, settings in ADOPTED.items())
    state = replace(state, adopted=adopted)
    assert state.excitation.turns == (turning_s > 0.0)
    assert of_an_unseen_path(state) == places


@pytest.mark.parametrize("seed", [71, pytest.param(76, marks=pytest.mark.long)])
def test_what_hysteresis_leaves_between_postures_is_no_source(seed: int, tmp_path: Path) -> None:
    """The play operator went back and forth on the way to each posture; the sensors share what that did."""
    effect = {"type": "hysteresis", "rms_nT": 0.06, "half_width_nT": [4000.0]}
    told = verdict_of(tmp_path, scenario(seed, effect, motion=POSTURES), None, ["hysteresis", "latent_source"])
    assert adopted_names(told) == {"hysteresis"}


@pytest.mark.parametrize("seed", [71, pytest.param(76, marks=pytest.mark.long)])
@pytest.mark.parametrize("effect", ["bandwidth", pytest.param("eddy_current", marks=pytest.mark.long)])
def test_what_is_quicker_than_the_way_between_postures_has_no_other_name(
    effect: str, seed: int, tmp_path: Path
) -> None:
    """A filter that still remembers the way to a posture while its mean is taken: memory that is too quick to be told,
    of which a slow body, a play or the logged acceleration explain most."""
    models = ["viscous_magnetisation", "hysteresis", "channel_response", "alignment_drift", "turn_step", "offset_while"]
    description = scenario(seed, {"type": effect, "rms_nT": 4.5}, motion=POSTURES, logging={"acceleration": True})
    told = verdict_of(tmp_path, description, None, [*models, effect])
    assert adopted_names(told) == set()
    assert told["unexplained"]["present"]
    told_once = f"something quicker would do, as may {effect}, which these samples cannot test"
    assert told["unexplained"]["description"].count(told_once) == 1


def test_a_source_turns_the_field_that_a_platform_at_rest_sees() -> None:
    """Its course is then known from the sample before, and no memory of a turn."""
    x = linear_state(synthetic(31, 400)).excitation  # attitudes without any order
    rng = np.random.default_rng(32)
    samples, course = np.arange(400), np.cumsum(rng.standard_normal(400))
    assert not with_the_turn_before(x, samples, course)
    turned = np.diff(x.field[:, 0, 2], prepend=x.field[0, 0, 2]) / 5e4
    assert with_the_turn_before(x, samples, turned + rng.standard_normal(400))
    at_rest = 5e4 * np.array([0.4, 0.0, 0.9]) + 5.0 * rng.standard_normal((400, 3))
    field = at_rest + course[:, None] * [1.0, 0.5, -0.5]
    resting = replace(x, field=np.repeat(field[:, None], 4, axis=1))
    assert not resting.turns
    assert not with_the_turn_before(resting, samples, course)


@pytest.mark.parametrize("seed", [71, pytest.param(76, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("effect", "adopted"),
    [
        ({"type": "eddy_current", "rms_nT": 0.25}, set()),
        ({"type": "latent_source", "rms_nT": 0.25, "waveform_of": SWITCHED}, {"latent_source"}),
    ],
)
def test_a_waveform_that_goes_with_the_turn_before_is_no_source(
    effect: dict[str, Any], adopted: set[str], seed: int, tmp_path: Path
) -> None:
    told = verdict_of(tmp_path, scenario(seed, effect, motion=POSTURES), None, ["latent_source"])
    assert adopted_names(told) == adopted
    words = "it goes with how far the field turned since the sample before, as what is quicker would make it"
    assert (words in told["unexplained"]["description"]) is (not adopted)
