"""What acts in a part of a survey only is adopted if one part of that predicts another, and not for being there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from loop_cases import Array, linear_state, synthetic

from magtensor.loop.gates import ALPHA, SECOND_ORDER, Candidate
from magtensor.loop.outcome import why
from magtensor.loop.screening import candidates_of
from magtensor.loop.statistics import LEAST_T
from magtensor.registry import Registry

SAMPLES = 1200  # one a second
RAN = slice(460, 640)  # most of it in one of ten folds of 120 s


def pump(rng: np.random.Generator) -> Array:
    """A, (N,): it ran once, on and off, for three minutes."""
    out = np.zeros(SAMPLES)
    out[RAN] = np.repeat(rng.permutation([1.0, 0.0] * 9), 10)
    return out


def looked_at(seed: int, current: Array, added: Array) -> Candidate:
    """The current's field as a candidate on a survey where `added` (N, S, 3) nT is in the outputs."""
    record = synthetic(seed, samples=SAMPLES, noise_nT=0.2, added=added)
    logged = {"current_pump": current - current.mean()}
    record = replace(record, logged=logged, means={"current_pump": current.mean()}, units={"current_pump": "A"})
    (found,) = candidates_of(linear_state(record), [Registry.load().find("error_model", "current_field")], {}, ALPHA)
    return found


def test_a_pump_that_ran_once_is_found() -> None:
    rng = np.random.default_rng(5)
    current = pump(rng)

    found = looked_at(6, current, current[:, None, None] * rng.standard_normal((4, 3)) * 1.0)

    assert found.assessment.gain.t < LEAST_T < found.assessment.focused.t  # what the folds of equal length do not show
    assert found.predicts_where_it_acts and found.passes


def test_another_disturbance_while_it_ran_is_not_the_pump() -> None:
    for seed in range(7, 15):
        rng = np.random.default_rng(seed)
        current, other = pump(rng), np.zeros((SAMPLES, 4, 3))
        other[RAN] = np.cumsum(rng.standard_normal((180, 4, 3)), axis=0) / 6.0  # a random walk of a nT or two

        assert not looked_at(seed, current, other).passes


def test_folds_that_know_equally_much_do_not_follow_the_data() -> None:
    rng = np.random.default_rng(9)
    current = pump(rng)
    found = [looked_at(3, current, nT * current[:, None, None] * np.ones((4, 3))) for nT in (0.0, 0.02, 0.04)]
    folds = [one.assessment.null_focused for one in found]
    assert len({None if one is None else len(one.before) for one in folds}) == 1
    assert not any(one.passes for one in found[:1])


def test_the_next_order_of_something_strong_is_no_effect() -> None:
    rng = np.random.default_rng(16)
    found = looked_at(17, pump(rng), 0.5 * pump(np.random.default_rng(16))[:, None, None] * rng.standard_normal((4, 3)))
    assert found.passes and not found.of_second_order

    beside = replace(found, beside=1.01 * found.assessment.gain.total / SECOND_ORDER)

    assert beside.of_second_order and not beside.passes
    assert "next order" in why(beside, None)
