"""A law of the attitude has lines in its spectrum where the platform turns steadily: they are no tones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import BASE, Array, adopted_names, linear_state, lines_left, loaded, scenario, synthetic, verdict_of
from scipy.signal import StateSpace, lsim
from scipy.spatial.transform import Rotation

from magtensor.error_models.direction import turning_Hz, turning_lines
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.remainder.tones import channels_of_the_line, of_the_turning, tones
from magtensor.loop.searching.overshadowed import _of_the_attitude
from magtensor.registry import Registry

RATES = 2 * np.pi / 40.0 * np.array([1.0, 0.61, 0.37])  # rad/s about z, y and x
EARTH = np.array([0.0, np.cos(1.13), -np.sin(1.13)])


def turned(time: Array) -> Array:
    """(N, 3) the Earth's direction on a platform that turns steadily about three axes."""
    angles = time[:, None] * RATES + np.array([0.4, 2.0, 5.0])
    out: Array = Rotation.from_euler("ZYX", angles).inv().apply(EARTH)
    return out


def steady(path: Path, added: Callable[[Array, Array, Array], Array]) -> None:
    """Outputs of sensors that turn steadily, and of what is added to them: of time, outputs and sizes of each."""
    with h5py.File(path, "a") as file:
        time, truth = file["time"][:] - file["time"][0], file["truth"]
        field = turned(time) * truth["total_field_true"][:][:, None]
        clean = np.einsum("sij,nj->nsi", truth["matrix"][:], field) + truth["offset"][:]
        noise = 0.15 * np.random.default_rng(81).standard_normal(clean.shape)
        size = np.random.default_rng(72).uniform(0.3, 1.0, clean.shape[1:])
        size *= np.random.default_rng(73).choice([-1.0, 1.0], clean.shape[1:])
        file["b_raw"][:] = clean + noise + added(time, clean, size)


def dead_zone(time: Array, clean: Array, size: Array) -> Array:
    """Of sensors that answer less where an axis sees little field."""
    out: Array = -size * np.tanh(clean / 6000.0)
    return out


def swinging(time: Array, clean: Array, size: Array) -> Array:
    """The field of a magnetised part that swings with a period of 9 s as the platform tilts."""
    down = Rotation.from_euler("ZYX", time[:, None] * RATES + np.array([0.4, 2.0, 5.0])).inv().apply([0.0, 0.0, -1.0])
    rate = 2.0 * np.pi / 9.0
    swing = StateSpace([[0.0, 1.0], [-(rate**2), -0.1 * rate]], [[0.0], [rate**2]], [[1.0, 0.0]], [[0.0]])
    out: Array = 2.0 * size * lsim(swing, down[:, 0], time)[1][:, None, None]
    return out


def motor(time: Array, clean: Array, size: Array) -> Array:
    """Of a motor, at a frequency at which nothing turns."""
    out: Array = 0.5 * size * np.sin(2.0 * np.pi * 0.2137 * time[:, None, None] + size)
    return out


@pytest.mark.long
def test_a_dead_zone_is_no_tone(tmp_path: Path) -> None:
    models = ["nonlinearity_cubic", "periodic_interference"]
    told = verdict_of(tmp_path, scenario(71), partial(steady, added=dead_zone), models)
    assert "periodic_interference" in [s["adopted"] for s in told["steps"]]  # what this is about
    assert "periodic_interference" not in adopted_names(told)
    why = {r["error_model"]: r["why"] for r in told["rejected"]}["periodic_interference"]
    assert "harmonic of the platform's turning" in why
    assert told["unexplained"]["present"]


def test_lines_of_a_part_that_swings_are_no_tones(tmp_path: Path) -> None:
    record = loaded(tmp_path, scenario(75), partial(steady, added=swinging))
    state = linear_state(record)
    strongest, _, p = lines_left(record)[0]
    assert p < 1e-9  # what this is about
    assert strongest not in tones(state, record.time)


def test_a_tone_on_a_platform_that_turns_steadily_is_found(tmp_path: Path) -> None:
    told = verdict_of(tmp_path, scenario(75), partial(steady, added=motor), ["periodic_interference"])
    (adopted,) = told["adopted"]
    assert adopted["settings"]["frequency_Hz"] == pytest.approx(0.2137, abs=1e-4)
    assert not told["unexplained"]["present"]


def test_where_the_turning_has_lines(tmp_path: Path) -> None:
    record = loaded(tmp_path, scenario(74))
    time = record.time - record.time[0]
    seen = Rotation.from_euler("Z", (2 * np.pi * 0.02 * time)[:, None]).inv().apply([1.0, 0.0, 0.0])
    field = np.repeat(5e4 * seen[:, None], len(record.sensors), axis=1)
    x = replace(record.excitation(field, field), attitude=None, logged={})
    line, none = turning_lines(x, [0.04, 0.033], [0.0, 0.0])
    assert line == pytest.approx(0.5, rel=0.02)  # of cos(a)^2, and of cos(a) sin(a)
    assert none < 1e-5
    assert of_the_turning(x, [0.04, 0.04], [10.0, 1000.0]) == [True, False]  # a fiftieth of the field is no such law


