"""A response with two time constants is two of its kind, and not one beside a drift."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import BASE, Array, adopted_names, loaded, scenario, verdict_of
from scipy.integrate import solve_ivp

from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.gates import ALPHA
from magtensor.loop.searching.profiling import already
from magtensor.loop.searching.split import split
from magtensor.registry import Registry
from magtensor.sharing import PROCESSES

THERMAL = ("temperature_offset", "temperature_rate", "offset_drift", "warm_up")
WHITE_NT = 0.15
CHANNELS = {
    "temperature": {
        "type": "temperature", "trend_degC_per_h": 3.0, "wander_rms_degC": 3.0, "wander_time_s": 400.0,
        "self_heating_degC": 0.0, "tau_s": 240.0, "log_noise": 0.01,
    }
}  # fmt: skip
LONG = BASE["motion"] | {"duration_s": 1800.0}
QUIET = BASE["instrument"] | {"noise": {"white_sd_nT": WHITE_NT}}


def lagging(time: Array, course: Array, tau_s: float) -> Array:
    """What follows a course with a time constant, from equilibrium."""
    at_rest = [float(course[0])]
    found = solve_ivp(
        lambda t, y: (np.interp(t, time, course) - y) / tau_s, (time[0], time[-1]), at_rest, t_eval=time, max_step=5.0
    )
    return np.asarray(found.y[0])


def warmed(bodies: dict[float, float], rms_nT: float, drift_nT: float = 0.0) -> Callable[[Path], None]:
    """Offsets that follow several bodies, time constant -> share, and drift, each axis along its own parabola."""

    def change(path: Path) -> None:
        rng = np.random.default_rng(11)
        with h5py.File(path, "a") as file:
            time, course = file["time"][:] - file["time"][0], file["temperature"][:]
            seen = sum(share * lagging(time, course, tau) for tau, share in bodies.items())
            each = rng.standard_normal(file["b_raw"].shape[1:])
            added = (seen - seen.mean())[:, None, None] * each
            added *= rms_nT / np.sqrt(np.mean(added**2))
            part = (time / time[-1])[:, None, None]
            added = added + drift_nT * (
                part * rng.standard_normal(each.shape) + part**2 * rng.standard_normal(each.shape)
            )
            file["b_raw"][:] = file["b_raw"][:] + added

    return change


def thermal(seed: int) -> dict[str, Any]:
    """A survey with a thermometer that wanders."""
    return scenario(seed, motion=LONG, channels=CHANNELS, instrument=QUIET)


def lags(told: dict[str, Any]) -> list[float]:
    """s, of what follows the temperature."""
    return sorted(a["settings"]["lag_s"] for a in told["adopted"] if a["error_model"] == "temperature_offset")


@pytest.mark.long
@pytest.mark.parametrize("seed", [5, 6])
def test_two_time_constants_are_two_of_a_kind(seed: int, tmp_path: Path) -> None:
    told = verdict_of(tmp_path, thermal(seed), warmed({30.0: 0.5, 900.0: 0.5}, rms_nT=4.0), THERMAL)
    assert adopted_names(told) == {"temperature_offset"}
    found = lags(told)
    assert len(found) == 2
    assert 15.0 < found[0] < 60.0 and 600.0 < found[1] < 1350.0  # the one between them is at some hundred
    assert not told["unexplained"]["present"], told["unexplained"]["description"]


@pytest.mark.long
@pytest.mark.parametrize("seed", [7, 8])
def test_one_time_constant_is_one(seed: int, tmp_path: Path) -> None:
    told = verdict_of(tmp_path, thermal(seed), warmed({120.0: 1.0}, rms_nT=4.0), THERMAL)
    assert [a["error_model"] for a in told["adopted"]] == ["temperature_offset"]
    assert lags(told)[0] == pytest.approx(120.0, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize("seed", [9, 10])
def test_a_drift_beside_one_time_constant_is_a_drift(seed: int, tmp_path: Path) -> None:
    told = verdict_of(tmp_path, thermal(seed), warmed({120.0: 1.0}, rms_nT=4.0, drift_nT=6.0), THERMAL)
    assert [a["error_model"] for a in told["adopted"]].count("temperature_offset") == 1
    assert adopted_names(told) == {"temperature_offset", "offset_drift"}


def test_several_processes_find_the_same_two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = loaded(tmp_path, thermal(5), warmed({30.0: 0.5, 900.0: 0.5}, rms_nT=4.0))
    component = Registry.load().find("error_model", "temperature_offset")
    settings = {name: parameter.default for name, parameter in component.parameters.items()}
    adopted = Adopted(component, settings | {"channel": "temperature", "lag_s": 200.0})
    state = joint_state(record, [adopted], Fitting())
    found = []
    for processes in ("1", "2"):
        monkeypatch.setenv(PROCESSES, processes)
        [two] = split(state, 0, ALPHA, 4)
        assert two.passes and two.moved is not None
        found.append((two.moved[1].settings, two.model.settings, two.assessment.gain.total))
    assert found[0] == found[1]
    assert 15.0 < found[0][0]["lag_s"] < 60.0 and 500.0 < found[0][1]["lag_s"] < 1350.0


def test_what_two_responses_began_with_makes_them_no_two() -> None:
    """Nearly one time constant, and other beginnings, are one response."""
    component = Registry.load().find("error_model", "viscous_magnetisation")
    settings = {name: parameter.default for name, parameter in component.parameters.items()}
    one = Adopted(component, settings | {"tau_s": 1.0, "at_start_x_nT": 2e4})
    assert already([one], component, settings | {"tau_s": 1.4, "at_start_x_nT": -3e4})
    assert not already([one], component, settings | {"tau_s": 2.5, "at_start_x_nT": 2e4})
