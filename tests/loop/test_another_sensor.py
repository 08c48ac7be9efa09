"""From one moment on a sensor has another C and offset: two changed places, or one was taken off and put back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import BASE, Array, adopted_names, linear_state, scenario, synthetic, verdict_of
from scipy.spatial.transform import Rotation
from test_changing_matrix import turned

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching import by_hand, kin
from magtensor.loop.searching.adopting import adopt
from magtensor.loop.searching.gates import ALPHA
from magtensor.registry import Registry

FIRST = 700  # of 1200 samples, two a second
SHORT = {"motion": BASE["motion"] | {"duration_s": 600.0}}
STEPS = ["calibration_step", "turn_step", "scale_step", "offset_step"]
ARCMIN = np.pi / 10800.0


def exchanged(b: Array) -> Array:
    return b[:, [0, 2, 1, 3]]


def put_back(b: Array) -> Array:
    """The second sensor as a hand puts it back: by a quarter of a degree elsewhere, and by a screw that is magnetic."""
    out = b.copy()
    out[:, 1] = Rotation.from_rotvec([0.003, -0.003, 0.002]).apply(b[:, 1]) + np.array([30.0, -20.0, 10.0])
    return out


@pytest.mark.parametrize(
    ("change", "sensors", "models"),
    [
        pytest.param(exchanged, ["S2", "S3"], STEPS, marks=pytest.mark.long),
        pytest.param(put_back, ["S2"], STEPS, marks=pytest.mark.long),
        pytest.param(exchanged, ["S2", "S3"], None, marks=pytest.mark.long),
    ],
)
def test_it_is_found_with_the_sensors(
    change: Callable[[Array], Array], sensors: list[str], models: list[str] | None, tmp_path: Path
) -> None:
    def changed(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            file["b_raw"][FIRST:] = change(file["b_raw"][FIRST:])

    found = verdict_of(tmp_path, scenario(4, **SHORT), changed, models)
    assert adopted_names(found) == {"calibration_step"}
    (step,) = found["adopted"]
    assert step["sensors"] == sensors
    assert step["settings"]["time_s"] == pytest.approx(FIRST / 2.0, abs=0.5)
    assert ("S2 and S3 have changed places" in step.get("means", "")) is (change is exchanged)
    assert found["noise_floor_nT"] == pytest.approx(0.15, abs=0.01)
    after = found["error"]["held_out"]["after"]["total_field_rms_nT"]
    assert max(after.values()) < 0.2
    assert not found["unexplained"]["present"], found["unexplained"]["description"]


@pytest.mark.parametrize("model", ["calibration_step", "turn_step"])
@pytest.mark.parametrize("arcmin", [1.0, 60.0])
def test_a_large_turn_is_of_the_sensor_that_turned_as_a_small_one_is(arcmin: float, model: str) -> None:
    """Shared out among four, a turn by a degree is a turn of all by a quarter, whose square is seen: by 0.5 nT."""
    record = turned(synthetic(3), 1, np.where(np.arange(1200) >= 700, arcmin * ARCMIN, 0.0))
    state = linear_state(record)
    step = by_hand.candidate(Registry.load().find("error_model", model), {"time_s": 700.0}, state, 30, ALPHA)
    assert adopt(record, state, step, Fitting()).adopted[0].sensors == ("S2",)


@pytest.mark.parametrize(("model", "holds"), [("calibration_step", True), ("scale_step", False)])
def test_what_holds_an_event_and_more_is_no_next_order_of_it(model: str, holds: bool) -> None:
    """Beside a turn by two degrees, of which the square is left, the best moment for the rest may be a sample off."""
    record = turned(synthetic(3), 1, np.where(np.arange(1200) >= 700, 120.0 * ARCMIN, 0.0))
    registry = Registry.load()
    turn = Adopted(registry.find("error_model", "turn_step"), {"time_s": 700.0}, ("S2",))
    state = joint_state(record, [turn], Fitting())
    component = registry.find("error_model", model)
    rest = by_hand.candidate(component, {"time_s": 701.0}, state, 30, ALPHA)
    large = kin.explained_beside(state, Adopted(component, {"time_s": 701.0}), rest.terms, rest.assessment)
    assert large == 0.0 if holds else large > 1e6


def test_sensors_that_differ_by_five_per_cent_are_calibrated_to_their_noise() -> None:
    """What they show more after they have changed places is known once C is, and C once that is taken off."""
    record = synthetic(5, noise_nT=0.1, turning_s=4.0)
    rng = np.random.default_rng(5)
    loose = np.eye(3) + 0.05 * rng.standard_normal((4, 3, 3))
    raw = np.einsum("sij,nsj->nsi", loose, record.raw) + 300.0 * rng.standard_normal((4, 3))
    raw[700:] = exchanged(raw[700:])
    record = replace(record, raw=raw)
    step = Adopted(Registry.load().find("error_model", "calibration_step"), {"time_s": 700.0}, ("S2", "S3"))
    state = joint_state(record, [step], Fitting())
    # 1200 samples of white noise: the mean square is 1 within 2 %
    assert state.residual.square() == pytest.approx(1.0, abs=0.06), state.residual.square()
