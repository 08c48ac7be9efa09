"""An attitude that was logged the wrong way round is told from a motion that is too poor."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magtensor.errors import DataError
from magtensor.misread import misfit, require_following

WORLD = np.array([20_000.0, 3_000.0, 44_000.0])
INVERSE, FIRST = "read as the inverse", "one with the scalar first"


def flown(seed: int, tilt_deg: float, noise_deg: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """(N, 4) quaternions, scalar last, and the field (N, 3) nT that sensors turned by 25 deg see."""
    rng = np.random.default_rng(seed)
    angles = np.column_stack([rng.uniform(0, 360, 400), rng.uniform(-tilt_deg, tilt_deg, (400, 2))])
    true = Rotation.from_euler("ZYX", angles, degrees=True)
    b = (true * Rotation.from_rotvec([0.3, -0.2, 0.25])).inv().apply(WORLD)
    logged = true * Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=(400, 3)))
    return logged.as_quat(), b


def inverse(q: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(q).inv().as_quat()


def first(q: np.ndarray) -> np.ndarray:
    return q[:, [3, 0, 1, 2]]


@pytest.mark.parametrize("tilt_deg", [1.0, 40.0, 90.0])
@pytest.mark.parametrize("world", [WORLD, None])
def test_a_right_attitude_is_not_doubted(tilt_deg, world):
    q, b = flown(1, tilt_deg)
    require_following(q, b, world)
    require_following(-q, 0.001 * b, world)
    require_following(q, b * [1.0, -1.0, 1.0], world)  # mirrored: another mistake, told elsewhere
    # an error of 1 deg about each axis turns the field by 2**0.5 deg
    assert np.degrees(misfit(q, b / np.linalg.norm(b, axis=1)[:, None], world)) < 1.6


@pytest.mark.parametrize(
    ("wrong", "said", "not_said"),
    [
        (inverse, INVERSE, FIRST),
        (first, FIRST, INVERSE),
        (lambda q: first(inverse(q)), "the inverse with the scalar first", FIRST + " ("),
        (lambda q: q[::-1], "of another clock", "read as"),
        (lambda q: q[:, [1, 0, 2, 3]], "another order of components", "read as"),
    ],
)
def test_what_is_wrong_is_named_where_the_field_in_the_world_is_known(wrong, said, not_said):
    q, b = flown(2, 40.0)
    with pytest.raises(DataError, match="the attitude does not go with the field") as refused:
        require_following(wrong(q), b, WORLD)
    assert said in refused.value.hint and not_said not in refused.value.hint


@pytest.mark.parametrize("wrong", [inverse, first])
def test_without_the_field_in_the_world_both_readings_are_named(wrong):
    q, b = flown(3, 40.0)
    with pytest.raises(DataError) as refused:
        require_following(wrong(q), b, None)
    assert INVERSE in refused.value.hint and FIRST in refused.value.hint
