"""The first gate: by the scatter over blocks, or by noise of the residual's own colour where the blocks bear it out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, linear_state, synthetic

from magtensor.loop.outcome import why
from magtensor.loop.screening import ALONE, ALPHA, UNLIKELY, Candidate, candidates_of
from magtensor.loop.search import with_lines
from magtensor.loop.statistics import Gain
from magtensor.registry import Registry

MODELS = ("turn_step", "scale_drift", "nonlinearity_cubic", "eddy_current")


def candidates(seed: int, added: Array | None = None) -> list[Candidate]:
    record = synthetic(seed, added=added, turning_s=4.0)
    registry = Registry.load()
    models = [
        registry.find("error_model", n) for n in ("turn_step", "scale_drift", "nonlinearity_cubic", "eddy_current")
    ]
    return candidates_of(with_lines(linear_state(record), record), models, {}, ALPHA)


@pytest.fixture(scope="module")
def one() -> Candidate:
    """A candidate of no significance."""
    found = candidates(3)[0]
    assert not found.significant and found.adjusted_p > ALPHA
    return found


@pytest.mark.parametrize(
    ("p", "adjusted_p", "null_p", "gain", "tried", "significant"),
    [
        (1e-9, 0.9 * ALPHA, 1.0, -1.0, 1.0, True),  # the blocks alone
        (0.9 * ALONE, 0.3, 0.9 * UNLIKELY * ALPHA, 1.0, 1.0, True),
        (1.1 * ALONE, 0.3, 0.9 * UNLIKELY * ALPHA, 1.0, 1.0, False),  # the blocks do not bear it out
        (0.9 * ALONE, 0.3, 1.1 * UNLIKELY * ALPHA, 1.0, 1.0, False),  # not unlikely enough in that noise
        (0.9 * ALONE, 0.3, 0.9 * UNLIKELY * ALPHA, -1.0, 1.0, False),  # it predicts nothing in that noise
        (0.9 * ALONE, 0.3, 0.9 * UNLIKELY * ALPHA, 1.0, 60.0, False),  # one of sixty settings may do as well
    ],
)
def test_two_ways_to_pass(
    one: Candidate, p: float, adjusted_p: float, null_p: float, gain: float, tried: float, significant: bool
) -> None:
    null_gain = Gain(np.array([1.0 + gain, 1.0]), np.ones(2), np.full(2, 10.0))
    changed = replace(
        one,
        tried=tried,
        adjusted_p=adjusted_p,
        adjusted_null_p=null_p,
        assessment=replace(one.assessment, p=p, null_gain=null_gain),
    )
    assert changed.significant is significant
    assert ("own colour" in why(changed, None)) is (significant and adjusted_p > ALPHA)


def test_a_weak_turn_that_twelve_blocks_cannot_prove_among_the_whole_catalogue() -> None:
    """0.3 nT rms in noise of 1 nT: chi-square of some 180 for three coefficients."""
    turned = np.zeros((1200, 4, 3))
    field = synthetic(8, turning_s=4.0).raw[:, 1]
    turned[700:, 1] = 2e-5 * np.cross([0.4, -0.8, 0.6], field[700:] - field.mean(0))
    found = {c.model.name: c for c in candidates(8, turned)}["turn_step"]
    more = len(Registry.load().names("error_model")) / len(MODELS)
    among_all = replace(found, adjusted_p=found.adjusted_p * more, adjusted_null_p=found.adjusted_null_p * more)
    assert among_all.adjusted_p > ALPHA and among_all.passes
    assert found.model.settings["time_s"] == pytest.approx(700.0, abs=60.0)
