"""The state of a play is known once the field has gone to and fro by its width, a filter's once it has died away."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loop_cases import synthetic

from magtensor.loop.fitting.model import Fitting, Record
from magtensor.loop.remainder.flagged import before_the_memory
from magtensor.loop.searching.search import search
from magtensor.registry import Registry

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


def postures_with_a_play(seed: int, each: int = 12, count: int = 130) -> Record:
    """A play of 8000 nT in the x axis of each sensor, which begins far from what the first posture would make of it."""
    rng = np.random.default_rng(seed)
    still = synthetic(seed, count, noise_nT=0.0)
    assert still.total_field is not None and still.quiet_field is not None
    driver = still.raw[:, :, 0]
    play, state = np.zeros_like(driver), np.zeros(4)
    for k, now in enumerate(driver):
        play[k] = state = np.clip(state, now - 8000.0, now + 8000.0)
    vectors = rng.standard_normal((4, 3)) / 2500.0
    raw = np.repeat(still.raw + (play - driver)[:, :, None] * vectors, each, axis=0)
    samples, total = each * count, np.repeat(still.total_field, each)
    return replace(
        still,
        time=np.arange(samples, dtype=float),
        raw=raw + 0.15 * rng.standard_normal(raw.shape),
        total_field=total,
        quiet_field=total,
        run=np.zeros(samples, dtype=int),
        segment=np.zeros(samples, dtype=int),
        samples=np.arange(samples),
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_a_play_began_with_is_no_source_that_all_sensors_share(seed: int) -> None:
    models = [Registry.load().find("error_model", name) for name in ("hysteresis", "latent_source")]
    found = search(postures_with_a_play(seed), models, Fitting())
    assert [a.name for a in found.last.adopted] == ["hysteresis"]
    assert found.shared is None or not (found.shared.significant and not found.shared.objection)
