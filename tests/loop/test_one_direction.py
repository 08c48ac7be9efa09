"""Heat of the side that faces the sun follows the attitude late, as slow iron does, but along one direction of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loop_cases import Array, scenario, synthetic, verdict_of

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.one_direction import beside_one_direction, left_by_chance, of_one_direction
from magtensor.registry import Registry

TAU_S = 40.0
SETTLED = {"tau_s": TAU_S, "at_start_x_nT": 0.0, "at_start_y_nT": 0.0, "at_start_z_nT": 0.0}


def late(course: Array) -> Array:
    """(N, K) through a body of heat, or iron, that follows with a time constant; samples of one second, in hundredths
    of which it goes on."""
    out, now = np.empty_like(course), course[0]
    for n, value in enumerate(course):
        for _ in range(100):
            now = now + 0.01 / TAU_S * (value - now)
        out[n] = now
    return out


@pytest.mark.parametrize("sensors", [1, 4])
@pytest.mark.parametrize("iron", [True, False])
@pytest.mark.parametrize("seed", [3, 5])
def test_iron_shows_the_field_and_heat_one_direction(seed: int, iron: bool, sensors: int) -> None:
    """The sun stands somewhere else than the field, and warms nothing from behind."""
    rng = np.random.default_rng(seed)
    plain = synthetic(seed, sensors=sensors, noise_nT=0.2, turning_s=8.0)
    u = plain.raw.mean(axis=1) - plain.raw.mean(axis=(0, 1))
    u /= np.linalg.norm(u, axis=1)[:, None]
    if iron:
        matrix = 4.0 * (np.eye(3) + 0.4 * rng.standard_normal((sensors, 3, 3)))
        added = np.einsum("sij,nj->nsi", matrix, late(u) - u)
    else:
        beside = np.cross(u, synthetic(seed + 50, sensors=1, turning_s=8.0).raw[:, 0])
        sun = 0.8 * u + 0.6 * beside / np.linalg.norm(beside, axis=1)[:, None]
        side = np.array([0.6, -0.3, 0.74])
        added = 30.0 * late(np.maximum(sun @ side, 0.0)[:, None])[:, None] * rng.standard_normal((sensors, 3))
    record = replace(plain, raw=plain.raw + added)
    model = Adopted(Registry.load().find("error_model", "viscous_magnetisation"), SETTLED)
    assert of_one_direction(joint_state(record, [model], Fitting()), 0) is not iron


@pytest.mark.parametrize("seed", [10, 20])
def test_iron_in_a_short_survey_of_slow_turns_is_iron(seed: int) -> None:
    """Of four time constants, in which the field has hardly more than one direction that is late."""
    rng = np.random.default_rng(seed)
    plain = synthetic(seed, samples=180, noise_nT=0.2, turning_s=15.0)
    u = plain.raw.mean(axis=1) - plain.raw.mean(axis=(0, 1))
    u /= np.linalg.norm(u, axis=1)[:, None]
    added = np.einsum("sij,nj->nsi", 4.0 * rng.standard_normal((4, 3, 3)), late(u) - u)
    model = Adopted(Registry.load().find("error_model", "viscous_magnetisation"), SETTLED)
    assert not of_one_direction(joint_state(replace(plain, raw=plain.raw + added), [model], Fitting()), 0)


def test_what_one_direction_leaves_of_matrices() -> None:
    rng = np.random.default_rng(2)
    k, w = rng.standard_normal((4, 3)), rng.standard_normal(3)
    one = np.einsum("si,j->sij", k, w)
    root = rng.standard_normal((36, 36))
    information = root @ root.T
    assert beside_one_direction(one, information) < 1e-9 * one.ravel() @ information @ one.ravel()
    # where all entries are known alike it is the sum of squares of the smaller singular values
    some = rng.standard_normal((4, 3, 3))
    smaller = np.linalg.svd(some.reshape(12, 3), compute_uv=False)[1:]
    assert beside_one_direction(some, np.eye(36)) == pytest.approx(np.sum(smaller**2), rel=1e-6)


def test_what_one_direction_leaves_by_chance_goes_by_how_many_matrices_there_are() -> None:
    apart = np.random.default_rng(4).standard_normal((4, 3, 3))
    alike, known = np.repeat(apart[:1], 4, axis=0), np.eye(36)
    assert 0.2 < left_by_chance(apart[:1], known[:9, :9]) < left_by_chance(apart, known) < 2.0 / 3.0
    assert left_by_chance(alike, known) == pytest.approx(left_by_chance(apart[:1], known[:9, :9]), abs=0.06)
    # where the survey shows one column of the matrices alone, that is one direction
    column = np.diag(np.tile([1.0, 1e-6, 1e-6], 12))
    assert left_by_chance(apart, column) < 1e-3


def test_iron_that_all_sensors_have_alike_is_iron() -> None:
    """Of its singular values the largest is by far the largest for one matrix, though not of four such by chance."""
    record = synthetic(9, noise_nT=0.2, turning_s=8.0)
    u = record.raw.mean(axis=1) - record.raw.mean(axis=(0, 1))
    u /= np.linalg.norm(u, axis=1)[:, None]
    turned = np.linalg.qr(np.random.default_rng(9).standard_normal((3, 3)))[0]
    added = (late(u) - u) @ (turned @ np.diag([6.0, 3.0, 0.4]) @ turned.T[[1, 2, 0]])
    model = Adopted(Registry.load().find("error_model", "viscous_magnetisation"), SETTLED)
    state = joint_state(replace(record, raw=record.raw + added[:, None]), [model], Fitting())
    assert not of_one_direction(state, 0)


@pytest.mark.long
def test_what_may_be_heat_is_not_blamed_on_a_logged_vector_that_goes_a_part_of_the_way(tmp_path: Path) -> None:
    """An accelerometer sees how the platform turns, and so a part of all that follows the attitude late."""
    one = np.outer([1.0, -0.6, 0.8], [0.7, 0.5, -0.5]).tolist()
    iron = {"type": "viscous_magnetisation", "coupling": [one] * 4, "rms_nT": 0.45}
    models = ["viscous_magnetisation", "channel_response"]
    told = verdict_of(tmp_path, scenario(9, iron, logging={"acceleration": True}), models=models)
    assert not told["adopted"] and told["unexplained"]["present"]
    why = {r["error_model"]: r["why"] for r in told["rejected"]}
    assert "one direction of the lagged field" in why["viscous_magnetisation"]
    assert "explains the same and more" in why["channel_response"]
