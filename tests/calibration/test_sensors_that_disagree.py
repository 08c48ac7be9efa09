"""Sensors that do not see what the others see, of which the lengths of their vectors say nothing."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtensor.applying import verification
from magtensor.calibration.agreement import strangers, turns
from magtensor.calibration.axes import flat_words
from magtensor.calibration.joint import fit_joint
from magtensor.errors import DataError
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import read_plan
from magtensor.runner import run
from magtensor.simulate import simulate, write

Array = NDArray[np.float64]

COUNT, F = 1500, 50_000.0
NOISE = np.full((4, 3), 0.15)
PLACES = np.array([[0.25, 0.0, 0.0], [0.0, 0.25, 0.0], [-0.25, 0.0, 0.0], [0.0, -0.25, 0.0]])
MOTIONS = ("tumbling", "tilted")


def attitudes(motion: str, rng: np.random.Generator) -> Rotation:
    """Platform to world: any, or any heading with tilts of some 20 degrees."""
    if motion == "tumbling":
        return Rotation.random(COUNT, random_state=rng)
    angles = np.column_stack([rng.uniform(-180.0, 180.0, COUNT), rng.normal(0.0, 20.0, (COUNT, 2))])
    return Rotation.from_euler("ZYX", angles, degrees=True)


def seen(motion: str, seed: int, turn_deg: Array | None = None, gradient: Array | None = None) -> Array:
    """(N, 4, 3) nT, calibrated outputs of four sensors, each turned by a vector, in a field with a gradient, nT/m."""
    rng = np.random.default_rng(seed)
    turned = attitudes(motion, rng)
    field = turned.inv().apply(F * np.array([0.36, 0.05, 0.93]))
    out = np.repeat(field[:, None], 4, axis=1)
    if gradient is not None:
        world = turned.as_matrix()
        out = out + np.einsum("nji,jk,nkl,sl->nsi", world, gradient, world, PLACES)
    for s, vector in enumerate(np.zeros((4, 3)) if turn_deg is None else turn_deg):
        out[:, s] = Rotation.from_rotvec(vector, degrees=True).apply(out[:, s])
    return out + NOISE * rng.standard_normal(out.shape)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("deg", [0.05, 1.5])
def test_a_sensor_that_was_turned_is_named(motion: str, deg: float) -> None:
    turn = np.zeros((4, 3))
    turn[1] = deg * np.array([0.6, -0.64, 0.48])
    (found,) = turns(seen(motion, 1, turn), np.ones((COUNT, 4), dtype=bool)).items()
    assert found[0] == 1
    assert found[1] == pytest.approx(deg, rel=0.05)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("seed", range(6))
def test_a_gradient_of_the_site_turns_no_sensor(motion: str, seed: int) -> None:
    g = 300.0 * np.random.default_rng(100 + seed).standard_normal((3, 3))
    g = g + g.T - np.eye(3) * 2.0 * np.trace(g) / 3.0
    every = np.ones((COUNT, 4), dtype=bool)
    assert turns(seen(motion, seed, gradient=g), every) == {}
    assert turns(seen(motion, seed), every) == {}


def test_of_two_nobody_knows_which() -> None:
    turn = np.zeros((4, 3))
    turn[1, 2] = 1.0
    b = seen("tumbling", 3, turn)[:, :2]
    assert set(turns(b, np.ones((COUNT, 2), dtype=bool))) == {0, 1}


def test_a_sensor_that_reads_one_value_is_a_stranger() -> None:
    b, good = seen("tumbling", 4), np.ones((COUNT, 4), dtype=bool)
    total = np.full(COUNT, F)
    assert strangers(b, good, total) == {}
    b[1000:, 2] = b[1000, 2] + 0.15 * np.random.default_rng(4).standard_normal((COUNT - 1000, 3))
    found = strangers(b, good, total)
    assert list(found) == [2] and found[2] == pytest.approx(1 / 3, abs=0.05)


def test_apply_and_a_verification_tell_of_it(tmp_path: Path) -> None:
    scenario = {
        "title": "two days", "seed": 1, "rate_Hz": 2.0,
        "instrument": {
            "seed": 3, "array": {"shape": "cross", "baseline_m": 0.5},
            "errors": {"scale": 0.01, "non_orthogonality_deg": 0.5, "misalignment_deg": 1.0, "bias_nT": 100.0},
            "noise": {"white_sd_nT": 0.15},
        },
        "motion": {"type": "tumbling", "duration_s": 400.0, "rate_rms_deg_s": 15.0, "rate_time_s": 5.0},
        "field": {"earth": {"total_field_nT": F, "inclination_deg": 66.0, "declination_deg": 4.0}},
        "base_station": {"rate_Hz": 0.5, "noise_sd_nT": 0.1},
    }  # fmt: skip
    for seed in (1, 2):
        write(simulate(scenario | {"seed": seed}), tmp_path / f"{seed}.h5")
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("title: t\nstages: [load, detrend_diurnal: {uncovered: mask}, calibrate_joint]\n")
    planned = read_plan(recipe, survey=tmp_path / "1.h5")
    calibrated = run(planned, empty_survey(planned)).survey
    assert "turned_since" not in verification(calibrated, tmp_path / "2.h5", planned)
    with h5py.File(tmp_path / "2.h5", "r+") as file:
        file["b_raw"][:, 2] = Rotation.from_rotvec([0.0, 0.4, 0.3], degrees=True).apply(file["b_raw"][:, 2])
    assert verification(calibrated, tmp_path / "2.h5", planned)["turned_since"] == "S3 by 0.5 deg"


def test_sensors_and_axes_that_are_exchanged_are_no_sensors() -> None:
    """Of three sensors: then the axes of each are the same axis of all three, nearly one direction."""
    rng = np.random.default_rng(12)
    tilts = Rotation.from_rotvec(0.02 * rng.standard_normal((3, 3)))
    field = F * Rotation.random(COUNT, random_state=rng).apply([0.0, 0.0, 1.0])
    raw = np.stack([tilt.apply(field) for tilt in tilts], axis=1) + 0.2 * rng.standard_normal((COUNT, 3, 3))
    fit_joint(raw, np.full(COUNT, F))
    with pytest.raises(DataError, match=r"sensor 2 lie nearly in a plane.*\n.*are two of these exchanged"):
        fit_joint(raw.transpose(0, 2, 1), np.full(COUNT, F))
    # a fluxgate that is badly wrong is none of these
    assert flat_words(np.array([np.eye(3), [[1.0, 0.3, 0.2], [0.3, 1.0, -0.3], [0.0, 0.2, 1.0]]])) == ()
