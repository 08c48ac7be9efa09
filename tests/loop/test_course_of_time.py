"""A drift of a law of its own, beside a thermometer that settles: no response to that is accused of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import BASE, adopted_names, looked_at, scenario, synthetic, verdict_of
from numpy.typing import NDArray
from scipy.fft import idct

from magtensor.error_models.example import example_survey
from magtensor.error_models.settings import profiled
from magtensor.loop.evidence.colour import colour_of
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.separation import plainer
from magtensor.loop.searching.course_of_time import FIRST_LEFT, responses_like
from magtensor.loop.searching.kin import explained_by_courses
from magtensor.registry import Registry
from magtensor_effects.ageing import courses

Array = NDArray[np.float64]
MODELS = (
    "temperature_offset",
    "temperature_rate",
    "channel_response",
    "viscous_magnetisation",
    "offset_drift",
    "warm_up",
)
SHORT: dict[str, Any] = {
    "motion": BASE["motion"] | {"duration_s": 600.0},
    "instrument": BASE["instrument"] | {"noise": {"white_sd_nT": 0.15}},
}
SIZE_NT = 4.0
LAWS: dict[str, Callable[[Array], Array]] = {
    "diffusion": np.sqrt,
    "logarithm": lambda u: np.log1p(30.0 * u) / np.log(31.0),
    "fourth root": lambda u: u**0.25,
    "second order": lambda u: 8.0 * u / (1.0 + 7.0 * u),
    "two exponentials": lambda u: 0.5 * np.exp(-u / 0.05) + 0.5 * np.exp(-u / 0.5),
    "there and on": lambda u: 1.0 / (1.0 + np.exp(-8.0 * (u - 0.4))),
    "there and flat": lambda u: np.minimum(u / 0.15, 1.0),
    "there and back": lambda u: (2.0 * u - 1.0) ** 4,
}


def drifting(law: str) -> Callable[[Path], None]:
    """Offsets that follow a law of time, of another size in each axis."""

    def change(path: Path) -> None:
        with h5py.File(path, "a") as file:
            time = file["time"][:] - file["time"][0]
            each = np.random.default_rng(5).standard_normal(file["b_raw"].shape[1:])
            file["b_raw"][:] = file["b_raw"][:] + SIZE_NT * LAWS[law](time / time[-1])[:, None, None] * each

    return change


@pytest.mark.long
@pytest.mark.parametrize("seed", [31, 32, 35])
@pytest.mark.parametrize("law", LAWS)
def test_a_thermometer_that_settles_is_not_accused_of_a_drift(law: str, seed: int, tmp_path: Path) -> None:
    told = verdict_of(tmp_path, scenario(seed, **SHORT), drifting(law), MODELS)
    assert adopted_names(told) <= {"offset_drift", "warm_up"}
    assert adopted_names(told) or law.startswith("there")  # of which the catalogue has no drift


@pytest.mark.long
@pytest.mark.parametrize(
    "seed", [31, pytest.param(32, marks=pytest.mark.long), pytest.param(33, marks=pytest.mark.long)]
)
def test_a_temperature_effect_is_none_the_less_one(seed: int, tmp_path: Path) -> None:
    effect = {"type": "temperature_offset", "rms_nT": 4.0, "lag_s": 60.0}
    told = verdict_of(tmp_path, scenario(seed, effect, **SHORT), None, MODELS)
    assert adopted_names(told) == {"temperature_offset"}


@pytest.mark.long
def test_what_is_slow_in_the_reference_alone_is_no_course_of_the_sensors(tmp_path: Path) -> None:
    effect = {"type": "temperature_scale", "rms_nT": 0.6}
    settling = {"type": "reference_drift", "rms_nT": 1.5, "settles_s": 100.0}
    motion = BASE["motion"] | {"duration_s": 600.0}
    told = verdict_of(
        tmp_path, scenario(33, effect, settling, motion=motion), None, ["temperature_scale", "scale_drift"]
    )
    assert adopted_names(told) == {"temperature_scale"}


@pytest.mark.parametrize("law", ["root", "logarithm"])
def test_a_law_of_time_goes_from_its_start_to_its_end(law: str) -> None:
    x = example_survey(Registry.load().find("error_model", "offset_drift"))
    first, second = courses(x, 2, x.duration, law)
    part = (x.time - x.time[0]) / x.duration
    shape = np.sqrt(part) if law == "root" else np.log(1.0 + 100.0 * part) / np.log(101.0)
    np.testing.assert_allclose(first, 2.0 * shape - 1.0, atol=1e-12)
    np.testing.assert_allclose(second, (3.0 * first**2 - 1.0) / 2.0, atol=1e-12)
    np.testing.assert_allclose([first[0], first[-1]], [-1.0, 1.0], atol=1e-12)


@pytest.mark.long
def test_scale_factors_that_age_as_the_logarithm_of_time(tmp_path: Path) -> None:
    """As those of CHAMP did (Yin and Luhr 2011); switched on a hundredth of the survey before it began."""
    ppm = 120.0 * np.random.default_rng(6).standard_normal((4, 3))

    def ageing(path: Path) -> None:
        with h5py.File(path, "a") as file:
            time = file["time"][:] - file["time"][0]
            course = np.log(1.0 + 100.0 * time / time[-1]) / np.log(101.0)
            file["b_raw"][:] = file["b_raw"][:] * (1.0 + 1e-6 * ppm * course[:, None, None])

    models = ("temperature_scale", "temperature_offset", "scale_drift", "offset_drift", "reference_drift")
    (adopted,) = verdict_of(tmp_path, scenario(37, **SHORT), ageing, models)["adopted"]
    assert adopted["error_model"] == "scale_drift"
    assert (adopted["settings"]["law"], adopted["settings"]["order"]) == ("logarithm", 1)
    found = np.array([c["value"] for c in adopted["coefficients"]]).reshape(4, 3)
    std = np.array([c["std"] for c in adopted["coefficients"]]).reshape(4, 3)
    assert np.all(np.abs(2.0 * found - ppm) < 2.0 * 4.5 * std)  # P1 is half of it
    assert std.max() < 10.0


def test_plainer_are_lower_orders_and_time_itself() -> None:
    marks = profiled(Registry.load().find("error_model", "offset_drift"))
    found = plainer({"order": 2, "law": "root", "span_s": 600.0}, marks)
    assert [(s["order"], s["law"]) for s in found] == [(1, "time"), (1, "root"), (2, "time")]
    assert plainer({"order": 1, "law": "time", "span_s": 600.0}, marks) == []


def test_slow_noise_is_known_below_what_courses_have_taken() -> None:
    """1/f noise of eleven times the white power at the survey's own frequency, nothing left of it below; the part that
    is seen tells it to a quarter (standard error, from the Fisher information of nine outputs)."""
    count, corner = 2400, 10.6
    k = np.arange(count)
    spectrum = np.random.default_rng(8).standard_normal((count, 9)) * np.sqrt(1.0 + corner / np.maximum(k, 1))[:, None]
    spectrum[:FIRST_LEFT] = 0.0
    found = colour_of(idct(spectrum, axis=0, norm="ortho"), stiff=True, above=FIRST_LEFT)
    assert found.power is not None
    assert found.power[1] == pytest.approx(1.0 + corner, rel=0.75)
    assert colour_of(idct(spectrum, axis=0, norm="ortho"), stiff=True).lowest < 2.0, "as if none were there"


@pytest.mark.parametrize(
    ("adopted", "course"), [("calibration_step", False), ("offset_step", False), ("scale_drift", True)]
)
def test_what_an_event_leaves_is_no_smooth_course(adopted: str, course: bool) -> None:
    """A jump far larger than what a thermometer explains beside it: that may be the law of a drift, and no jump's."""
    time = np.arange(1200) / 1200.0
    large = 40.0 * (np.where(time > 0.6, 1.0, 0.0) if adopted != "scale_drift" else time**2)
    warms = 0.6 * (np.sqrt(time) + 0.1 * np.sin(9.0 * time))
    drawn = np.random.default_rng(4).standard_normal((2, 4, 3))
    plain = synthetic(31, noise_nT=0.3, turning_s=4.0)
    added = (large[:, None, None] * drawn[0] + warms[:, None, None] * drawn[1]) * plain.raw / 50_000.0
    record = replace(
        synthetic(31, noise_nT=0.3, turning_s=4.0, added=added), logged={"temperature": warms},
        origins={"temperature": np.zeros(())}, units={"temperature": "degC"},
    )  # fmt: skip
    registry = Registry.load()
    settings = {"order": 1, "span_s": 1200.0} if course else {"time_s": 720.0}
    state = joint_state(record, [Adopted(registry.find("error_model", adopted), settings)], Fitting())
    response = {"order": 1, "channel": "temperature", "lag_s": 0.0, "delayed": False, "at_start": 0.0}
    found = looked_at(state, Adopted(registry.find("error_model", "temperature_scale"), response))
    assert (explained_by_courses(state, found) > 10.0 * found.assessment.gain.total) == course


