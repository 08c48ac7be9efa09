"""A quiet sensor's effect beside a sensor that wanders by twenty times its noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from loop_cases import Array, linear_state, scenario, survey_file, synthetic
from scipy.signal import lfilter

import magtensor
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.wandering import narrowed_to, of_sensors, quieter, unweighed
from magtensor.registry import Registry


def wandering(seed: int, samples: int, rms: float, tau: float) -> Array:
    """(N, 3) nT, a first-order process of a time constant in samples."""
    keep = np.exp(-1.0 / tau)
    course = np.random.default_rng(seed).standard_normal((samples + round(10 * tau), 3))
    course = lfilter([1.0 - keep], [1.0, -keep], course, axis=0)[-samples:]
    out: Array = rms * course / course.std()
    return out


def third_wanders(seed: int, rms: float = 3.0, tau: float = 100.0) -> Callable[[Path], None]:
    """A change to a survey's file: S3 wanders."""

    def change(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            file["b_raw"][:, 2] += wandering(seed, len(file["b_raw"]), rms, tau)

    return change


def slow_difference(result: xr.DataTree) -> float:
    """nT rms of the slow part of what S1 and S2, which see one field, differ by when calibrated."""
    b = result["calibrated/b"].values
    parts = np.array_split(np.asarray(b[:, 0] - b[:, 1]), 40)
    return float(np.std([part.mean(axis=0) for part in parts], axis=0).mean())


@pytest.mark.long
def test_the_effect_of_a_quiet_sensor_is_found_and_measured(tmp_path: Path) -> None:
    """Three times the noise of S1; found on S1 alone, and nearly nothing left of it: white noise makes 0.027 nT."""
    path = survey_file(tmp_path, scenario(61, {"type": "temperature_offset", "rms_nT": 0.45, "sensors": ["S1"]}))
    third_wanders(561)(path)
    found = magtensor.close_loop(path, search=["warm_up", "temperature_offset", "scale_drift"])
    (adopted,) = found.verdict["adopted"]
    assert "temperature_offset" in {adopted["error_model"], *adopted["indistinguishable_from"]}
    assert adopted["sensors"] == ["S1"]
    looked = [step for step in found.steps if step["adopted"] is not None]
    assert looked[-1]["among"] == ["S1", "S2", "S4"]
    left = found.verdict["unexplained"]["description"]
    assert "mostly on S3" in left and "follows nothing that is logged" in left
    page = found.save(tmp_path / "out").directory / "report.html"
    assert "S1, S2, S4 looked at by themselves" in page.read_text()
    before = slow_difference(magtensor.close_loop(path, search=[]).dataset)
    assert slow_difference(found.dataset) < 0.06 < 0.2 < before


@pytest.mark.long
@pytest.mark.parametrize("tau", [30.0, 3000.0])
def test_nothing_is_found_beside_it_where_nothing_is(tmp_path: Path, tau: float) -> None:
    models = ["warm_up", "temperature_offset", "offset_step"]
    path = survey_file(tmp_path, scenario(62))
    third_wanders(562, 5.0, tau)(path)
    found = magtensor.close_loop(path, search=models)
    assert found.verdict["adopted"] == []
    # what the quiet sensors take of it goes through their C and o; white noise makes 0.027 nT
    assert slow_difference(found.dataset) < 0.04


def test_sensors_that_wander_alike_are_looked_at_together() -> None:
    added = np.stack([wandering(s, 1200, 3.0, 60.0) for s in range(4)], axis=1)
    assert list(quieter(linear_state(synthetic(63, added=added)))) == []
    added[:, 1] *= 8.0
    assert next(quieter(linear_state(synthetic(63, added=added)))) == ("S1", "S3", "S4")


def test_some_of_the_sensors_are_an_array_of_their_own() -> None:
    record = synthetic(64)
    per_sensor, vector = np.arange(4800.0).reshape(1200, 4), np.ones((1200, 3))
    logged = {"temperature": per_sensor, "acceleration": vector, "current_of_axes": vector, "pump": per_sensor[:, 0]}
    record = replace(record, logged=logged, position=np.eye(4)[:, :3])
    some = of_sensors(record, ["S1", "S2", "S4"])
    assert some.sensors == ("S1", "S2", "S4")
    np.testing.assert_array_equal(some.raw, record.raw[:, [0, 1, 3]])
    np.testing.assert_array_equal(some.logged["temperature"], per_sensor[:, [0, 1, 3]])
    np.testing.assert_array_equal(some.position, np.eye(4)[[0, 1, 3], :3])
    assert some.logged["acceleration"].shape == (1200, 3) and some.logged["pump"].shape == (1200,)
    assert "current_of_axes" not in some.logged  # three values for three sensors would pass for one each
    assert "current_of_axes" in of_sensors(record, ["S1", "S2"]).logged


def test_weights_of_all_noise_leave_what_is_told_as_it_is() -> None:
    """Coefficients stay; what is left is that of outputs weighed by their white noise."""
    added = np.zeros((1200, 4, 3))
    added[:, 2] = wandering(9, 1200, 20.0, 60.0)
    record = synthetic(65, added=added)
    model = Adopted(Registry.load().find("error_model", "offset_drift"), {"order": 1, "span_s": 1199.0})
    how = Fitting(noise=np.repeat([[1.0], [1.0], [20.0], [1.0]], 3, axis=1))
    state = joint_state(record, [model], how)
    evenly = unweighed(record, state, how)
    assert evenly is not None and unweighed(record, state, Fitting()) is None
    np.testing.assert_array_equal(evenly.theta[0], state.theta[0])
    assert evenly.residual.noise[6:9].max() < 3.0 < state.residual.noise[6:9].min()
    models, theta = narrowed_to(state.adopted, state.theta, state, ["S1", "S4"])
    assert models[0].sensors == ("S1", "S4")
    np.testing.assert_array_equal(theta[0], state.theta[0][[0, 1, 2, 9, 10, 11]])
