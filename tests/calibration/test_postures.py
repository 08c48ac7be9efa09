"""Further postures: what the greedy choice must do whatever the attitudes are."""

from __future__ import annotations

import numpy as np
import pytest

from magtensor.calibration.coverage import coverage, require_coverage
from magtensor.calibration.postures import attitude_design, further_postures, sphere
from magtensor.errors import NotEnoughData


def cap(rng: np.random.Generator, count: int, half_angle_deg: float) -> np.ndarray:
    """Directions (count, 3) within a cone about +z."""
    z = rng.uniform(np.cos(np.radians(half_angle_deg)), 1.0, count)
    turn = rng.uniform(0, 2 * np.pi, count)
    r = np.sqrt(1 - z**2)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


def worst_std(unit: np.ndarray) -> float:
    """Of |b| over the sphere, by a dense regression: noise of one in every sample."""
    response = attitude_design(sphere()) @ np.linalg.pinv(attitude_design(unit))
    return float(np.sqrt(np.max(np.sum(response**2, axis=1))))


def test_even_samples_are_the_optimum() -> None:
    unit = sphere(500)
    found = further_postures(attitude_design(unit).T @ attitude_design(unit), 500)
    assert found.worst == pytest.approx([1.0], rel=0.02)  # the equivalence theorem: nine over n everywhere
    assert len(found.directions) == 0 and str(found) == ""


@pytest.mark.parametrize("half_angle_deg", [20.0, 40.0, 60.0])
def test_what_is_named_helps_more_than_anything_else_of_a_random_choice(half_angle_deg: float) -> None:
    rng = np.random.default_rng(1)
    unit = cap(rng, 300, half_angle_deg)
    found = further_postures(attitude_design(unit).T @ attitude_design(unit), 300)
    assert 0 < len(found.directions) <= 12
    for k in range(len(found.directions) + 1):  # what every posture brings, by a regression with all up to it
        alone = worst_std(np.vstack([unit, found.directions[:k]]))
        assert found.error[k] == pytest.approx(alone, rel=1e-2)
        assert found.worst[k] == pytest.approx(alone * np.sqrt(300 + k) / 3, rel=1e-2)
    chosen = worst_std(np.vstack([unit, found.directions[:4]]))
    for _ in range(50):
        other = rng.standard_normal(found.directions[:4].shape)
        other /= np.linalg.norm(other, axis=1, keepdims=True)
        assert chosen < 1.1 * worst_std(np.vstack([unit, other]))


def test_a_further_posture_is_held_as_long_as_those_before() -> None:
    """Twelve postures of forty samples each: forty further ones in each of those named."""
    rng = np.random.default_rng(3)
    unit = np.repeat(cap(rng, 12, 40.0), 40, axis=0)
    raw = 50_000.0 * unit + rng.standard_normal((480, 3))
    further = coverage(raw, np.full(480, 50_000.0)).further
    assert 35 < further.each < 90  # two of the twelve may lie within some degrees of each other
    held = np.repeat(further.directions[:2], round(further.each), axis=0)
    assert further.error[2] == pytest.approx(worst_std(np.vstack([unit, held])), rel=0.05)


def test_a_refusal_names_postures_that_mend_it() -> None:
    rng = np.random.default_rng(2)
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    unit = np.column_stack([0.6 * np.cos(turn), 0.6 * np.sin(turn), np.full(12, 0.8)])  # about one axis only
    raw = 50_000.0 * unit + rng.standard_normal((12, 3))
    found = coverage(raw, np.full(12, 50_000.0))
    with pytest.raises(NotEnoughData) as refused:
        require_coverage(found)
    assert "help most is the field along (" in refused.value.hint
    more = found.further.directions[:4]
    assert refused.value.hint.count("(") == 4 and len(found.further.directions) >= 4
    assert not np.isfinite(found.further.error[0]) and np.isfinite(found.further.error[len(more)])
    mended = np.vstack([raw, 50_000.0 * more + rng.standard_normal(more.shape)])
    assert coverage(mended, np.full(len(mended), 50_000.0)).determined