def test_a_response_that_is_no_more_than_a_course_of_time_is_named_beside_a_drift() -> None:
    """A thermometer that settles while something drifts; and one that swings meanwhile, which nothing follows."""
    part = np.linspace(0.0, 1.0, 1200)
    each = np.random.default_rng(12).standard_normal((4, 3))
    record = synthetic(12, added=4.0 * (part - 0.2 * part**2)[:, None, None] * each)
    logged = {"temperature": 8.0 * part, "swing": np.sin(25.0 * part)}
    record = replace(
        record, logged=logged, origins=dict.fromkeys(logged, np.zeros(())), units=dict.fromkeys(logged, "degC")
    )
    state = joint_state(record, [], Fitting())
    drift = Registry.load().find("error_model", "offset_drift")
    channel = Registry.load().find("error_model", "channel_response")
    named = {name: settings.options[0] for name, settings in profiled(channel).items() if hasattr(settings, "options")}
    linear = looked_at(state, Adopted(drift, {"order": 1, "span_s": 1199.0}))
    warmer, swings = (looked_at(state, Adopted(channel, {**named, "channel": name, "lag_s": 0.0})) for name in logged)
    assert responses_like(linear, [warmer, swings], state) == {"channel_response"}
    assert responses_like(linear, [swings], state) == set()
    assert responses_like(swings, [warmer], state) == set()
