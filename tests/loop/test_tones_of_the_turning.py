"""A law of the attitude has lines in its spectrum where the platform turns steadily: they are no tones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import BASE, Array, adopted_names, loaded, scenario, verdict_of
from scipy.spatial.transform import Rotation

from magtensor.error_models.direction import turning_Hz
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.overshadowed import _of_the_attitude
from magtensor.registry import Registry

RATES = 2 * np.pi / 40.0 * np.array([1.0, 0.61, 0.37])  # rad/s about z, y and x
EARTH = np.array([0.0, np.cos(1.13), -np.sin(1.13)])


def turned(time: Array) -> Array:
    """(N, 3) the Earth's direction on a platform that turns steadily about three axes."""
    angles = time[:, None] * RATES + np.array([0.4, 2.0, 5.0])
    out: Array = Rotation.from_euler("ZYX", angles).inv().apply(EARTH)
    return out


def steady_with_a_dead_zone(path: Path) -> None:
    """Outputs of sensors that turn steadily and answer less where an axis sees little field."""
    with h5py.File(path, "a") as file:
        time, truth = file["time"][:] - file["time"][0], file["truth"]
        field = turned(time) * truth["total_field_true"][:][:, None]
        clean = np.einsum("sij,nj->nsi", truth["matrix"][:], field) + truth["offset"][:]
        noise = 0.15 * np.random.default_rng(81).standard_normal(clean.shape)
        size = np.random.default_rng(72).uniform(0.3, 1.0, clean.shape[1:])
        size *= np.random.default_rng(73).choice([-1.0, 1.0], clean.shape[1:])
        file["b_raw"][:] = clean + noise - size * np.tanh(clean / 6000.0)


@pytest.mark.long
def test_a_dead_zone_is_no_tone(tmp_path: Path) -> None:
    told = verdict_of(tmp_path, scenario(71), steady_with_a_dead_zone, ["nonlinearity_cubic", "periodic_interference"])
    assert "periodic_interference" in [s["adopted"] for s in told["steps"]]  # what this is about
    assert "periodic_interference" not in adopted_names(told)
    why = {r["error_model"]: r["why"] for r in told["rejected"]}["periodic_interference"]
    assert "harmonic of the platform's turning" in why
    assert told["unexplained"]["present"]


@pytest.mark.parametrize(("frequency", "doubted"), [(0.05, True), (0.9, False)])
def test_only_what_is_slow_enough_may_be_a_harmonic(frequency: float, doubted: bool, tmp_path: Path) -> None:
    record = loaded(tmp_path, scenario(73, motion=BASE["motion"] | {"rate_rms_deg_s": 7.0}))
    tone = Registry.load().find("error_model", "periodic_interference")
    state = joint_state(record, [Adopted(tone, {"frequency_Hz": frequency})], Fitting())
    assert bool(_of_the_attitude(state, [0])) is doubted


def test_how_fast_a_platform_turns(tmp_path: Path) -> None:
    record = loaded(tmp_path, scenario(74))
    time = record.time - record.time[0]
    steady = 2 * np.pi * 0.02 * time
    yaw = Rotation.from_euler("Z", steady[:, None])
    for field, expected in ([1.0, 0.0, 0.0], 0.02), ([0.0, 0.0, 1.0], 0.0):
        seen = np.repeat(yaw.inv().apply(field)[:, None] * 5e4, len(record.sensors), axis=1)
        x = record.excitation(seen, seen)
        assert turning_Hz(replace(x, attitude=None)) == pytest.approx(expected, abs=1e-5)
        assert turning_Hz(replace(x, attitude=yaw.as_quat())) == pytest.approx(0.02, rel=1e-3)
