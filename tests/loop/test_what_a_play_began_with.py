"""The state of a play is known once the field has gone to and fro by its width, a filter's once it has died away."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from magtensor.loop.remainder.flagged import before_the_memory

HALF_WIDTH_NT = 5000.0


def state(*models: Any) -> Any:
    """Outputs of two sensors that rise by 1000 nT in a sample, so that 10 of them make the width of the play."""
    output = 1000.0 * np.arange(100.0)[:, None, None] * np.ones((2, 3))
    return SimpleNamespace(
        adopted=models, excitation=SimpleNamespace(output=output, sensors=("S1", "S2"), elapsed=0.1 * np.arange(100))
    )


def hysteresis(*sensors: str) -> Any:
    return SimpleNamespace(name="hysteresis", settings={"half_width_nT": HALF_WIDTH_NT}, sensors=sensors)


@pytest.mark.parametrize(("count", "known_why"), [(0, False), (4, True), (9, True), (13, False), (100, False)])
def test_a_bad_beginning_is_of_the_play_until_its_state_is_known(count: int, known_why: bool) -> None:
    bad = np.arange(100) < count
    bad[60] = True
    found, words = before_the_memory(bad, state(hysteresis("S2")))
    assert found.sum() == (count if known_why else 0)
    assert bool(words) is known_why and (not known_why or words.startswith(f"{count} samples at the start"))


def test_without_a_play_nothing_is_known() -> None:
    bad = np.arange(100) < 4
    assert not before_the_memory(bad, state(SimpleNamespace(name="offset_drift", settings={}, sensors=())))[0].any()


def test_an_axis_that_hardly_moves_keeps_the_state_of_its_play() -> None:
    still = state(hysteresis())
    still.excitation.output[:, 0, 2] = 0.0
    assert before_the_memory(np.arange(100) < 30, still)[0].sum() == 30


@pytest.mark.parametrize(("count", "known_why"), [(0, False), (4, True), (12, True), (20, False)])
def test_a_bad_beginning_is_of_the_filter_until_it_has_died_away(count: int, known_why: bool) -> None:
    """Seven of its time constants are 1.4 s, 14 samples."""
    creeps = SimpleNamespace(name="bandwidth", settings={"tau_s": 0.2}, sensors=())
    found, words = before_the_memory(np.arange(100) < count, state(creeps))
    assert found.sum() == (count if known_why else 0)
    assert bool(words) is known_why and (not known_why or "the state that bandwidth began with" in words)
