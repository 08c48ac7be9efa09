"""What follows the attitude and leaves far more that does is a part of a law that has no name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import Array, adopted_names, linear_state, scenario, synthetic, verdict_of

from magtensor.loop.evidence.assessment import estimated
from magtensor.loop.evidence.estimate import Estimate
from magtensor.loop.fitting.model import Record
from magtensor.loop.searching import larger_law
from magtensor.loop.searching.gates import ALPHA
from magtensor.loop.searching.larger_law import part_of_a_larger_law
from magtensor.loop.searching.screening import candidates_of
from magtensor.registry import Registry

SAMPLES = 1500
REGISTRY = Registry.load()


def directions() -> Array:
    """(N, 3) of the field, to a hundredth."""
    return synthetic(5, SAMPLES).raw.mean(axis=1) / 50_000.0


def kinked(rms_nT: float) -> Array:
    """(N, 4, 3) a gain of its own beyond a reading, in every axis, without what three degrees follow of it."""
    u = directions()
    powers = [p for p in np.ndindex(4, 4, 4) if sum(p) < 4]
    low = np.column_stack([np.prod(u ** np.array(p), axis=1) for p in powers])
    kinks = np.abs(u - 0.2)
    kinks -= low @ np.linalg.lstsq(low, kinks, rcond=None)[0]
    size = np.random.default_rng(3).uniform(0.5, 1.5, (4, 3))
    out: Array = rms_nT * (kinks / kinks.std(axis=0))[:, None] * size
    return out


def with_cross_field(rms_nT: float, kink_nT: float) -> Record:
    """x of the first sensor answers to the product of the two fields across it; a channel that does nothing."""
    u = directions()
    added = kinked(kink_nT)
    product = u[:, 1] * u[:, 2]
    added[:, 0, 0] += rms_nT * product / product.std()
    channel = np.random.default_rng(8).standard_normal(SAMPLES)
    added[:, 1, 1] += rms_nT * channel
    record = synthetic(5, SAMPLES, added=added)
    return replace(record, logged={"pump": channel - channel.mean()}, units={"pump": "A"})


@pytest.mark.parametrize(("name", "kink_nT", "refused"), [
    ("cross_field", 20.0, True), ("cross_field", 3.0, False), ("channel_response", 20.0, False),
])  # fmt: skip
def test_a_small_part_of_what_follows_the_attitude_is_none(name: str, kink_nT: float, refused: bool) -> None:
    state = linear_state(with_cross_field(2.0, kink_nT))
    (candidate,) = candidates_of(state, [REGISTRY.find("error_model", name)], {}, ALPHA)
    assert candidate.significant or refused
    assert ("so does what it leaves" in part_of_a_larger_law(candidate, state)) is refused


def test_what_explains_nothing_leaves_no_law_where_nothing_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """In noise of another colour the best coefficients may add to the sum of squares, and noise is no law."""
    state = linear_state(synthetic(5, SAMPLES))
    (candidate,) = candidates_of(state, [REGISTRY.find("error_model", "cross_field")], {}, ALPHA)

    def too_large(*given: Any) -> Estimate:
        found = estimated(*given)
        return replace(found, theta=3.0 * found.theta)

    monkeypatch.setattr(larger_law, "estimated", too_large)
    assert part_of_a_larger_law(candidate, state) == ""


@pytest.mark.long
def test_three_laws_of_the_attitude_are_all_adopted(tmp_path: Path) -> None:
    names = ["nonlinearity_cubic", "nonlinearity_quadratic", "eddy_current"]
    effects = [{"type": n, "rms_nT": rms} for n, rms in zip(names, (4.0, 1.0, 0.6), strict=True)]
    told = verdict_of(tmp_path, scenario(62, *effects), models=[*names, "cross_field", "hysteresis"])
    assert adopted_names(told) == set(names)