def test_a_tone_in_the_outputs_is_no_line_of_the_turning(tmp_path: Path) -> None:
    """The rate of change of a direction that hardly turns is full of it; what turns has lines of another size."""
    slow = {"motion": BASE["motion"] | {"rate_rms_deg_s": 1.0, "rate_time_s": 60.0}, "logging": {"attitude": True}}
    record = loaded(tmp_path, scenario(74, **slow))
    state = linear_state(record)
    tone = np.sin(2 * np.pi * 0.83 * record.time)[:, None, None] * np.array([0.7, -0.4, 0.5])
    x = state.excitation
    x = record.excitation(x.output + tone, x.field + tone)
    assert turning_lines(x, [0.83], [0.0])[0] > 0.0  # what this is about
    assert of_the_turning(x, [0.83], [0.5]) == [False]


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


def test_a_tone_may_be_that_of_a_channel_or_of_its_powers() -> None:
    """A field with the square of a vibration that was logged too late has a line at twice its frequency."""
    record, rng = synthetic(9), np.random.default_rng(9)
    wave = np.sin(2.0 * np.pi * 0.0731 * record.time + 1.0) + 0.1 * rng.standard_normal(len(record.time))
    field = np.repeat(record.raw[:, :1], len(record.sensors), axis=1)
    logged = {"vibration": 3.0 + wave, "pressure": rng.standard_normal(len(record.time)), "still": 0.0 * wave}
    x = replace(record.excitation(field, field), logged=logged)
    assert channels_of_the_line(x, 0.0731) == channels_of_the_line(x, 2.0 * 0.0731) == ("vibration",)
    assert channels_of_the_line(x, 0.11) == ()


def test_channels_with_its_line_are_named_beside_a_tone(tmp_path: Path) -> None:
    def logged(path: Path) -> None:
        steady(path, added=motor)
        with h5py.File(path, "a") as file:
            time = file["time"][:] - file["time"][0]
            late = np.cos(2.0 * np.pi * 0.5 * 0.2137 * (time - 1.3))  # half as fast, and no channel of the models tried
            file["vibration"] = late
            file["vibration"].dims[0].attach_scale(file["time"])
            file["vibration"].attrs["units"] = "m s-2"

    told = verdict_of(tmp_path, scenario(75), logged, ["periodic_interference"])
    (adopted,) = told["adopted"]
    assert adopted["indistinguishable_from"] == ["channel_response"] and adopted["channels_as_good"] == ["vibration"]


@pytest.mark.long
@pytest.mark.parametrize("seed", [51, 52])
def test_a_tone_of_few_periods_is_found(seed: int, tmp_path: Path) -> None:
    """A thermostat that nobody logged, or mains that the sampling folds down, fourteen periods in all."""
    rng, frequency = np.random.default_rng(seed), 14.3 / 1200.0

    def sways(path: Path) -> None:
        with h5py.File(path, "a") as file:
            turns = 2.0 * np.pi * frequency * (file["time"][:] - file["time"][0])
            phase, size = rng.uniform(0.0, 2.0 * np.pi, (2, *file["b_raw"].shape[1:]))
            file["b_raw"][:] = file["b_raw"][:] + 0.15 * size * np.sin(turns[:, None, None] + phase)

    told = verdict_of(tmp_path, scenario(seed), sways, ["periodic_interference", "latent_source", "offset_while"])
    (tone,) = told["adopted"]
    assert tone["error_model"] == "periodic_interference"
    assert tone["settings"]["frequency_Hz"] == pytest.approx(frequency, abs=0.1 / 1200.0)
    assert not told["unexplained"]["present"], told["unexplained"]["description"]


@pytest.mark.parametrize("sensors", [1, 4])
def test_the_strongest_line_of_noise_is_not_looked_at_as_a_tone(sensors: int) -> None:
    """The largest of a thousand frequencies, a single test by blocks of which would be passed by one survey in four."""
    proposed = [
        tones(linear_state(r), r.time) for r in (synthetic(seed, sensors=sensors, turning_s=4.0) for seed in range(20))
    ]
    assert sum(bool(found) for found in proposed) <= 1  # a chance of 0.005 each: two in one case of 200
    t = np.arange(1200.0)
    tone = np.sin(2.0 * np.pi * 0.2137 * t)[:, None, None] * np.array([1.0, -0.5, 0.7])
    heard = synthetic(1, sensors=sensors, turning_s=4.0, added=np.repeat(tone, sensors, axis=1))
    assert tones(linear_state(heard), heard.time)[0] == pytest.approx(0.2137, abs=1e-3)
